"""Strongest sound of a measurement, and the source that it comes from."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis import _bits
from ertis_numba.analysis.health.arrival import Compressed, Fit, compress, fit_delays, strongest
from ertis_numba.analysis.health.bits import by_bits
from ertis_numba.analysis.health.limits import MAX_DELAY_S
from ertis_numba.analysis.health.pcm_samples import by_numbers, scaled
from ertis_numba.base.errors import DataError
from ertis_numba.calibration.arrivals import SoundArrival, measure_arrival
from ertis_numba.calibration.wavefronts import Target, locate_source, travel_times
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["MAX_DIRECT_PATH_M", "Sound", "Source", "find_source", "hear", "identical_channels", "is_line"]

_MAX_SATURATED: Final = 0.25  # Share of the channels.
_MIN_COMMON: Final = 0.8  # Coherence of the median channel; a single echo has 0.99.
MAX_DIRECT_PATH_M: Final = 0.5
_ASIDE_M: Final = (-0.08, -0.03, 0.03, 0.08)
_SCALE_S: Final = 5e-6  # Residual beyond which a microphone loses weight.
_EMITTERS_M: Final = tuple(
    np.array([0.02, y, z]) for y in (-0.08, -0.03, 0.03, 0.08) for z in (-0.08, -0.03, 0.03, 0.08)
)
"""Places to start the search for the emitter from."""
_FLAT_M: Final = 1e-3  # Extent of the array along an axis that directions cannot be read from.


class Source(NamedTuple):
    """Source of a sound: position (axis,) of a reflector, mirror image or emitter."""

    source_m: NDArray[np.float64]
    share: float  # of the microphones that its wavefront fits


@dataclass(frozen=True, slots=True, eq=False)
class Sound:
    """Strongest sound of a measurement."""

    settings: Settings
    pulses: Compressed  # after the matched filter, without envelopes
    arrival: SoundArrival  # at the highest envelope of each microphone
    middle_s: float  # middle of the times
    speed_m_s: float  # according to the settings

    def measure(self, at_s: NDArray[np.float64], used: NDArray[np.bool_]) -> SoundArrival:
        """Measure the sound at other times; see `measure_arrival`."""
        return measure_arrival(self.pulses, self.settings.call, at_s, used)


def hear(
    measurement: Measurement, channels: NDArray[np.intp], positions_m: NDArray[np.float64], target: Target
) -> Sound:
    """Return the strongest sound; raise DataError if channels are saturated, or no single sound stands out."""
    settings = measurement.settings
    signals, _, _, loud, n_samples = _signals(measurement, channels)
    if len(loud) > _MAX_SATURATED * len(channels):
        raise DataError(f"{len(loud)} of {len(channels)} channels are saturated")
    rate_hz = settings.recording.sample_rate_hz
    pulses = compress(signals, channels.tolist(), settings.call, rate_hz=rate_hz, first=0, last=n_samples)
    speed_m_s = sound_speed_m_s(settings.air)
    width_s = float(2 * np.linalg.norm(positions_m, axis=1).max(initial=0.0)) / speed_m_s
    found = strongest(_of_target(pulses, speed_m_s, target), width_s)
    if found is None:
        raise DataError("no sound stands out")
    # The envelopes are not used again, and they are the largest part.
    bare = replace(pulses, envelope=np.broadcast_to(0.0, pulses.envelope.shape))
    arrival = measure_arrival(bare, settings.call, found[0], np.ones(len(channels), bool))
    common = float(np.median(arrival.coherence))
    if common < _MIN_COMMON:
        raise DataError(f"channels have {common:.0%} of the sound in common, so it is not a single echo")
    return Sound(settings, bare, arrival, found[1], speed_m_s)


def _of_target(pulses: Compressed, speed_m_s: float, target: Target) -> Compressed:
    """Return the part of the envelopes in which the sound of a target can be."""
    border = round((MAX_DIRECT_PATH_M / speed_m_s - pulses.start_s) / pulses.step_s)
    border = min(max(border, 1), pulses.envelope.shape[1] - 1)
    if target == "direct":
        return replace(pulses, envelope=pulses.envelope[:, :border])
    later_s = pulses.start_s + border * pulses.step_s
    return replace(pulses, envelope=pulses.envelope[:, border:], start_s=later_s)


def identical_channels(measurement: Measurement, channels: NDArray[np.intp]) -> dict[int, int]:
    """Return the channels whose samples are those of another channel: channel, and the first channel with them."""
    _, columns, stuck, _, _ = _signals(measurement, channels)
    copies: dict[int, int] = {}
    first: dict[bytes, int] = {}
    for channel in (each for each in channels.tolist() if each not in stuck):
        content = columns(channel).tobytes()
        if content in first:
            copies[channel] = first[content]
        first.setdefault(content, channel)
    return copies


def _signals(
    measurement: Measurement, channels: NDArray[np.intp]
) -> tuple[Callable[[int], NDArray[np.float32]], Callable[[int], NDArray[Any]], tuple[int, ...], tuple[int, ...], int]:
    """Return functions for signals and columns of channels, the stuck and the saturated ones, and the samples."""
    settings = measurement.settings
    words = sample_format(settings).validated(measurement.data, any_length=True)
    if settings.recording.is_pdm:
        octets = _bits.octets_of(words).reshape(len(words), -1)
        states = by_bits(octets, channels)
        signals = functools.partial(_bits.signal_of, octets)
        columns: Callable[[int], NDArray[Any]] = functools.partial(_bits.bits_of, octets)
    else:
        full, is_float = settings.recording.full_scale, settings.recording.encoding == "float32"
        states = [by_numbers(i, scaled(words, full, i), is_float=is_float) for i in channels.tolist()]
        signals = functools.partial(scaled, words, full)
        columns = lambda channel: np.asarray(words[:, channel])  # noqa: E731
    stuck = tuple(item.channel for item in states if any(name.startswith("stuck") for name in item.faults))
    loud = tuple(item.channel for item in states if "saturated" in item.faults)
    return signals, columns, stuck, loud, len(words)


def find_source(
    sound: Sound,
    used: NDArray[np.bool_],
    positions_m: NDArray[np.float64],
    delay_s: NDArray[np.float64],
    target: Target,
) -> Source:
    """Locate the source of a sound by the wavefront that most of the used microphones agree with."""
    times_s, places_m = (sound.arrival.time_s - delay_s)[used], positions_m[used]
    if target == "direct":
        starts = _EMITTERS_M
    else:
        path_m = max(sound.middle_s * sound.speed_m_s, 0.1)
        fit = fit_delays(times_s, places_m, ((2 if target == "reflector" else 1) / path_m,), sound.speed_m_s)
        starts = () if fit is None else (_in_front(fit, places_m, sound.speed_m_s, target),)
    best = Source(np.zeros(3), 0.0)
    spread_s = math.inf
    for start_m in starts:
        source_m = locate_source(times_s, places_m, start_m, sound.speed_m_s, target, scale_s=_SCALE_S)
        rest_s = np.abs(times_s - travel_times(source_m[None], places_m, sound.speed_m_s, target).time_s[0])
        if float(np.median(rest_s)) < spread_s:
            spread_s = float(np.median(rest_s))
            best = Source(source_m, float(np.mean(rest_s < MAX_DELAY_S)))
    return best


def is_line(positions_m: NDArray[np.float64]) -> bool:
    """Return True if microphones lie on a line, which does not determine their positions across it."""
    extent_m = np.linalg.svd(positions_m - positions_m.mean(axis=0), compute_uv=False)
    return bool(np.sum(extent_m > _FLAT_M * math.sqrt(len(positions_m))) < 2)


def _in_front(fit: Fit, positions_m: NDArray[np.float64], speed_m_s: float, target: Target) -> NDArray[np.float64]:
    """Return the approximate source of a wavefront; of two sources at both sides of a flat array, the one in front."""
    centred_m = positions_m - positions_m.mean(axis=0)
    _, extent_m, axes = np.linalg.svd(centred_m, full_matrices=False)
    wide = extent_m > _FLAT_M * np.sqrt(len(positions_m))
    later_s = fit.delay_s - fit.delay_s.mean()
    along = -np.linalg.lstsq(centred_m @ axes[wide].T, later_s, rcond=None)[0] * speed_m_s
    # Errors can make a direction along the array longer than a unit vector.
    direction = axes[wide].T @ (along / max(1.0, float(np.linalg.norm(along)) / 0.999))
    if not wide.all():
        # Of all directions across the array, that nearest to x, which is ahead.
        across = axes[~wide].T @ axes[~wide][:, 0]
        length = float(np.linalg.norm(across))
        across = across / length if length > 1e-6 else axes[~wide][0]
        direction = direction + across * np.sqrt(max(0.0, 1 - float(direction @ direction)))
    range_m = max(fit.emission_s * speed_m_s, 0.1) / (2 if target == "reflector" else 1)
    return np.asarray(range_m * direction / max(float(np.linalg.norm(direction)), 1e-9))

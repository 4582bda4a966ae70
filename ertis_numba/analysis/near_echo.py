"""Echoes from before the first range of an image, which show an obstacle that no image contains."""

import math
from collections.abc import Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.signals import matched, signals_of
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s

__all__ = ["near_echo_m", "near_warning"]

Floats = NDArray[np.float64]

_NEAREST_M: Final = 0.2  # Nearer echoes overlap the direct sound of the emitter.
_STEP_M: Final = 0.004
_BESIDE_M: Final = 0.06  # Distance from the direct sound of other sensors, and from the first range.
_ANGLES_DEG: Final = np.arange(-65.0, 65.1, 5.0)
_AHEAD_DEG: Final = 40.0  # Echoes from farther beside, such as those of the floor, are no obstacles ahead.
_OVERSAMPLING: Final = 4
_COHERENT: Final = 0.5  # Share of the power of all microphones that a beam towards an echo contains.
_DIRECT: Final = 0.03  # Amplitude relative to the direct sound that its side lobes do not reach.
_OTHER: Final = 0.1  # The same of other sensors, whose side lobes are nearer.
_NOISE: Final = 8.0  # Amplitude relative to the median of the record.


def near_echo_m(measurement: Measurement, others_m: Collection[float] = ()) -> float | None:
    """Return the range of an echo from ahead that is stronger than all echoes in the image; None without one.

    ``others_m`` are the paths of the direct sound of other emitters, which resembles echoes from half of the path. A
    later call counts as a longer path.
    """
    settings = measurement.settings
    first_m, last_m = settings.processing.range_m
    range_m = np.arange(_NEAREST_M, first_m - _BESIDE_M, _STEP_M)
    for other_m in others_m:
        range_m = range_m[np.abs(range_m - other_m / 2) > _BESIDE_M]
    if not len(range_m) or measurement.stamp.behaviour == "passive":
        return None
    layout, speed_m_s = microphones(settings.array), sound_speed_m_s(settings.air)
    settings = settings.replace(call=settings.call.replace(delay_s=0.0))  # Times are those since the record begins.
    start_s, rate_hz = measurement.settings.call.start_s, settings.signal_rate_hz
    last_s = start_s + 2 * last_m / speed_m_s + settings.call.end_s
    needed = math.ceil(last_s * settings.recording.sample_rate_hz)
    signals = matched(signals_of(measurement, settings=settings, max_samples=needed), settings)
    power = np.mean(np.abs(signals) ** 2, axis=0)
    path_m = (np.arange(len(power)) / rate_hz - start_s) * speed_m_s
    in_image = power[path_m >= 2 * (first_m - _BESIDE_M / 2)].max(initial=0.0)
    direct = power[path_m < 2 * _NEAREST_M].max(initial=0.0)
    beside = np.abs(path_m[:, None] - np.array([*others_m])).min(axis=1, initial=np.inf) < 2 * _BESIDE_M
    direct = max(direct, (_OTHER / _DIRECT) ** 2 * power[beside].max(initial=0.0))
    least = max(in_image, _DIRECT**2 * direct, _NOISE**2 * float(np.median(power)))
    sought = np.abs(path_m[:, None] / 2 - range_m).min(axis=1) < _STEP_M
    if power[sought].max(initial=0.0) <= least:  # A beam contains no more.
        return None
    begin = (start_s + layout.delay_s[layout.enabled]) * rate_hz
    beams, total = _beams(signals, layout.enabled_positions_m, range_m, rate_hz / speed_m_s, begin)
    is_ahead = (np.abs(np.meshgrid(_ANGLES_DEG, _ANGLES_DEG)) <= _AHEAD_DEG).all(axis=0).ravel()
    while beams.max() > least:
        direction, place = np.unravel_index(beams.argmax(), beams.shape)
        if is_ahead[direction] and beams[direction, place] > _COHERENT * total[direction, place]:
            return float(range_m[place])
        beams[:, np.abs(range_m - range_m[place]) < _BESIDE_M] = 0.0
    return None


def near_warning(sensor: str, range_m: float, first_m: float, *, is_alone: bool) -> str:
    """Return a warning of an echo from before the first range."""
    other = "" if is_alone else ", perhaps of another sensor's call"
    return (
        f"sensor {sensor}: the strongest echo comes from {range_m:.2g} m{other}, before the first range of "
        f"{first_m:.2g} m. Images do not show it, and space behind an obstacle there may appear free; start images "
        "nearer (processing.range_m, --range)"
    )


def _beams(
    signals: NDArray[np.complex64], mics_m: Floats, range_m: Floats, samples_1_m: float, begin: Floats
) -> tuple[Floats, Floats]:
    """Return the powers of beams ahead, and those of all microphones at the same times: (direction, range) float64."""
    # `begin` (mic,) is the sample at which the emission begins in each channel.
    count = signals.shape[1]
    spectra = np.zeros((len(signals), _OVERSAMPLING * count), np.complex64)
    spectra[:, : count // 2] = np.fft.fft(signals, axis=1)[:, : count // 2]
    fine = np.fft.ifft(spectra, axis=1) * _OVERSAMPLING
    azimuth_rad, elevation_rad = np.radians(np.meshgrid(_ANGLES_DEG, _ANGLES_DEG)).reshape(2, -1)
    beams, total = np.zeros((2, len(azimuth_rad), len(range_m)))
    for place, each_m in enumerate(range_m):
        # A wall reflects sound as if it came from the image of the emitter behind it; a post is nearer.
        source_m = 2 * each_m * unit_vectors(azimuth_rad, elevation_rad)
        path_m = np.linalg.norm(source_m[:, None] - mics_m, axis=2)
        column = np.rint((begin + path_m * samples_1_m) * _OVERSAMPLING).astype(np.int64).clip(0, fine.shape[1] - 1)
        heard = fine[np.arange(len(mics_m)), column]
        beams[:, place] = np.abs(heard.mean(axis=1)) ** 2
        total[:, place] = np.mean(np.abs(heard) ** 2, axis=1)
    return beams, total

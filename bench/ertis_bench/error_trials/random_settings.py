"""Random measurements of random sensors: any array, call, record, image and error budget, drawn from a seed."""

import math
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Accuracy, Air, Array, Call, Processing, Recording, Settings
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS, BeamformerName, WeightingName

__all__ = ["DrawLimits", "random_measurement", "random_settings", "recorded"]

_DRAWS = 100  # Draws that constructors may refuse, before the limits are considered too narrow.

_ENCODINGS: Final[tuple[Literal["pdm", "int16", "float32"], ...]] = ("pdm", "pdm", "int16", "float32")
_PLAIN: Final[tuple[BeamformerName, WeightingName]] = ("delay_and_sum", "none")
_COMBINATIONS: Final[tuple[tuple[BeamformerName, WeightingName], ...]] = (_PLAIN, _PLAIN, *ADAPTIVE_COMBINATIONS)


@dataclass(frozen=True, slots=True)
class DrawLimits:
    """Maximum sizes of random settings, which keep slow references feasible.

    Attributes
    ----------
    max_samples : int
        Samples of a record.
    max_mics : int
    max_directions, max_ranges : int
    max_products : int
        Products of ``dmas``, which a reference may write out.
    """

    max_samples: int = 60_000
    max_mics: int = 32
    max_directions: int = 5
    max_ranges: int = 120
    max_products: int = 5_000


def random_measurement(seed: int, limits: DrawLimits | None = None) -> Measurement:
    """Return a measurement whose settings and words are drawn from a seed.

    Words contain noise, echoes from random positions, or both; see `random_settings`.
    """
    random = np.random.default_rng(seed)
    settings = random_settings(random, limits or DrawLimits())
    return Measurement(_words(random, settings), settings)


def random_settings(random: np.random.Generator, limits: DrawLimits) -> Settings:
    """Return valid and complete settings.

    They cover short calls, calls without ramps, PDM and PCM, and every beamformer.
    """
    refused = ""
    for _ in range(_DRAWS):
        try:
            return _drawn(random, limits)
        except ArgumentError as error:
            refused = str(error)
    raise ArgumentError(f"{_DRAWS} draws gave no valid settings; the last error: {refused}. Widen the limits")


def _drawn(random: np.random.Generator, limits: DrawLimits) -> Settings:
    array, call, recording = _array(random, limits), _call(random), _recording(random, limits)
    air = Air(temperature_c=float(random.uniform(-10, 40)), humidity_percent=float(random.uniform(5, 95)))
    return Settings(
        array=array,
        call=call,
        recording=recording,
        air=air,
        processing=_processing(random, limits, call, recording, len(microphones(array).enabled_positions_m), air),
        accuracy=Accuracy(max_error_db=float(random.choice([-20.0, -35.0, -60.0, -100.0, random.uniform(-110, -15)]))),
    )


def _array(random: np.random.Generator, limits: DrawLimits) -> Array:
    """Return a shipped layout, or microphones on a line, in a plane or in a volume.

    Every third array is calibrated.
    """
    kind = random.choice(["shipped", "line", "plane", "cloud"])
    if kind == "shipped" and limits.max_mics >= 32:
        return Array(layout=str(random.choice(["eRTIS_v3D1", "eRTIS_v2", "uRTIS_v1"])))
    n_mics = int(random.integers(2, min(12, limits.max_mics) + 1))
    places_m = random.uniform(-0.03, 0.03, (n_mics, 3))
    places_m[:, {"line": [0, 2], "plane": [0]}.get(str(kind), [])] = 0.0
    calibrated = random.integers(3) == 0
    return Array(
        layout="random",
        positions_m=tuple(map(tuple, places_m.tolist())),
        gain=tuple(random.uniform(0.5, 2.0, n_mics).tolist()) if calibrated else None,
        delay_s=tuple(random.uniform(-2e-6, 2e-6, n_mics).tolist()) if calibrated else None,
        word_bits=int(random.choice([8, 16, 32, 64])),
    )


def _call(random: np.random.Generator) -> Call:
    """Return a sweep of 0.05 to 5 ms. Every third sweep has no ramp, so that it starts and ends with a step."""
    low_hz = float(random.uniform(5e3, 45e3))
    high_hz = float(random.uniform(1.1 * low_hz, 90e3))
    edges_hz = (high_hz, low_hz) if random.integers(2) else (low_hz, high_hz)
    return Call(
        start_frequency_hz=edges_hz[0],
        stop_frequency_hz=edges_hz[1],
        duration_s=float(10 ** random.uniform(math.log10(5e-5), math.log10(5e-3))),
        ramp_fraction=0.0 if random.integers(3) == 0 else float(random.uniform(0, 0.5)),
        modulation="linear" if random.integers(2) else "hyperbolic",
    )


def _recording(random: np.random.Generator, limits: DrawLimits) -> Recording:
    encoding = _ENCODINGS[random.integers(len(_ENCODINGS))]
    rate_hz = random.choice([4.5e6, 4.5e6, 3.072e6, 2.4e6] if encoding == "pdm" else [1e6, 4.5e5, 3.84e5, 2.5e5])
    longest = min(limits.max_samples, int(15e-3 * rate_hz))
    return Recording(
        sample_rate_hz=float(rate_hz), n_samples=int(random.integers(longest // 3, longest + 1)), encoding=encoding
    )


def _processing(
    random: np.random.Generator, limits: DrawLimits, call: Call, recording: Recording, n_mics: int, air: Air
) -> Processing:
    """Return processing settings for an image within the record, with at most the limit's number of ranges."""
    low_hz, high_hz = call.low_frequency_hz, call.high_frequency_hz
    step = max(1, round(recording.sample_rate_hz / (high_hz - low_hz + 10e3) / random.uniform(1.0, 3.0)))
    step = max(1, min(step - step % 10 if step > 20 else step, 2_000))  # Round numbers have more divisors.
    step_m = sound_speed_m_s(air) / 2 * step / recording.sample_rate_hz
    record_m = sound_speed_m_s(air) / 2 * recording.duration_s
    width_m = step_m * float(random.uniform(2, limits.max_ranges))
    first_m = max(0.0, float(random.uniform(-0.2, 0.8)) * (record_m - width_m))
    beamformer, weighting = _COMBINATIONS[random.integers(len(_COMBINATIONS))]
    orders = [order for order in range(2, min(8, n_mics) + 1) if math.comb(n_mics, order) <= limits.max_products]
    spherical = beamformer != "capon" and random.integers(2) == 0
    widened = random.integers(5) == 0
    edges_hz = (low_hz * float(random.uniform(0.1, 0.9)), high_hz + float(random.uniform(1e3, 2e4)))
    return Processing(
        directions=f"{random.choice(['2d', '3d'])}:{random.integers(1, limits.max_directions + 1)}",
        range_m=(first_m, min(first_m + width_m, record_m)),
        range_decimation=step,
        wavefront="spherical" if spherical else "plane",
        beamformer=beamformer,
        weighting=weighting,
        dmas_order=int(random.choice(orders)),
        snapshots=int(random.integers(1, 9)),
        diagonal_loading=float(10 ** random.uniform(-3, 1)),
        band_edges_hz=edges_hz if widened else None,
    )


def _words(random: np.random.Generator, settings: Settings) -> NDArray[Any]:
    """Return the words of some echoes in white noise. Levels range from near silence to inaudible echoes."""
    layout, recording = microphones(settings.array), settings.recording
    speed_m_s = sound_speed_m_s(settings.air)
    time_s = np.arange(recording.n_samples) / recording.sample_rate_hz
    positions_m = np.zeros((len(layout.enabled), 3))
    positions_m[layout.enabled] = layout.enabled_positions_m
    signals = 10 ** random.uniform(-4, -0.7) * random.standard_normal((len(positions_m), recording.n_samples))
    first_m, last_m = settings.processing.range_m
    for _ in range(random.integers(0, 5)):
        toward = random.standard_normal(3) + np.array([1.5, 0.0, 0.0])
        range_m = random.uniform(first_m, max(last_m, first_m + 0.01))
        place_m = range_m * toward / np.linalg.norm(toward)
        arrival_s = (range_m + np.linalg.norm(place_m - positions_m, axis=1)) / speed_m_s
        level = 10 ** random.uniform(-2, -0.5)
        signals += level * np.stack([call_at(settings.call, time_s - late_s) for late_s in arrival_s])
    return recorded(random, np.clip(signals, -1, 1), settings)


def recorded(random: np.random.Generator, signals: NDArray[np.float64], settings: Settings) -> NDArray[Any]:
    """Return signals as the converters of a sensor would store them: numbers, or dithered bits packed into words."""
    recording, form = settings.recording, sample_format(settings)
    if not recording.is_pdm:
        scaled = signals.T * recording.full_scale
        limit = recording.full_scale - 1
        whole = recording.encoding == "int16"
        return np.ascontiguousarray(np.clip(np.rint(scaled), -limit, limit) if whole else scaled).astype(form.dtype)
    bits = signals > random.uniform(-1, 1, signals.shape)
    word_bits = 8 * form.dtype.itemsize
    padded = np.zeros((form.shape_2d[1] * word_bits, signals.shape[1]), dtype=bool)
    padded[: len(bits)] = bits
    octets = np.packbits(padded.T, axis=1, bitorder="little")
    return np.ascontiguousarray(octets).view(form.dtype.newbyteorder("<")).reshape(form.shape)

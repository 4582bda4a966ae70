"""Noise of images, and amplitude thresholds above the noise."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import checks
from ertis_numba.frames import Energyscape
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Processing

__all__ = ["EchoFloor", "audible", "echo_floor", "medians_of", "noise_of", "threshold_of"]

_ROUNDING = 10 ** (-140 / 20)  # For one-bit microphones: their noise is at least 40 dB above, arithmetic 10 dB below.
_SAMPLE = 32_768  # Number of bins from which the noise is estimated, with an accuracy of 1 %.
_BLOCKS = 16  # Number of blocks of ranges with separate estimates of the noise.
_LONG_BLOCKS = 4  # The same for the noise of single directions.
_DENSE = 131_072  # Number of bins from which the noise of all directions is estimated.
_CAPON = 1.5  # Exponent of the amplitude of noise.
_LEAST = 8  # Ranges that a click is spread over at least.
_PER_CALL = 2  # Number of blocks of ranges in the range that the matched filter spreads a click over.
_FALLEN = 10 ** (-40.0 / 20)  # Amplitude relative to that of an echo to which its slopes fall at least.
_QUIET = 1 / 3  # Quantile of these estimates: side lobes raise those near echoes, and chance lowers the lowest.


class EchoFloor(NamedTuple):
    """Amplitude that noise reaches anywhere in an image with a given probability.

    - ``by_direction`` (direction,): threshold for noise that lasts for the whole record.
    - ``by_range`` (range,): that for noise that changes within the record. Side lobes of strong echoes raise it, too.
    - ``n_around``: number of ranges that the matched filter spreads a click over.
    - ``ratio``: threshold relative to the median of the noise.
    - ``exponent``: the noise is distributed as a Rayleigh variable to this power.
    """

    by_direction: NDArray[np.float32]
    by_range: NDArray[np.float32]
    n_around: int
    ratio: float
    exponent: float

    @property
    def lasting(self) -> float:
        """Highest threshold for noise that lasts for the whole record."""
        return float(self.by_direction.max())

    def at(
        self,
        amplitude: NDArray[np.float32],
        direction: NDArray[np.intp],
        place: NDArray[np.intp],
        *quantiles: float,
    ) -> NDArray[np.float32]:
        """Return thresholds (quantile, bin) of some bins of the image, also for clicks from their direction."""
        # Their noise is a quantile of the amplitudes around a bin, without the slopes of its own echo.
        first = np.array([1 - self.n_around, -self.n_around // 2, 0])  # A click may begin or end at the bin.
        clicks = np.empty((len(quantiles), len(place)), np.float32)
        given = np.ascontiguousarray(amplitude), direction, place, first, self.n_around, np.array(quantiles)
        kernels.load_points().noise_around(*given, np.float32(_FALLEN), clicks)
        # Noise from one direction is coherent there, so that no beamformer changes its distribution.
        spread = np.array([(math.log(2) / -math.log1p(-each)) ** 0.5 for each in quantiles])
        clicks *= (self.ratio ** (1 / self.exponent) * spread).astype(np.float32)[:, None]
        return np.maximum(np.maximum(self.by_direction[direction], self.by_range[place]), clicks)


def noise_of(image: Energyscape) -> float:
    """Return the root mean square of the noise of an image; 0 if it is unknown."""
    # The lower tercile of estimates from medians of blocks; unknown if not Rayleigh-distributed, as in cleaned images.
    processing = image.settings.processing
    if processing.is_adaptive or processing.is_cleaned or not image.amplitude.size:
        return 0.0
    some = audible(image, image.amplitude[:: max(1, image.amplitude.size // _SAMPLE)])
    level = float(_quiet(_medians_of_blocks(some, min(_BLOCKS, some.shape[1]))[None])[0])
    return level / math.sqrt(math.log(2))


def medians_of(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the median of each row; NaN for rows with NaN."""
    # Nine times as fast as `numpy.median`, which partitions at several places without vector instructions.
    return _medians_in_place(rows.copy())


def _medians_in_place(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the medians of rows, whose order is lost."""
    half = rows.shape[1] // 2
    rows.partition(half, axis=1)
    median = rows[:, half]
    if rows.shape[1] % 2 == 0:
        median = (rows[:, :half].max(axis=1) + median) / 2
    return np.where(np.isnan(rows[:, half:].max(axis=1)), np.float32(np.nan), median)


def _medians_of_blocks(amplitude: NDArray[np.float32], n_blocks: int) -> NDArray[np.float32]:
    """Return the median of each block of ranges, of which the first ones may be longer by one: (block,) float32."""
    width, n_longer = divmod(amplitude.shape[1], n_blocks)
    split = n_longer * (width + 1)
    parts = (amplitude[:, :split], width + 1), (amplitude[:, split:], width)
    return np.concatenate(
        [
            _medians_in_place(
                part.reshape(len(part), -1, columns).swapaxes(0, 1).copy().reshape(-1, len(part) * columns)
            )
            for part, columns in parts
            if part.size
        ]
    )


def threshold_of(image: Energyscape, false_alarm: float | None) -> float:
    """Return the amplitude that noise reaches anywhere in an image with a probability; 0 if either is unknown."""
    # A bin exceeds t with the probability `exp(-t²/s²)`, and all bins count as independent. PDM: at least -140 dBFS.
    if false_alarm is None:
        return 0.0
    checks.between("false_alarm", false_alarm, 1e-12, 1.0)
    smallest = _ROUNDING if image.settings.recording.is_pdm else 0.0
    return max(smallest, noise_of(image) * math.sqrt(math.log(max(1, image.amplitude.size) / false_alarm)))


def echo_floor(image: Energyscape, false_alarm: float) -> EchoFloor:
    """Return the amplitude that noise reaches anywhere in an image with the approximate probability ``false_alarm``."""
    # Unlike `threshold_of`, it follows noise that differs between directions and between ranges, for all beamformers.
    settings, amplitude = image.settings, image.amplitude
    n_directions, n_ranges = amplitude.shape
    exponent = _exponent(settings.processing)
    if settings.processing.is_cleaned:
        strongest = amplitude.max(axis=0, keepdims=True)
        median = _quiet(_medians_of_blocks(strongest, min(_BLOCKS, n_ranges))[None])
    else:
        some = audible(image, amplitude[:, :: max(1, amplitude.size // _DENSE)])
        width = max(1, some.shape[1] // _LONG_BLOCKS)
        blocks = some[:, : some.shape[1] // width * width].copy().reshape(-1, width)
        medians = _medians_in_place(blocks).reshape(n_directions, -1)
        median = np.maximum(_quiet(medians), _quiet(medians_of(medians.T)[None]))
    ratio = (math.log(amplitude.size / false_alarm) / math.log(2)) ** (exponent / 2)
    smallest = 0.0 if settings.recording.encoding == "float32" else _ROUNDING**exponent
    spread_m = settings.call.duration_s * sound_speed_m_s(settings.air) / 2
    step_m = (image.range_m[-1] - image.range_m[0]) / max(1, n_ranges - 1)
    n_around = max(_LEAST, min(n_ranges, round(spread_m / step_m))) if step_m else 1
    return EchoFloor(
        np.broadcast_to(np.maximum(smallest, ratio * median).astype(np.float32), n_directions),
        (ratio * _medians_by_range(image, n_around)).astype(np.float32),
        n_around,
        ratio,
        exponent,
    )


def audible(image: Energyscape, some: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return some amplitudes of an image, at least its lowest 8-bit level, because zeros are levels below it."""
    heard = some[some > 0] if image.level_step_db and not image.settings.processing.is_cleaned else some[:0]
    return np.maximum(some, heard.min()) if heard.size else some


def _medians_by_range(image: Energyscape, n_around: int) -> NDArray[np.float32]:
    """Return the highest median of the blocks of ranges around each range: (range,) float32."""
    n_ranges = len(image.range_m)
    n_blocks = max(1, _PER_CALL * n_ranges // n_around)
    some = audible(image, image.amplitude[:: max(1, image.amplitude.size // _SAMPLE)])
    medians = _medians_of_blocks(some, n_blocks)
    padded = np.pad(medians, 1, mode="edge")
    around = np.maximum(medians, np.maximum(padded[:-2], padded[2:]))
    width, n_longer = divmod(n_ranges, n_blocks)
    return np.repeat(around, [width + 1] * n_longer + [width] * (n_blocks - n_longer))


def _quiet(medians: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the lower tercile of the medians of blocks: (row,) float64, from (row, block)."""
    place = _QUIET * (medians.shape[1] - 1)
    before = int(place)
    ordered = np.sort(medians.astype(np.float64), axis=1)  # `numpy.quantile` takes ten times as long.
    low, high = ordered[:, before], ordered[:, min(before + 1, medians.shape[1] - 1)]
    return np.asarray(low + (place - before) * (high - low))


def _exponent(processing: Processing) -> float:
    """Return the power of the amplitude of delay-and-sum that the amplitude of noise is proportional to, about."""
    own = {"dmas": float(processing.dmas_order), "capon": _CAPON}.get(processing.beamformer, 1.0)
    return own + (2.0 if processing.weighting == "coherence_factor" else 0.0)

"""Noise of images, and amplitude thresholds above the noise."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.frames import Energyscape

__all__ = ["medians_of", "noise_of", "threshold_of"]

_ROUNDING = 10 ** (-140 / 20)  # For one-bit microphones: their noise is at least 40 dB above, arithmetic 10 dB below.
_SAMPLE = 32_768  # Number of bins from which the noise is estimated, with an accuracy of 1 %.
_BLOCKS = 16  # Number of blocks of ranges with separate estimates of the noise.
_QUIET = 1 / 3  # Quantile of these estimates: side lobes raise those near echoes, and chance lowers the lowest.


def noise_of(image: Energyscape) -> float:
    """Return the root mean square of the noise of an image; 0 if it is unknown.

    The result is the lower tercile of estimates from the medians of blocks of ranges. The noise of beamformers other
    than delay-and-sum is unknown, because it is not Rayleigh-distributed. That of cleaned images is unknown, too.
    """
    processing = image.settings.processing
    if processing.is_adaptive or processing.is_cleaned or not image.amplitude.size:
        return 0.0
    some = image.amplitude[:: max(1, image.amplitude.size // _SAMPLE)]
    level = float(np.quantile(_medians_of_blocks(some, min(_BLOCKS, some.shape[1])), _QUIET))
    return level / math.sqrt(math.log(2))


def medians_of(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the median of each row; NaN for rows with NaN.

    `numpy.median` takes nine times as long, because it partitions at several places, without vector instructions.

    Parameters
    ----------
    rows : (row, sample) float32
        At least one sample.
    """
    half = rows.shape[1] // 2
    sorted_half = np.partition(rows, half, axis=1)
    median = sorted_half[:, half]
    if rows.shape[1] % 2 == 0:
        median = (sorted_half[:, :half].max(axis=1) + median) / 2
    return np.where(np.isnan(sorted_half[:, half:].max(axis=1)), np.float32(np.nan), median)


def _medians_of_blocks(amplitude: NDArray[np.float32], n_blocks: int) -> NDArray[np.float32]:
    """Return the median of each block of ranges, of which the first ones may be longer by one: (block,) float32."""
    width, n_longer = divmod(amplitude.shape[1], n_blocks)
    split = n_longer * (width + 1)
    parts = (amplitude[:, :split], width + 1), (amplitude[:, split:], width)
    return np.concatenate(
        [
            medians_of(part.reshape(len(part), -1, columns).swapaxes(0, 1).reshape(-1, len(part) * columns))
            for part, columns in parts
            if part.size
        ]
    )


def threshold_of(image: Energyscape, false_alarm: float) -> float:
    """Return the amplitude that noise reaches anywhere in an image with a given probability; 0 if noise is unknown.

    A bin of noise with root mean square s exceeds t with the probability ``exp(-t²/s²)``. The function treats all bins
    as independent, so the threshold is slightly too high. For one-bit microphones, it is at least -140 dB of full
    scale, because bits that never change leave only rounding errors.

    Parameters
    ----------
    image : Energyscape
    false_alarm : float
        Probability that at least one bin of the image exceeds the threshold, 1e-12 to 1.

    Raises
    ------
    ArgumentError
        ``false_alarm`` is not between 1e-12 and 1.
    """
    checks.between("false_alarm", false_alarm, 1e-12, 1.0)
    smallest = _ROUNDING if image.settings.recording.is_pdm else 0.0
    return max(smallest, noise_of(image) * math.sqrt(math.log(max(1, image.amplitude.size) / false_alarm)))

"""Measured errors of an image relative to the exact one."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import DataError
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.stages.detect import find_peaks
from ertis_numba.verification._exact import ExactImage
from ertis_numba.verification._peaks import PEAKS, PeakErrors, peak_errors

__all__ = ["Measured", "error_db", "exact_image", "measure", "sampled_directions"]

_MAX_OPERATIONS = 8e9  # complex multiplications: some ten seconds


@dataclass(frozen=True, slots=True)
class Measured:
    """The error of an image.

    Attributes
    ----------
    error_db : float
    n_directions : int
        On which it was measured.
    peaks : PeakErrors or None
        None where that was not all directions.
    """

    error_db: float
    n_directions: int
    peaks: PeakErrors | None


def measure(image: Energyscape, measurement: Measurement) -> Measured:
    """Return the error of the image that ``measurement`` was made into, by the settings of the image.

    The exact image is computed in float64, by the definition of the image's beamformer. Where all directions would
    take more than some ten seconds, a sample of them is compared: bright directions are drawn more often, and each
    counts by the inverse of its probability.

    Raises
    ------
    DataError
        The exact image is silent, or the words are not those of the settings.
    """
    exact = ExactImage(image, measurement)
    most = max(1, int(_MAX_OPERATIONS / exact.operations_per_direction))
    if len(image.energy) <= most:
        wanted = np.stack([exact.amplitudes(direction) for direction in range(len(image.energy))])
        return Measured(
            error_db=error_db(image.energy, wanted),
            n_directions=len(wanted),
            peaks=peak_errors(image, find_peaks(image.replace(energy=wanted.astype(np.float32)), top=PEAKS)),
        )
    chosen, weights = sampled_directions(image.energy, most)
    wanted = np.stack([exact.amplitudes(direction) for direction in chosen.tolist()])
    scale = np.sqrt(weights)[:, None]
    return Measured(
        error_db=error_db(scale * image.energy[chosen], scale * wanted), n_directions=len(chosen), peaks=None
    )


def exact_image(image: Energyscape, measurement: Measurement) -> Energyscape:
    """Return the exact image of a measurement on the axes of another image, whose settings count.

    All directions are computed, however long it takes. Amplitudes are rounded to float32 at the end.

    Raises
    ------
    DataError
        The words are not those of the settings.
    """
    exact = ExactImage(image, measurement)
    amplitudes = [exact.amplitudes(direction) for direction in range(len(image.energy))]
    return image.replace(energy=np.stack(amplitudes).astype(np.float32))


def error_db(energy: NDArray[np.floating], exact: NDArray[np.floating]) -> float:
    """Return the norm of the difference by that of the exact image.

    Raises
    ------
    DataError
        The exact image is silent.
    """
    wanted = float(np.linalg.norm(exact.astype(np.float64)))
    if not wanted:
        raise DataError("the exact image is silent, so no error can be measured by it; give a measurement with echoes")
    difference = float(np.linalg.norm(energy.astype(np.float64) - exact))
    return 20 * math.log10(max(1e-15, difference / wanted)) if math.isfinite(difference) else math.inf


def sampled_directions(energy: NDArray[np.float32], count: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return directions and their weights in a sum over all: (direction,) intp, (direction,) float64.

    Systematic sampling with probabilities half even and half by brightness: neighbours are alike, so drawing at equal
    steps of the cumulated probability errs less than drawing at random.
    """
    power = np.sum(np.square(energy, dtype=np.float64), axis=1)
    total = float(power.sum())
    even = np.full(len(power), 1 / len(power))
    probability = (even + power / total) / 2 if 0 < total < math.inf else even
    drawn = np.searchsorted(np.cumsum(probability), (np.arange(count) + 0.5) / count)
    chosen, times = np.unique(np.minimum(drawn, len(power) - 1), return_counts=True)
    return chosen, times / (count * probability[chosen])

"""Measured errors of an image relative to the exact one."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.detect import peaks_of_grid
from ertis_numba.base.errors import DataError
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.pipeline.verification._exact import ExactImage
from ertis_numba.pipeline.verification._peaks import PEAKS, PeakErrors, peak_errors

__all__ = ["Measured", "error_db", "exact_image", "measure", "sampled", "sampled_error_db"]

_MAX_OPERATIONS = 3e9  # Complex multiplications, which take about ten seconds on one core.
_QUICK_OPERATIONS = 3e8
_MIN_DIRECTIONS = 16


@dataclass(frozen=True, slots=True)
class Measured:
    """Norm of an image's difference relative to that of the exact image in dB; ``peaks`` need all directions."""

    error_db: float
    n_directions: int
    peaks: PeakErrors | None


def measure(image: Energyscape, measurement: Measurement) -> Measured:
    """Return the error of the image of a measurement, relative to the exact image with the same settings.

    The exact image is computed in float64, according to the definition of the image's beamformer. If the whole image
    would take more than about ten seconds, a sample is compared: directions for plane wavefronts, single points
    for spherical ones. Bright ones are drawn more often, and each is weighted by the inverse of its probability.
    """
    exact = ExactImage(image, measurement)
    share = _MAX_OPERATIONS / exact.operations_per_direction / len(image.amplitude)
    if share < 1:
        return _measured_in_part(image, exact, share=share)
    wanted = _whole(image, exact)
    replaced = image.replace(amplitude=wanted.astype(np.float32))
    return Measured(
        error_db=error_db(image.amplitude, wanted),
        n_directions=len(wanted),
        peaks=peak_errors(image, peaks_of_grid(replaced, top=PEAKS, false_alarm=None)),
    )


def sampled_error_db(image: Energyscape, measurement: Measurement, *, max_directions: int) -> float:
    """Return the error of an image, measured in a sample of directions that takes at most about a second."""
    exact = ExactImage(image, measurement)
    count = min(max_directions, max(_MIN_DIRECTIONS, int(_QUICK_OPERATIONS / exact.operations_per_direction)))
    if count >= len(image.amplitude):
        return error_db(image.amplitude, _whole(image, exact))
    return _measured_in_part(image, exact, share=count / len(image.amplitude)).error_db


def _measured_in_part(image: Energyscape, exact: ExactImage, *, share: float) -> Measured:
    """Return the error measured on a share of the directions, or of the image points for spherical wavefronts."""
    power = np.square(image.amplitude, dtype=np.float64)
    by_place = image.settings.processing.wavefront == "spherical"
    power = power if by_place else power.sum(axis=1, keepdims=True)
    chosen, weights = sampled(power.ravel(), max(1, int(share * power.size)))
    directions, ranges = np.divmod(chosen, power.shape[1])
    pairs = []
    with one_thread():
        for direction in np.unique(directions).tolist():
            mine = directions == direction
            places = ranges[mine] if by_place else np.arange(image.amplitude.shape[1])
            both = np.stack([image.amplitude[direction, places], exact.amplitudes(direction, places)])
            pairs.append(np.sqrt(weights[mine]) * both)
    found, wanted = np.concatenate(pairs, axis=1)
    return Measured(error_db=error_db(found, wanted), n_directions=len(pairs), peaks=None)


def exact_image(image: Energyscape, measurement: Measurement) -> Energyscape:
    """Return the exact image of a measurement in all directions, with another's axes and settings; no time limit."""
    return image.replace(amplitude=_whole(image, ExactImage(image, measurement)).astype(np.float32))


def _whole(image: Energyscape, exact: ExactImage) -> NDArray[np.float64]:
    ranges = np.arange(image.amplitude.shape[1])
    with one_thread():
        return np.stack([exact.amplitudes(direction, ranges) for direction in range(len(image.amplitude))])


def error_db(amplitude: NDArray[np.floating], exact: NDArray[np.floating]) -> float:
    """Return the norm of the difference relative to the exact image's; raise DataError if that is silent."""
    wanted = float(np.linalg.norm(exact.astype(np.float64)))
    if not wanted:
        raise DataError(
            "the exact image is silent, so the error relative to it is undefined; use a measurement with echoes"
        )
    difference = float(np.linalg.norm(amplitude.astype(np.float64) - exact))
    return 20 * math.log10(max(1e-15, difference / wanted)) if math.isfinite(difference) else math.inf


def sampled(power: NDArray[np.float64], count: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return a sample of items, and their weights in an estimate of the sum over all items."""
    # Half of the probability is uniform, and half is proportional to power. Sampling is systematic: neighbours are
    # alike.
    total = float(power.sum())
    even = np.full(len(power), 1 / len(power))
    probability = (even + power / total) / 2 if 0 < total < math.inf else even
    drawn = np.searchsorted(np.cumsum(probability), (np.arange(count) + 0.5) / count)
    chosen, times = np.unique(np.minimum(drawn, len(power) - 1), return_counts=True)
    return chosen, times / (count * probability[chosen])

"""Detection of bins that stand out along the range, at a constant false alarm rate (CFAR)."""

import math
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.analysis.noise import audible
from ertis_numba.analysis.range_cleaning import clean
from ertis_numba.analysis.side_lobes import SIDE_LOBE_DB
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape, Peak
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["METHODS", "Method", "cfar", "cfar_peaks", "threshold_factor"]

Method = Literal["ordered_statistic", "cell_averaging", "greatest_of"]
METHODS: tuple[Method, ...] = ("ordered_statistic", "cell_averaging", "greatest_of")
"""Estimators of the noise from the reference bins: OS-CFAR, CA-CFAR and GO-CFAR."""

_RANK = 0.75  # Rank relative to the number of reference bins, after H. Rohling; a quarter of them may hold reflectors.
_GUARD = 6.0  # Guard cells on each side, in resolutions: a compressed pulse is 26 dB down there, below the threshold.


def cfar(
    image: Energyscape,
    *,
    false_alarm: float = 1e-4,
    method: Method = "ordered_statistic",
    n_reference: int = 32,
) -> NDArray[np.bool_]:
    """Detect bins that exceed the noise around them along the range, at a constant false alarm rate (CFAR).

    Each bin is compared with reference bins (training cells) of the same direction, half of them before and half
    behind it. They are a resolution ``c / 2B`` apart, so their noise is independent. Six resolutions on each side of
    the bin are guard cells, because its own echo extends there. At both ends of the range axis, all reference bins come
    from one side.

    In Rayleigh-distributed noise, such as that of delay-and-sum, the share of detected bins is ``false_alarm`` at any
    noise level. Beside a step of the noise level, the share is smaller on the lower side. The page
    docs/how-to/plots.md has the share on the higher side and beside reflectors.

    Parameters
    ----------
    image : Energyscape
    false_alarm : float
        Probability of a false alarm per bin, 1e-9 to 0.5; 1e-4 by default.
    method : {"ordered_statistic", "cell_averaging", "greatest_of"}
        Estimator of the noise: a high rank of the reference bins (OS-CFAR), their mean (CA-CFAR) or the greater mean of
        two halves (GO-CFAR). OS-CFAR detects a reflector beside others that fill up to a quarter of the reference bins.
        CA-CFAR detects the weakest single reflector. GO-CFAR has the fewest false alarms where the noise level changes.
    n_reference : int
        Number of reference bins, an even number from 4 to 512; 32 by default.

    Returns
    -------
    (direction, range) bool
        True for detected bins.

    Raises
    ------
    ArgumentError
        An argument is invalid, the image has too few ranges, or it is cleaned.
    """
    checks.instance("image", image, Energyscape, "Pipeline.process returns")
    if image.settings.processing.is_cleaned:
        raise ArgumentError(
            "image is cleaned by processing.clean_within_db or clean_above_mean_db, so its noise is unknown; "
            "process the recording without them"
        )
    factor = threshold_factor(method, n_reference, false_alarm)
    places = _reference(image, n_reference)
    amplitude = audible(image, image.amplitude)
    if method == "ordered_statistic":
        # A bin exceeds a multiple of the k-th lowest reference bin if it exceeds that multiple of k bins. This needs no
        # sorting.
        lowered = amplitude / np.float32(math.sqrt(factor))
        beaten = np.zeros(amplitude.shape, dtype=np.uint16)
        for row in places:
            beaten += lowered > np.take(amplitude, row, axis=1)
        return beaten >= _rank(n_reference)
    power = np.square(amplitude / (amplitude.max(initial=0.0) or np.float32(1)))
    half = n_reference // 2
    sums = [np.zeros_like(power), np.zeros_like(power)]
    for number, row in enumerate(places):
        sums[number // half] += np.take(power, row, axis=1)  # Advanced indexing takes 17 times as long.
    mean = (sums[0] + sums[1]) / n_reference if method == "cell_averaging" else np.maximum(*sums) / half
    return np.asarray(power > np.float32(factor) * mean)


def threshold_factor(method: Method, n_reference: int, false_alarm: float) -> float:
    """Return the CFAR threshold: the ratio of a bin's power to the noise estimate above which the bin is detected.

    The false-alarm probability P depends on the threshold factor α and on the estimator of the noise:

    - Mean of the N reference bins: ``P = (1 + α/N)^−N`` (H. M. Finn and R. S. Johnson, RCA Review 29, 1968).
    - k-th lowest bin, k = 3N/4, rounded: ``P = Π_{i<k} (N − i) / (N − i + α)`` (H. Rohling, IEEE Trans. AES 19, 1983).
    - Greater mean of two halves of n = N/2 bins: ``P / 2 = (1 + α/n)^−n − Σ_{i<n} C(n+i−1, i) (2 + α/n)^−(n+i)``
      (V. G. Hansen and J. H. Sawyers, IEEE Trans. AES 16, 1980).

    Parameters
    ----------
    method : {"ordered_statistic", "cell_averaging", "greatest_of"}
    n_reference : int
        Number of reference bins, an even number from 4 to 512.
    false_alarm : float
        Probability of a false alarm per bin, 1e-9 to 0.5.

    Returns
    -------
    float
        α, a ratio of powers.

    Examples
    --------
    >>> from ertis_numba.analysis.cfar import threshold_factor
    >>> round(threshold_factor("cell_averaging", 32, 1e-4), 2)
    10.67
    """
    checks.choice("method", method, METHODS)
    checks.between("false_alarm", false_alarm, 1e-9, 0.5)
    if checks.integer("n_reference", n_reference, 4, 512) % 2:
        raise ArgumentError(f"n_reference is {n_reference}; use an even number, with half the bins on each side")
    if method == "cell_averaging":
        return float(n_reference * (false_alarm ** (-1 / n_reference) - 1))
    log_of = _log_ordered if method == "ordered_statistic" else _log_greatest
    largest = 1.0
    while log_of(largest, n_reference) > math.log(false_alarm):
        largest *= 2
    root = scipy.optimize.brentq(lambda factor: log_of(factor, n_reference) - math.log(false_alarm), 0.0, largest)
    return float(root)


def _rank(n_reference: int) -> int:
    return round(_RANK * n_reference)


def _log_ordered(factor: float, n_reference: int) -> float:
    left = n_reference - np.arange(_rank(n_reference))
    return -float(np.sum(np.log1p(factor / left)))


def _log_greatest(factor: float, n_reference: int) -> float:
    half = n_reference // 2
    ratio = factor / half
    both = [math.log(math.comb(half + i - 1, i)) - (half + i) * math.log(2 + ratio) for i in range(half)]
    return math.log(2 * ((1 + ratio) ** -half - math.fsum(map(math.exp, both))))


def _reference(image: Energyscape, n_reference: int) -> NDArray[np.intp]:
    """Return the nearest reference ranges of each range, in ascending order: (reference, range) intp."""
    n_ranges = len(image.range_m)
    step, guard = 1, 1
    if n_ranges > 1:
        resolution_m, spacing_m = _resolution_m(image.settings), float(image.range_m[1] - image.range_m[0])
        step = max(1, math.ceil(resolution_m / spacing_m * (1 - 1e-9)))
        guard = max(1, math.ceil(_GUARD * resolution_m / spacing_m))
    needed = step * (n_reference + 2) + 2 * guard + 1
    if n_ranges < needed:
        raise ArgumentError(
            f"image has {n_ranges} ranges, but {n_reference} reference bins need {needed}; choose an image with a "
            "wider range window, or a smaller n_reference"
        )
    here = np.arange(n_ranges)
    before, behind = (np.maximum(room - guard, 0) // step for room in (here, n_ranges - 1 - here))
    n_behind = np.minimum(behind, n_reference - np.minimum(before, n_reference // 2))
    n_before = n_reference - n_behind
    number = np.arange(n_reference)[:, None]
    first, last = here - guard - step * (n_before - number), here + guard + step * (number - n_before + 1)
    return np.asarray(np.where(number < n_before, first, last))


def _resolution_m(settings: Settings) -> float:
    call = settings.call
    bandwidth_hz = max(call.high_frequency_hz - call.low_frequency_hz, 1 / call.duration_s)
    return sound_speed_m_s(settings.air) / (2 * bandwidth_hz)


def cfar_peaks(
    image: Energyscape,
    *,
    false_alarm: float = 1e-4,
    method: Method = "ordered_statistic",
    within_db: float = SIDE_LOBE_DB,
    top: int | None = 10,
    min_level_db: float = -200.0,
) -> list[Peak]:
    """Return the reflectors that exceed the noise around them, strongest first.

    The result is that of `find_peaks`, restricted to the bins that `cfar` detects and `clean` keeps.

    Parameters
    ----------
    image : Energyscape
    false_alarm : float
        Probability of a false alarm per bin, 1e-9 to 0.5; 1e-4 by default. In noise alone, the share of bins that are
        peaks is smaller, because a peak must also exceed its neighbours.
    method : {"ordered_statistic", "cell_averaging", "greatest_of"}
        Estimator of the noise: see `cfar`.
    within_db : float
        Largest level below the strongest direction of the same range; `SIDE_LOBE_DB`, 10 dB, by default.
    top : int, optional
        Maximum number of reflectors; 10 by default, None for all.
    min_level_db : float
        Minimum level relative to the strongest reflector; -200 dB by default.

    Raises
    ------
    ArgumentError
        An argument is invalid, the image has too few ranges, or it is cleaned.

    Examples
    --------
    Detect weak reflectors at any range, with few false alarms::

        with ertis.open_recording("data/synthetic/reflectors.h5") as recording:
            measurement = recording[0]
        image = ertis.Pipeline(measurement.settings).process(measurement)
        peaks = ertis.cfar_peaks(image, false_alarm=1e-6, top=None)
    """
    stands_out = cfar(image, false_alarm=false_alarm, method=method)
    stands_out &= clean(image, within_db=within_db).amplitude > 0
    return find_peaks(image, top=top, min_level_db=min_level_db, where=stands_out, false_alarm=None)

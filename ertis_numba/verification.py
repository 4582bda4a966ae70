"""The exact image in seconds rather than hours, and by how much another one differs from it.

Single precision, weights fitted over six samples, every direction's own beam: some 120 dB below the image, this is
what the float64 referee of the tests and benchmarks finds, at a thousandth of its time.
"""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import DataError
from ertis_numba.frames import Energyscape, Measurement, Peak
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.kernels import KernelSet
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Settings
from ertis_numba.stages.detect import find_peaks
from ertis_numba.stages.planner import Planner
from ertis_numba.stages.window import time_window

__all__ = ["PEAKS", "Measured", "PeakErrors", "error_db", "exact_image", "exact_plan", "measure", "peak_errors"]

PEAKS = 10
"""Of the strongest reflectors, how many are compared."""

_EXACT = Accuracy(
    precision="float32", oversampling=6, delay_taps=6, beam_taps=0, beam_density=2.0, stop_band_db=140.0, zones=1
)
_PHASES = (6, 8, 12, 16, 24, 32, 48, 64)
_DELAYS = 10 ** (-120 / 10)
_BELOW = 10 ** (-20 / 10)  # of the budget, what zones may add to the exact image
_MOST_BEAMS = 100_000  # directions times zones: ten seconds
_NEAR_DEG, _NEAR_M = 5.0, 0.02  # half a main lobe and half a pulse: what lies further off is another reflector


@dataclass(frozen=True, slots=True)
class PeakErrors:
    """How the strongest reflectors of the exact image are shown by another one.

    Attributes
    ----------
    wanted, lost : int
        Reflectors that were looked for, and those of which there is none near by.
    level_db, range_mm, angle_deg : float or None
        Largest error of what was found, levels being below the strongest; None if nothing was.
    """

    wanted: int
    lost: int
    level_db: float | None
    range_mm: float | None
    angle_deg: float | None


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


def measure(image: Energyscape, measurement: Measurement, *, kernels: KernelSet, threads: int) -> Measured:
    """Return the error of the image that ``measurement`` was made into, by the plan in the image's settings.

    Where many zones of range or very many directions make the exact image dear, some directions are compared, spread
    evenly.

    Raises
    ------
    DataError
        The exact image is silent.
    """
    exact, chosen = exact_image(image.settings, measurement, kernels=kernels, threads=threads)
    whole = len(chosen) == len(image.energy)
    return Measured(
        error_db=error_db(image.energy[chosen], exact.energy),
        n_directions=len(chosen),
        peaks=peak_errors(image, find_peaks(exact, top=PEAKS)) if whole else None,
    )


def exact_plan(settings: Settings, kernels: KernelSet, *, threads: int) -> Accuracy:
    """Return a plan whose error is of no account by that of the settings' budget."""
    planner = Planner(settings.replace(accuracy=_EXACT), kernels, threads=threads)
    plan = next(
        (
            plan
            for plan in (_EXACT.replace(oversampling=n_phases) for n_phases in _PHASES)
            if planner.chosen(plan).parts["delays"] <= _DELAYS
        ),
        _EXACT.replace(oversampling=_PHASES[-1]),
    )
    # What one set of delays is wrong by falls with the square of their number.
    budget = 10 ** (settings.accuracy.max_error_db / 10)
    zones = math.ceil(math.sqrt(planner.chosen(plan).parts["zones"] / (_BELOW * budget)))
    n_ranges = len(time_window(settings, largest_delay_s=0.0, n_taps=1).range_m)
    return plan.replace(max_error_db=settings.accuracy.max_error_db, zones=min(max(1, zones), n_ranges))


def exact_image(
    settings: Settings, measurement: Measurement, *, kernels: KernelSet, threads: int
) -> tuple[Energyscape, NDArray[np.intp]]:
    """Return the exact image of a measurement, and which of the directions it has: (direction,) intp."""
    plan = exact_plan(settings, kernels, threads=threads)
    exact = settings.replace(accuracy=plan)
    grid = direction_grid(settings.processing)
    most = max(1, _MOST_BEAMS // (plan.zones or 1))
    if len(grid) <= most:
        return Pipeline(exact, kernels.device, threads).process(measurement), np.arange(len(grid))
    chosen = np.unique(np.linspace(0, len(grid) - 1, most).astype(np.intp))
    angles_deg = np.degrees([grid.azimuth_rad[chosen], grid.elevation_rad[chosen]]).T
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "directions.csv"
        np.savetxt(file, angles_deg, fmt="%.17g", delimiter=",")
        exact = exact.replace(processing=exact.processing.replace(directions=str(file)))
        return Pipeline(exact, kernels.device, threads).process(measurement), chosen


def error_db(energy: NDArray[np.float32], exact: NDArray[np.float32]) -> float:
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


def peak_errors(image: Energyscape, wanted: Sequence[Peak]) -> PeakErrors:
    """Return how an image shows the reflectors that the exact one has."""
    # Twice as many, since those of nearly one level change places, and what was last may be left out.
    found = find_peaks(image, top=2 * PEAKS, min_level_db=-1000.0)
    errors = [error for peak in wanted if (error := _nearest(peak, found)) is not None]
    level_db, range_m, angle_deg = np.max(np.abs(errors), axis=0).tolist() if errors else (None, None, None)
    return PeakErrors(
        wanted=len(wanted),
        lost=len(wanted) - len(errors),
        level_db=level_db,
        range_mm=None if range_m is None else 1000 * range_m,
        angle_deg=angle_deg,
    )


def _nearest(peak: Peak, found: Sequence[Peak]) -> tuple[float, float, float] | None:
    """Return errors of level, range and angle of the peak that shows a reflector."""
    errors = (
        (other.level_db - peak.level_db, other.range_m - peak.range_m, _angle_deg(peak, other)) for other in found
    )
    near = [error for error in errors if abs(error[1]) <= _NEAR_M and error[2] <= _NEAR_DEG]
    return min(near, key=lambda error: (error[1] / _NEAR_M) ** 2 + (error[2] / _NEAR_DEG) ** 2, default=None)


def _angle_deg(one: Peak, other: Peak) -> float:
    angles_rad = np.radians([[peak.azimuth_deg, peak.elevation_deg] for peak in (one, other)])
    first, second = unit_vectors(angles_rad[:, 0], angles_rad[:, 1])
    return math.degrees(2 * math.asin(min(1.0, float(np.linalg.norm(first - second)) / 2)))

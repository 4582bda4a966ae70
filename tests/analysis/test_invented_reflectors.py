"""No listed level exceeds its image by more than 1 dB, and no listed direction leaves its cell.

``ERTIS_RANDOM_CASES=10000 pytest --timeout 0 tests/analysis/test_invented_reflectors.py`` tries more random cases, and
``ERTIS_RANDOM_CASES=2500:5000`` a part of them.
"""

import os

import numpy as np
import pytest
from scipy.spatial import KDTree

from ertis_numba.analysis.detect import find_peaks, neighbours_of, peaks_of_grid
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.analysis.quadric_fits import QuadricFits
from ertis_numba.geometry import Grid, unit_vectors
from tests.analysis.test_detect import image_of
from tests.random_sounds import random_image

MANY = os.environ.get("ERTIS_RANDOM_CASES")
FIRST, _, LAST = MANY.rpartition(":") if MANY else ("", "", "")
IMAGES = range(int(FIRST or 0), int(LAST)) if MANY else range(80)
LIMIT_DB = 1.0


def is_wide(seed):
    """True for seeds of images with so many ranges that many maxima are listed."""
    return seed % (2 if MANY else 16) == 1


def are_in_cells(grid, level, listed, tolerance=1e-7):
    """True for each listed direction whose nearest direction of the grid is a local maximum; ties count for both."""
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    is_maximum = (level >= level[neighbours_of(directions)].max(axis=1)).reshape(len(directions), -1).any(axis=1)
    tree = KDTree(directions)
    away, _ = tree.query(listed)
    return [
        is_maximum[tree.query_ball_point(each, near + tolerance)].any() for each, near in zip(listed, away, strict=True)
    ]


def test_no_peak_is_louder_than_its_image():
    for seed in IMAGES:
        image = random_image(seed, most=200, n_ranges=64 + seed % 7) if is_wide(seed) else random_image(seed)
        highest_dbfs = image.level_dbfs.max()
        peaks = peaks_of_grid(image, top=40)
        assert all(peak.level_dbfs <= highest_dbfs + LIMIT_DB for peak in peaks), (seed, peaks)
        if peaks:
            listed = unit_vectors(*np.transpose([(peak.azimuth_rad, peak.elevation_rad) for peak in peaks]))
            assert all(are_in_cells(image, image.amplitude, listed)), (seed, peaks)
        step_m = float(image.range_m[1] - image.range_m[0]) if len(image.range_m) > 1 else 0.0
        assert all(image.range_m[0] - step_m <= peak.range_m <= image.range_m[-1] + step_m for peak in peaks), seed
        cloud = PointExtractor(image.settings, Grid(image.azimuth_rad, image.elevation_rad))(image)
        assert (cloud.amplitude <= image.amplitude.max() * 10 ** (LIMIT_DB / 20)).all(), seed


@pytest.mark.parametrize(("directions", "error_deg"), [("2d:121", 0.0), ("3d:900", 0.0), ("2d:1", np.inf)])
def test_peak_states_the_error_that_the_grid_causes(directions, error_deg):
    (peak,) = find_peaks(image_of([(12.34, 1, 1.2, 1.0)], directions=directions, range_m=(1.1, 1.3)), top=1)
    assert peak.grid_error_deg == error_deg
    if directions == "3d:900":
        (peak,) = find_peaks(image_of([(91.0, 5.0, 1.2, 1.0)], directions=directions, range_m=(1.1, 1.3)), top=1)
        assert 1 < peak.grid_error_deg < 2  # directions are 4.8° apart


@pytest.mark.parametrize("azimuth_deg", [-180, -179.6, -178.7, 178.7, 179.3, 180])
@pytest.mark.parametrize("limits_deg", [(-180.0, 180.0), (-180.0, 178.0)])
def test_maximum_at_the_seam_of_a_full_circle_is_interpolated_across_it(azimuth_deg, limits_deg):
    n_directions = 181 if limits_deg[1] == 180 else 180  # The first circle ends where it starts.
    azimuth_rad = np.radians(np.linspace(*limits_deg, n_directions))
    level = -(np.degrees(np.angle(np.exp(1j * (azimuth_rad - np.radians(azimuth_deg))))) ** 2)
    directions = unit_vectors(azimuth_rad, 0 * azimuth_rad)
    neighbours, here = neighbours_of(directions), np.array([level.argmax()])
    fits = QuadricFits.of(directions, neighbours, here)
    offset, _ = fits.tops(np.array([0]), level[neighbours[here]] - level[here][:, None])
    offset, width_rad = fits.within_cells(np.array([0]), offset)
    found = np.angle(np.dot(directions[here[0]] + offset[0], [1, 1j, 0]) * np.exp(-1j * np.radians(azimuth_deg)))
    assert np.degrees(found) == pytest.approx(0, abs=0.01)
    assert width_rad == pytest.approx(0)


@pytest.mark.parametrize(
    "azimuth_deg", [np.linspace(-180, 180, 37), np.repeat(np.arange(-30.0, 31, 5), 2), np.tile([5.0, 6, 7], 4)]
)
def test_neighbours_of_equal_directions_are_different_ones(azimuth_deg):
    directions = unit_vectors(np.radians(azimuth_deg), 0 * azimuth_deg)
    for place, row in enumerate(neighbours_of(directions)):
        equal = np.flatnonzero(np.linalg.norm(directions - directions[place], axis=1) < 1e-9)
        assert row[0] == equal[0]
        assert set(equal) <= set(row)
        others = np.linalg.norm(directions[row[1:3]] - directions[place], axis=1)
        assert others[0] > 1e-9
        assert len(np.unique(row[:3])) == 3


def test_direction_that_is_held_at_its_border_has_the_error_of_what_was_cut():
    directions = unit_vectors(np.radians(np.arange(-6.0, 7, 2)), np.zeros(7))
    fits = QuadricFits.of(directions, neighbours_of(directions), np.array([3]))
    for wanted_deg, error_deg in ((0.9, 0.0), (1.2, 0.2), (1.32, 0.32), (1.6, 2 / np.sqrt(12))):
        offset = unit_vectors(np.radians([wanted_deg]), np.zeros(1)) - directions[3]
        cut, width_rad = fits.within_cells(np.array([0]), offset)
        assert np.degrees(np.linalg.norm(cut)) == pytest.approx(min(wanted_deg, 1.0), abs=0.02)
        assert np.degrees(width_rad[0]) / np.sqrt(12) == pytest.approx(error_deg, abs=0.02)


def angles_of(directions, *, shown):
    """Numbers of axes of the fits of directions, (azimuth, elevation) in degrees."""
    vectors = unit_vectors(*np.radians(directions).T)
    fits = QuadricFits.of(vectors, neighbours_of(vectors), np.arange(len(vectors)))
    return fits.quadrics.n_axes[shown].tolist()


def test_fits_have_the_axes_that_neighbours_determine():
    square = np.array([(azimuth, elevation) for azimuth in range(5) for elevation in range(5)], dtype=float)
    assert angles_of(square, shown=[12, 2, 0]) == [2, 1, 0]  # middle, edge, corner
    row = np.array([(azimuth, 0.0) for azimuth in range(4)])
    assert angles_of(row, shown=slice(None)) == [0, 1, 1, 0]
    column = np.array([(10.0, elevation) for elevation in range(12)])
    assert angles_of(column, shown=[0, 1, 5, 11]) == [0, 1, 1, 0]
    two_rows = np.array([(azimuth, elevation) for azimuth in range(9) for elevation in (0.0, 1.0)])
    assert angles_of(two_rows, shown=[8, 9]) == [1, 1]
    assert angles_of(np.array([(0.0, 0.0)]), shown=[0]) == [0]
    assert angles_of(np.array([(0.0, 0.0)] * 12), shown=[0]) == [0]

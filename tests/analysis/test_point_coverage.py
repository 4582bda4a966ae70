"""Stated standard deviations of peaks and points against the errors of independently rendered echoes."""

import math

import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from tests.echo_draws import AMPLITUDE, Case, Draws, unit

MIDDLE = {"range_m": (0.72, 0.98)}
CASES = {
    "coarse line": Case("2d:31", 20, wavefront="plane", **MIDDLE),
    "coarse": Case("3d:300", 50, **MIDDLE),
    "medium": Case("3d:600", 18, wavefront="plane", **MIDDLE),
    "fine": Case("3d:3000", 30, **MIDDLE),
    "edges": Case("3d:600", 30, azimuth_deg=(62, 70), **MIDDLE),
    "last ranges": Case("2d:91", 30, range_m=(1.04, 1.09)),
    "rings": Case("3d:600", 30, "xRTIS_v1", **MIDDLE),
    "bits": Case("2d:91", 30, encoding="pdm", **MIDDLE),
}
DRAWS = 30
IN_LEVELS = {
    "coarse": CASES["coarse"],
    "fine": CASES["fine"],
    "fine line": Case("2d:181", 60, **MIDDLE),
    "edges": CASES["edges"],
    "bits": CASES["bits"],
}


def rounded(image):
    """The image with levels in steps of 0.5 dB, rounded here."""
    level_db = np.rint(2 * 20 * np.log10(np.maximum(image.amplitude.astype(np.float64), 1e-9))) / 2
    return image.replace(amplitude=(10 ** (level_db / 20)).astype(np.float32), level_step_db=0.5)


def sideways(azimuth_deg, elevation_deg, positions_m, is_planar):
    """Unit vector across the line of sight along which an array extends least, or the horizontal one."""
    left = unit(azimuth_deg + 90, 0)
    if is_planar:
        return left
    across = np.stack([left, unit(azimuth_deg, elevation_deg + 90)])
    return np.linalg.eigh(np.cov(across @ positions_m.T))[1][:, 0] @ across


def standardised(draws, rng, change=lambda image: image):
    """Errors of range, direction and level in stated standard deviations; None if no direction or no peak is stated."""
    image, (azimuth_deg, elevation_deg, range_m) = draws.drawn(rng)
    image = change(image)
    peaks = find_peaks(image, top=3, false_alarm=1e-3)
    near = [peak for peak in peaks if abs(peak.range_m - range_m) < 0.03]
    if not near or not math.isfinite(near[0].grid_error_deg):
        return None
    peak = near[0]
    across = sideways(azimuth_deg, elevation_deg, draws.positions_m, draws.case.is_planar)
    error_deg = math.degrees(unit(peak.azimuth_deg, peak.elevation_deg) @ across)
    return (
        (peak.range_m - range_m) / peak.range_sd_m,
        error_deg / peak.angle_sd_deg,
        (peak.level_dbfs - 20 * math.log10(AMPLITUDE)) / peak.level_sd_db,
    )


@pytest.fixture(scope="module")
def errors():
    """Standardised errors of each case: (draw, quantity)."""
    found = {}
    for number, (name, case) in enumerate(CASES.items()):
        draws, rng = Draws(case), np.random.default_rng([9, number])
        found[name] = np.array([each for _ in range(DRAWS) if (each := standardised(draws, rng)) is not None])
    return found


def test_errors_are_those_that_are_stated(errors):
    """68 % of normal errors lie within a standard deviation, and 3 in 50,000 beyond four."""
    every = np.abs(np.concatenate(list(errors.values())))
    assert len(every) > 0.8 * DRAWS * len(CASES)
    assert ((np.mean(every < 1, axis=0) > 0.60) & (np.mean(every < 1, axis=0) < 0.76)).all()
    assert np.mean(every > 4) <= 0.005


@pytest.mark.parametrize("name", CASES)
def test_errors_of_each_case_are_about_those_that_are_stated(errors, name):
    """Within four standard deviations of the share of a few draws."""
    rms = np.sqrt(np.mean(errors[name] ** 2, axis=0))
    assert len(errors[name]) > DRAWS / 2
    assert (rms > 0.6).all()
    assert (rms < 1.5).all()


@pytest.mark.parametrize("name", IN_LEVELS)
def test_errors_of_rounded_levels_are_part_of_those_that_are_stated(name):
    draws, rng = Draws(IN_LEVELS[name]), np.random.default_rng([31, len(name)])
    found = np.array([each for _ in range(DRAWS) if (each := standardised(draws, rng, rounded)) is not None])
    assert len(found) > 0.8 * DRAWS
    rms = np.sqrt(np.mean(found**2, axis=0))
    assert (rms > 0.4).all()
    assert (rms < 1.4).all()
    assert np.abs(found).max() < 4.5


@pytest.mark.parametrize(("directions", "budget_db"), [("2d:91", -20.0), ("2d:181", -35.0), ("3d:600", -14.0)])
def test_errors_of_the_plan_are_part_of_those_that_are_stated(directions, budget_db):
    """Far above the noise, the errors of the plan remain. They are alike in all bins."""
    draws, rng = Draws(Case(directions, 70, budget_db=budget_db, **MIDDLE)), np.random.default_rng(45)
    found = np.array([each for _ in range(DRAWS) if (each := standardised(draws, rng)) is not None])
    assert len(found) > DRAWS / 2
    assert (np.sqrt(np.mean(found**2, axis=0)) < 1.5).all()
    assert np.abs(found).max() < 4


@pytest.mark.parametrize("directions", ["2d:91", "3d:600"])
def test_points_and_peaks_state_the_same_errors(directions):
    draws, rng = Draws(Case(directions, 30, **MIDDLE)), np.random.default_rng(12)
    for _ in range(5):
        image, _ = draws.drawn(rng)
        peak, cloud = find_peaks(image, top=1)[0], draws.extract(image)
        along_m, across_m = cloud.uncertainty_m[0]
        np.testing.assert_allclose(
            cloud.position_m[0], peak.range_m * unit(peak.azimuth_deg, peak.elevation_deg), atol=1e-5
        )
        assert along_m == pytest.approx(peak.range_sd_m, rel=1e-3)
        assert across_m == pytest.approx(math.radians(peak.angle_sd_deg) * peak.range_m, rel=1e-3)


@pytest.mark.parametrize("directions", ["2d:91", "3d:600"])
def test_directions_of_echoes_beyond_the_limits_are_unknown_or_right(directions):
    draws, rng = Draws(Case(directions, 30, azimuth_deg=(70, 85), **MIDDLE)), np.random.default_rng(11)
    found = [each[1] for _ in range(30) if (each := standardised(draws, rng)) is not None]
    assert len(found) < 10
    assert (np.abs(found) < 3).all()

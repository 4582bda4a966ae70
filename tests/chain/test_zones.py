"""Spherical wavefronts by zones: every range is in one, and near ranges are sharp."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ertis_numba import kernels
from ertis_numba.chain.focal_zones import zone_edges
from ertis_numba.chain.planner import Planner
from ertis_numba.frames import Measurement
from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Array, Processing
from tests import reference
from tests.cases import LINE_8, SHORT, noise
from tests.hard_cases.echoes import echo_words
from tests.hard_cases.tuned import tuned

pytestmark = pytest.mark.usefixtures("sound_unchecked")

NEAR = SHORT.replace(processing=Processing(directions="2d:3", range_m=(0.1, 1.0), wavefront="spherical"))
LINE = Array(layout="line", positions_m=LINE_8, word_bits=8)


@settings(max_examples=100, deadline=None)
@given(
    first_m=st.floats(0, 10),
    step_m=st.floats(1e-4, 0.5),
    n_ranges=st.integers(1, 3000),
    count=st.integers(1, 4000),
)
def test_zones_hold_every_range_once(first_m, step_m, n_ranges, count):
    range_m = first_m + step_m * np.arange(n_ranges)
    zones = zone_edges(range_m, count)
    assert 1 <= len(zones) <= min(count, n_ranges)
    assert [place for first, stop, _ in zones for place in range(first, stop)] == list(range(n_ranges))
    for first, stop, distance_m in zones:
        nearest_m = range_m[first] if stop - first == 1 else max(range_m[first], 1e-3)
        assert nearest_m * (1 - 1e-9) <= distance_m <= max(range_m[stop - 1], 1e-3) * (1 + 1e-9)


def test_curvature_changes_equally_over_all_zones():
    range_m = np.arange(0.1, 5.0, 0.0001)
    zones = zone_edges(range_m, 20)
    assert len(zones) == 20
    spans = [1 / range_m[first] - 1 / range_m[stop - 1] for first, stop, _ in zones]
    assert np.array(spans) == pytest.approx((1 / 0.1 - 1 / 5.0) / 20, rel=0.05)
    for first, stop, distance_m in zones:
        assert 1 / distance_m == pytest.approx((1 / range_m[first] + 1 / range_m[stop - 1]) / 2)


def error_db(settings, image, *, spherical):
    """Error of the image of noise."""
    return reference.error_db(image, exact(settings.array, settings.processing.directions, spherical=spherical))


@functools.cache
def exact(array, directions, *, spherical):
    """Exact image, independent of the plan."""
    settings = NEAR.replace(array=array, processing=NEAR.processing.replace(directions=directions))
    axes = Pipeline(settings, predict=False)
    unit = unit_vectors(axes.grid.azimuth_rad, axes.grid.elevation_rad)
    return reference.exact(noise(settings).data, settings, unit, axes.range_m, spherical=spherical)


@pytest.mark.parametrize("precision", ["float32", "int16"])
@pytest.mark.parametrize("budget_db", [-35.0, -60.0])
def test_near_ranges_are_within_the_budget(budget_db, precision):
    settings = tuned(NEAR, max_error_db=budget_db, precision=precision)
    pipeline, measurement = Pipeline(settings, predict=False), noise(settings)
    image = pipeline.process(measurement)
    assert error_db(settings, image.amplitude, spherical=True) < budget_db


def test_interpolated_beams_are_within_the_budget():
    settings = tuned(NEAR, beam_taps=4, max_error_db=-40.0).replace(array=LINE)
    settings = settings.replace(processing=NEAR.processing.replace(directions="2d:15"))
    pipeline, measurement = Pipeline(settings, predict=False), noise(settings)
    image = pipeline.process(measurement)
    assert pipeline.settings.accuracy.focal_zones > 1
    assert error_db(settings, image.amplitude, spherical=True) < -40


def test_plane_waves_exceed_the_budget_at_near_ranges():
    """They are correct for plane waves, but wrong for points at such ranges."""
    settings = NEAR.replace(processing=NEAR.processing.replace(wavefront="plane"))
    pipeline, measurement = Pipeline(settings, predict=False), noise(settings)
    image = pipeline.process(measurement).amplitude
    assert error_db(settings, image, spherical=False) < -35
    assert error_db(settings, image, spherical=True) > -20


def test_near_echo_is_as_bright_as_a_far_one():
    """The echo is from a point at 15 cm, of which plane waves lose a part."""
    words = echo_words(NEAR, azimuth_deg=20.0, range_m=0.15, level=0.1, spherical=True)
    brightest = {}
    for wavefront in ("spherical", "plane"):
        processing = NEAR.processing.replace(directions="2d:181", range_m=(0.1, 0.3), wavefront=wavefront)
        settings = NEAR.replace(processing=processing)
        pipeline = Pipeline(settings)
        image = pipeline.process(Measurement(words, settings)).amplitude
        direction, place = np.unravel_index(image.argmax(), image.shape)
        brightest[wavefront] = image.max()
        if wavefront == "spherical":
            assert np.degrees(pipeline.grid.azimuth_rad[direction]) == pytest.approx(20, abs=1)
            assert pipeline.range_m[place] == pytest.approx(0.15, abs=0.004)
    assert brightest["spherical"] == pytest.approx(0.1, rel=0.1)
    assert brightest["plane"] < 0.9 * brightest["spherical"]


def test_planner_uses_the_fewest_zones():
    """Smaller errors need more zones, far ranges few, and plane waves one."""
    counts = {}
    for name, range_m, budget_db in (
        ("near", (0.1, 1.0), -35.0),
        ("exacter", (0.1, 1.0), -60.0),
        ("far", (1.0, 1.5), -35.0),
    ):
        settings = NEAR.replace(
            processing=NEAR.processing.replace(range_m=range_m), accuracy=Accuracy(max_error_db=budget_db)
        )
        counts[name] = Planner(settings, kernels.load("cpu"), threads=1).choose().settings.accuracy.focal_zones
    assert counts["exacter"] > 3 * counts["near"]
    assert counts["far"] < counts["near"] / 3
    assert Pipeline(SHORT).settings.accuracy.focal_zones == 1

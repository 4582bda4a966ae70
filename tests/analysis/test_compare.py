"""Comparison with a known ground truth, on images computed from closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from ertis_cli.peaks import _compared

from ertis_numba.analysis.compare import Comparison, Match, compare, errors_of
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Peak, Reflector
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Settings
from ertis_numba.simulation import Scene
from ertis_numba.simulation.effect_plan import EffectPlan, Verdict
from ertis_numba.simulation.render import Simulator
from tests.analysis.test_detect import image_of


def true(azimuth_deg, range_m, level_db=0.0, *, elevation_deg=0.0, name="points[0]"):
    return Reflector(
        name=name, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, range_m=range_m, level_db=level_db
    )


def ideal(*reflectors, **options):
    """Return an image that shows reflectors exactly as specified."""
    return image_of(
        [(r.azimuth_deg, r.elevation_deg, r.range_m, 10 ** (r.level_db / 20)) for r in reflectors], **options
    )


def counts(comparison):
    return tuple(len(getattr(comparison, name)) for name in ("matched", "missed", "spurious", "explained"))


LEFT, MIDDLE, RIGHT = true(-40, 0.95, -6.0), true(3.3, 1.3), true(55.5, 1.45, -4.0)


def test_compare_matches_reflectors_at_true_positions():
    comparison = compare(ideal(LEFT, MIDDLE, RIGHT), [MIDDLE, RIGHT, LEFT])
    assert counts(comparison) == (3, 0, 0, 0)
    assert [match.reflector for match in comparison.matched] == [MIDDLE, RIGHT, LEFT]
    errors = errors_of([comparison])
    assert errors.angle_rms_deg < 0.5
    assert abs(errors.range_bias_m) < 1e-3
    assert errors.range_rms_m < 1e-3
    assert errors.level_rms_db < 0.5


def test_compare_measures_known_displacements():
    """The ground truth is displaced from the image by a known step."""
    reported = [true(r.azimuth_deg + 2, r.range_m - 0.05, r.level_db) for r in (LEFT, MIDDLE, RIGHT)]
    exact = errors_of([compare(ideal(LEFT, MIDDLE, RIGHT), [MIDDLE, RIGHT, LEFT])])
    errors = errors_of([compare(ideal(LEFT, MIDDLE, RIGHT), reported)])
    assert (errors.matched, errors.missed, errors.spurious) == (3, 0, 0)
    assert errors.angle_rms_deg == pytest.approx(2, abs=2 * exact.angle_rms_deg)
    assert errors.range_bias_m == pytest.approx(0.05, abs=1e-3)
    assert errors.range_rms_m == pytest.approx(0.05, abs=1e-3)


def test_compare_levels_are_relative_to_the_strongest_match():
    reported = [true(3.3, 1.3, -3.0), true(55.5, 1.45, -9.0), true(20, 1.1, 0.0, name="not there")]
    comparison = compare(ideal(MIDDLE, RIGHT), reported)
    assert [reflector.name for reflector in comparison.missed] == ["not there"]
    # The second reflector is 4 dB below the first in the image, and 6 dB in the ground truth.
    assert [match.level_db for match in comparison.matched] == pytest.approx([0.0, 2.0], abs=0.3)


def test_compare_lists_missed_reflectors_and_ghosts():
    comparison = compare(ideal(LEFT, MIDDLE), [MIDDLE, RIGHT])
    assert comparison.missed == (RIGHT,)
    assert [peak.azimuth_deg for peak in comparison.spurious] == pytest.approx([-40], abs=1)
    assert counts(comparison) == (1, 1, 1, 0)


@pytest.mark.parametrize(
    ("reported", "found"),
    [
        (true(3.3, 1.3 + 0.09), True),
        (true(3.3, 1.3 + 0.11), False),
        (true(3.3 + 15, 1.3), True),
        (true(3.3 + 20, 1.3), False),
    ],
)
def test_compare_matches_only_within_the_gate(reported, found):
    assert counts(compare(ideal(MIDDLE), [reported])) == ((1, 0, 0, 0) if found else (0, 1, 1, 0))


def test_compare_matches_one_of_two_coincident_reflectors():
    twin = true(3.3, 1.3, -1.0, name="twin")
    comparison = compare(ideal(MIDDLE), [MIDDLE, twin])
    assert counts(comparison) == (1, 1, 0, 0)


def test_compare_matches_as_many_reflectors_as_possible():
    """The peak nearest to the first reflector is the only peak within the gate of the second."""
    image = ideal(true(0, 1.10), true(0, 1.20))
    comparison = compare(image, [true(0, 1.16, name="between"), true(0, 1.24, name="behind")])
    assert counts(comparison) == (2, 0, 0, 0)
    assert [match.range_m for match in comparison.matched] == pytest.approx([-0.06, -0.04], abs=2e-3)


@pytest.mark.parametrize(
    "hidden",
    [
        true(20, 1.7, 6.0),  # beyond the last range
        true(20, 0.7, 6.0),
        true(20, 1.0, -32.0),  # too weak
        true(20, 1.0, elevation_deg=25.0),  # out of the plane
        true(160, 1.0),  # behind the array
    ],
    ids=["far", "near", "weak", "above", "behind"],
)
def test_compare_ignores_reflectors_outside_the_image(hidden):
    assert counts(compare(ideal(MIDDLE), [hidden, MIDDLE])) == (1, 0, 0, 0)


def test_compare_explains_front_peak_of_a_reflector_behind():
    behind = true(180 - 3.3, 1.3)
    comparison = compare(ideal(MIDDLE, LEFT), [behind, LEFT])
    assert counts(comparison) == (1, 0, 0, 1)
    assert comparison.explained[0].azimuth_deg == pytest.approx(3.3, abs=0.5)


def test_compare_accepts_mirror_image_of_a_planar_array():
    """In a grid around the sensor, a planar array shows one reflector twice."""
    image = ideal(MIDDLE, directions="3d:2000")
    around = image.replace(
        azimuth_rad=np.concatenate([image.azimuth_rad, np.pi - image.azimuth_rad]),
        elevation_rad=np.tile(image.elevation_rad, 2),
        amplitude=np.concatenate([image.amplitude, np.float32(0.999) * image.amplitude]),
    )
    assert counts(compare(around, [MIDDLE]))[:3] == (1, 0, 0)


def test_compare_explains_side_lobes_of_elevated_reflectors():
    above = true(20, 1.0, elevation_deg=40.0)
    comparison = compare(ideal(above, MIDDLE), [above, MIDDLE])
    assert counts(comparison)[:3] == (1, 0, 0)
    assert comparison.explained
    assert counts(compare(ideal(above, MIDDLE), [MIDDLE]))[2]


def test_compare_weak_reflectors_explain_peaks_without_misses():
    weak = true(-40, 0.95, -10.3)
    shown = true(-40, 0.95, -9.7)  # slightly stronger in the image, by chance
    assert counts(compare(ideal(MIDDLE, shown), [MIDDLE, weak], min_level_db=-10)) == (1, 0, 0, 1)


def test_compare_matches_strong_reflector_with_weaker_peak():
    shown = true(-40, 0.95, -11)
    assert counts(compare(ideal(MIDDLE, shown), [MIDDLE, true(-40, 0.95, -9)], min_level_db=-10)) == (1 + 1, 0, 0, 0)


def test_compare_min_level_ignores_reflectors_outside_the_image():
    """A strong reflector beyond the image must not push the others below the level limit."""
    reported = [true(0, 9.0, 0.0), true(3.3, 1.3, -35.0), true(55.5, 1.45, -39.0)]
    assert counts(compare(ideal(MIDDLE, RIGHT), reported)) == (2, 0, 0, 0)


def test_compare_measures_angles_in_3d_images():
    given = [true(-21.7, 1.0, elevation_deg=13.2), true(30.1, 1.3, -6.0, elevation_deg=-41.0)]
    comparison = compare(ideal(*given, directions="3000", range_m=(0.9, 1.4)), given, min_level_db=-12)
    assert counts(comparison) == (2, 0, 0, 0)
    assert errors_of([comparison]).angle_rms_deg < 0.7
    reported = [true(-21.7, 1.0, elevation_deg=16.2), given[1]]
    match = compare(ideal(*given, directions="3000", range_m=(0.9, 1.4)), reported, min_level_db=-12).matched[0]
    assert match.angle_deg == pytest.approx(3, abs=0.5)


def test_compare_of_planar_image_ignores_elevation():
    comparison = compare(ideal(MIDDLE), [true(3.3, 1.3, elevation_deg=4.0)])
    assert comparison.matched[0].angle_deg < 0.2


def test_compare_of_one_microphone_ignores_direction():
    image = ideal(MIDDLE)
    one = image.settings.replace(array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),)))
    comparison = compare(image.replace(settings=one), [true(-90, 1.3)])
    assert counts(comparison)[:2] == (1, 0)


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_compare_of_empty_images_and_empty_truth(noise):
    comparison = compare(image_of([], noise=noise, range_m=(0.8, 3.2)), [])
    assert counts(comparison)[:2] == (0, 0)
    assert len(comparison.spurious) <= (1 if noise else 0)  # Maxima of noise are no peaks; its tail is not Rayleigh's.
    assert counts(compare(image_of([]), [MIDDLE])) == (0, 1, 0, 0)


@pytest.mark.parametrize("n_ranges", [1, 2, 3])
def test_compare_accepts_small_images(n_ranges):
    image = ideal(MIDDLE)
    small = image.replace(amplitude=image.amplitude[:, :n_ranges].copy(), range_m=image.range_m[:n_ranges])
    assert counts(compare(small, [MIDDLE]))[:2] == (0, 0)


def test_errors_of_combines_several_images():
    first, second = compare(ideal(MIDDLE), [MIDDLE]), compare(ideal(MIDDLE), [RIGHT])
    errors = errors_of([first, second])
    assert (errors.measurements, errors.matched, errors.missed, errors.spurious) == (2, 1, 1, 1)
    peak = Peak(azimuth_deg=0.0, elevation_deg=0.0, range_m=1.0, level_db=0.0)
    matches = [
        Match(reflector=MIDDLE, peak=peak, angle_deg=angle, range_m=range_m, level_db=level)
        for angle, range_m, level in [(3.0, 0.01, 1.0), (4.0, -0.02, -2.0)]
    ]
    known = [Comparison(matched=(match,), missed=(), spurious=(), explained=()) for match in matches]
    errors = errors_of(known)
    assert errors.angle_rms_deg == pytest.approx(math.sqrt(12.5))
    assert errors.range_bias_m == pytest.approx(-0.005)
    assert errors.range_rms_m == pytest.approx(math.sqrt(0.00025))
    assert errors.level_rms_db == pytest.approx(math.sqrt(2.5))


def test_errors_of_no_match_are_none():
    errors = errors_of([compare(ideal(MIDDLE), [RIGHT])])
    assert {errors.angle_rms_deg, errors.range_bias_m, errors.range_rms_m, errors.level_rms_db} == {None}


def test_compare_rejects_invalid_min_level():
    with pytest.raises(ArgumentError, match="min_level_db is 3; use a number from -1000 to 0"):
        compare(ideal(MIDDLE), [], min_level_db=3.0)


def test_compare_explains_echoes_of_calls_of_other_sensors():
    """A peak at half the path of the other call is no ghost, and an unseen echo of that call is no miss."""
    other = replace(RIGHT, name="east: points[0]", emitter="east")
    unseen = replace(true(20, 1.1), name="east: points[1]", emitter="east")
    assert counts(compare(ideal(LEFT, MIDDLE, RIGHT), [LEFT, MIDDLE, other, unseen])) == (2, 0, 0, 1)


def test_compare_explains_cross_echoes_of_two_simulated_sensors():
    """Each of the two sensors has the echoes of both calls in its image."""
    scene = Scene.from_toml(FACING)
    for name in ("west", "east"):
        simulator = Simulator(
            scene, sensor=name, plan=EffectPlan(tuple(Verdict(name=e, on=True, reason="") for e in NEEDED))
        )
        measurement = simulator.render()
        comparison = compare(
            Pipeline(measurement.settings).process(measurement), simulator.reflectors(), min_level_db=-12
        )
        assert (len(comparison.matched), len(comparison.missed), len(comparison.spurious)) == (1, 0, 0)
        assert comparison.explained


def one_line(axis):
    return Settings(array=Array(positions_m=tuple(tuple(0.004 * k * a for a in axis) for k in range(16))))


@pytest.mark.parametrize(
    ("settings", "directions"),
    [
        (Settings(array=Array(positions_m=((0, 0, 0),))), "2d:31"),
        (Settings(array=Array(positions_m=((0, 0, 0),))), "3d:60"),
        (one_line((0, 0, 1)), "2d:31"),
    ],
)
def test_compare_states_no_angle_without_a_direction(settings, directions):
    """Of a reflector at 40°, one microphone, or a vertical line in a horizontal plane, shows only the range."""
    comparison = compare(ideal(true(40, 1.2), settings=settings, directions=directions), [true(40, 1.2)])
    (match,) = comparison.matched
    assert math.isnan(match.angle_deg)
    assert abs(match.range_m) < 1e-3
    errors = errors_of([comparison])
    assert errors.angle_rms_deg is None
    assert errors.range_rms_m < 1e-3
    (row,) = (row for row in _compared({}, comparison) if row["truth"])
    assert row["error"]["angle_deg"] is None


def test_compare_measures_the_angle_to_a_line_of_microphones():
    """A reflector above the horizontal plane sounds like one in the plane with the same y, which is no error."""
    reflector = true(30, 1.2, elevation_deg=40)
    image = ideal(reflector, settings=one_line((0, 1, 0)), directions="3d:600")
    (match,) = compare(image, [reflector]).matched
    assert match.angle_deg < 1.0
    assert math.isnan(match.peak.elevation_deg)


NEEDED = ("propagation", "spreading", "cross_emission", "modulation")
FACING = """
[[sensors]]
name = "west"
recording.n_samples = 65536
processing.directions = "2d:61"
processing.range_m = [0.4, 1.4]
[[sensors]]
name = "east"
position_m = [1.6, 0.0, 0.0]
yaw_deg = 180.0
recording.n_samples = 65536
processing.directions = "2d:61"
processing.range_m = [0.4, 1.4]
[[points]]
position_m = [0.7, 0.4, 0.0]
strength_db = -6.0
"""

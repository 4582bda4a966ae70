"""Comparison of points and occupied cells with scenes whose distances have closed forms."""

import math

import numpy as np
import pytest

from ertis_numba.analysis.compare_places import compare_map, compare_points, errors_of_places, joined, positions_m
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import OccupancyMap, PointCloud, Reflector, Surfaces
from ertis_numba.settings import Settings
from ertis_numba.simulation import Box, Point, Scene, Sphere, Wall
from ertis_numba.simulation.surfaces import surfaces_of

NONE = surfaces_of(Scene(), 0.0)


def reflector(x, y, z=0.0, level_db=0.0, name="points[0]"):
    return Reflector(
        name=name,
        azimuth_deg=math.degrees(math.atan2(y, x)),
        elevation_deg=math.degrees(math.atan2(z, math.hypot(x, y))),
        range_m=math.hypot(x, y, z),
        level_db=level_db,
    )


def cloud(*places_m, confirmed=None):
    made = PointCloud(np.reshape(places_m, (-1, 3)).astype(np.float32), np.ones(len(places_m), np.float32), Settings())
    return made if confirmed is None else made.replace(confirmed=np.array(confirmed))


def counts(places):
    return tuple(int(getattr(places, name).sum()) for name in ("matched", "missed", "spurious"))


@pytest.mark.parametrize(
    ("thing", "place_m", "distance_m"),
    [
        ({"points": (Point(position_m=(1.0, 2.0, 0.0)),)}, (1.0, 2.0, 0.3), 0.3),
        ({"points": (Point(position_m=(1.0, 0.0, 0.0), velocity_m_s=(0.0, 2.0, 0.0)),)}, (1.0, 1.2, 0.0), 0.2),
        ({"points": (Point(position_m=(1.0, 0.0, 0.0), diameter_m=0.4),)}, (1.0, 0.5, 0.0), 0.3),
        ({"spheres": (Sphere(position_m=(1.0, 0.0, 0.0), radius_m=0.4),)}, (2.0, 0.0, 0.0), 0.6),
        ({"spheres": (Sphere(position_m=(1.0, 0.0, 0.0), radius_m=0.4),)}, (1.1, 0.0, 0.0), 0.3),
        ({"walls": (Wall(position_m=(3.0, 0.0, 0.0), facing_deg=(180.0, 0.0)),)}, (2.6, 50.0, -7.0), 0.4),
        (
            {"walls": (Wall(position_m=(3.0, 0.0, 0.0), facing_deg=(180.0, 0.0), size_m=(2.0, 1.0)),)},
            (3.0, 1.3, 0.9),
            0.5,
        ),
        ({"boxes": (Box(position_m=(0.0, 0.0, 0.0), size_m=(4.0, 6.0, 2.0)),)}, (0.5, 2.9, 0.2), 0.1),
        (
            {"boxes": (Box(position_m=(0.0, 0.0, 0.0), size_m=(2.0, 2.0, 2.0), yaw_deg=45.0),)},
            (1.5, 0.0, 0.0),
            1.5 - math.sqrt(2),
        ),
        ({}, (1.0, 0.0, 0.0), math.inf),
    ],
)
def test_surfaces_distance_is_that_of_the_nearest_surface(thing, place_m, distance_m):
    found = surfaces_of(Scene(**thing), 0.5).distance_m(np.array([place_m]))
    assert found == pytest.approx([distance_m])


def test_surfaces_seen_from_an_object_are_in_its_frame():
    scene = Scene(points=(Point(position_m=(2.0, 1.0, 0.5)),), walls=(Wall(position_m=(5.0, 0, 0), facing_deg=(0, 0)),))
    left = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # The object faces the world's y.
    found = surfaces_of(scene, 0.0).seen_from(np.array([2.0, 0.0, 0.0]), left)
    assert found.centre_m == pytest.approx(np.array([[1.0, 0.0, 0.5]]))
    assert found.distance_m(np.array([[40.0, -2.9, 9.0]])) == pytest.approx([0.1])


def test_flattened_surfaces_have_neither_height_nor_floors():
    walls = (
        Wall(position_m=(3.0, 0.0, 5.0), facing_deg=(180.0, 0.0), size_m=(2.0, 1.0)),
        Wall(position_m=(0.0, 0.0, -0.1), facing_deg=(0.0, 90.0)),
    )
    flat = surfaces_of(Scene(points=(Point(position_m=(1.0, 0.0, 2.0)),), walls=walls), 0.0).flattened()
    places_m = np.array([[3.2, 0.9, 0.0], [3.0, 1.3, 0.0], [1.0, 0.1, 0.0], [-9.0, 0.0, 0.0]])
    assert flat.distance_m(places_m) == pytest.approx([0.2, 0.3, 0.1, 10.0])


def test_flattened_walls_without_limits_do_not_cover_the_plane():
    turned = surfaces_of(Scene(walls=(Wall(position_m=(3.0, 0, 0), facing_deg=(180.0, 0.0)),)), 0.0)
    tilt = 1e-9
    tilted = turned.seen_from(
        np.zeros(3),
        np.array([[math.cos(tilt), 0.0, math.sin(tilt)], [0.0, 1.0, 0.0], [-math.sin(tilt), 0.0, math.cos(tilt)]]),
    )
    assert tilted.flattened().distance_m(np.array([[2.0, 30.0, 0.0]])) == pytest.approx([1.0])


def test_compare_points_matches_one_to_one():
    true = [reflector(2.0, 0.0), reflector(2.0, 0.05, name="points[1]"), reflector(0.0, 1.0, name="points[2]")]
    places = compare_points(cloud((2.03, 0.0, 0.0), (0.0, 3.0, 0.0)), true, NONE, is_planar=False)
    assert counts(places) == (1, 2, 1)
    errors = errors_of_places([places, places])
    assert (errors.pulses, errors.matched, errors.missed, errors.found, errors.spurious) == (2, 2, 4, 4, 2)
    assert errors.error_cm == pytest.approx(3.0, abs=1e-3)


def test_compare_points_near_surfaces_are_not_spurious():
    surfaces = surfaces_of(Scene(walls=(Wall(position_m=(3.0, 0.0, 0.0), facing_deg=(180.0, 0.0)),)), 0.0)
    places = compare_points(cloud((3.05, 2.0, 0.4), (3.2, 2.0, 0.4)), [], surfaces, is_planar=False)
    assert counts(places) == (0, 0, 1)
    assert errors_of_places([places]).error_cm is None


def test_compare_points_of_planar_images_ignore_heights():
    """A planar image shows the distance from the sensors, which are 40 cm above the platform's origin."""
    away_m = math.hypot(2.0, 0.6)
    surfaces = surfaces_of(Scene(points=(Point(position_m=(2.0, 0.0, 1.0)),)), 0.0)
    points = cloud((away_m, 0.0, 0.4))
    assert counts(compare_points(points, [reflector(2.0, 0.0, 1.0)], surfaces, is_planar=True)) == (1, 0, 0)
    assert counts(compare_points(points, [], surfaces, is_planar=True)) == (0, 0, 0)
    assert counts(compare_points(points, [reflector(2.0, 0.0, 1.0)], surfaces, is_planar=False)) == (0, 1, 1)


def test_compare_points_counts_confirmed_spurious_points():
    places = compare_points(
        cloud((1, 0, 0), (3, 0, 0), (2, 0, 0), confirmed=[True, True, False]), [reflector(1, 0)], NONE, is_planar=False
    )
    assert errors_of_places([places]).spurious_confirmed == 1


@pytest.mark.parametrize("points", [cloud(), cloud((1.0, 0.0, 0.0))])
@pytest.mark.parametrize("is_planar", [True, False])
def test_compare_points_accepts_empty_pulses(points, is_planar):
    assert counts(compare_points(points, [], NONE, is_planar=is_planar)) == (0, 0, len(points))
    assert compare_points(points, [reflector(5, 0)], NONE, is_planar=is_planar).missed.tolist() == [True]


def test_compare_ignores_weak_reflectors():
    true = [reflector(2.0, 0.0), reflector(0.0, 1.0, level_db=-31.0, name="points[1]")]
    assert counts(compare_points(cloud(), true, NONE, is_planar=False)) == (0, 1, 0)
    assert counts(compare_points(cloud(), true, NONE, is_planar=False, min_level_db=-40.0)) == (0, 2, 0)


def occupancy(*cells, shape=(40, 40), cell_m=0.05):
    log_odds = np.full(shape, -1.0, np.float32)
    for cell in cells:
        log_odds[cell] = 3.0
    return OccupancyMap(log_odds, (0.0,) * len(shape), cell_m, 3)


def test_compare_map_finds_reflectors_and_spurious_cells():
    found = occupancy((20, 20), (20, 21), (5, 30))  # y, x; centres at 1.025 and 1.075, and at (1.525, 0.275)
    true = [reflector(1.0, 1.0), reflector(1.8, 1.8, name="points[1]"), reflector(9.0, 0.0, name="points[2]")]
    places = compare_map(found, true, NONE)
    assert counts(places) == (1, 2, 2)  # The cell at 1.075 is 79 mm away, the last reflector beyond the map.
    errors = errors_of_places([places], pulses=found.n_groups)
    assert (errors.pulses, errors.found) == (3, 3)
    assert errors.error_cm == pytest.approx(100 * math.hypot(0.025, 0.025))


def test_compare_map_ignores_heights_floors_and_ceilings():
    scene = Scene(
        walls=(
            Wall(position_m=(0.0, 0.0, 0.0), facing_deg=(0.0, 90.0)),
            Wall(position_m=(1.0, 0.0, 3.0), facing_deg=(0.0, 0.0), size_m=(5.0, 0.5)),
        )
    )
    places = compare_map(occupancy((10, 20), (10, 30)), [reflector(1.0, 0.5, 2.0)], surfaces_of(scene, 0.0))
    assert counts(places) == (1, 0, 1)


def test_compare_map_of_space_has_heights():
    places = compare_map(occupancy((20, 20, 20), shape=(40, 40, 40)), [reflector(1.0, 1.0, 1.0)], NONE)
    assert counts(places) == (1, 0, 0)
    places = compare_map(occupancy((30, 20, 20), shape=(40, 40, 40)), [reflector(1.0, 1.0, 1.0)], NONE)
    assert counts(places) == (0, 1, 1)


def test_compare_map_of_coarse_cells_accepts_the_whole_cell():
    true = [reflector(0.75, 0.5)]
    assert counts(compare_map(occupancy((1, 1), shape=(4, 4), cell_m=0.5), true, NONE)) == (1, 0, 0)


def test_compare_map_without_occupied_cells_misses_all():
    places = compare_map(occupancy(), [reflector(1.0, 1.0)], NONE)
    assert counts(places) == (0, 1, 0)
    assert errors_of_places([places]).error_cm is None


def test_joined_keeps_the_strongest_at_each_place():
    given = [reflector(1.0, 0.0, level_db=-3.0), reflector(1.02, 0.0), reflector(2.0, 0.0), reflector(1, 0, name="b")]
    kept = joined(given)
    assert [(each.name, each.range_m) for each in kept] == [("points[0]", 1.02), ("points[0]", 2.0), ("b", 1.0)]
    assert positions_m(kept) == pytest.approx(np.array([[1.02, 0, 0], [2, 0, 0], [1, 0, 0]]), abs=1e-12)
    assert len(joined(given, math.inf)) == 2


@pytest.mark.parametrize("compare", [compare_map, compare_points])
def test_compare_of_places_refuses_a_positive_level(compare):
    given = (occupancy(), {}) if compare is compare_map else (cloud(), {"is_planar": True})
    with pytest.raises(ArgumentError, match="min_level_db is 3; use a number from -1000 to 0"):
        compare(given[0], [], NONE, min_level_db=3.0, **given[1])


def test_distances_of_many_places_are_computed_in_parts(monkeypatch):
    monkeypatch.setattr("ertis_numba.frames._surfaces._AT_ONCE", 4)
    random = np.random.default_rng(3)
    centre_m, place_m = random.uniform(-1, 1, (5, 3)), random.uniform(-1, 1, (7, 3))
    surfaces = Surfaces(centre_m, np.zeros(5), np.zeros(5), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 2)))
    nearest_m = [min(math.dist(place, centre) for centre in centre_m) for place in place_m]
    assert surfaces.distance_m(place_m) == pytest.approx(nearest_m)

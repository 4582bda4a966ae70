"""Lowest range of fused scans: places nearer to the sensors than the first range of their images are not observed."""

import math

import numpy as np
import pytest

from ertis_numba.frames import PointCloud, Stamp
from ertis_numba.fusion import Fuser
from ertis_numba.interop.scans import scan_message
from ertis_numba.storage import EnergyscapeWriter, open_energyscapes
from tests.files import image

FIRST_M = {"front": 0.6, "left": 0.45, "back": 0.5}
AZIMUTH_DEG = np.linspace(-60.0, 60.0, 41)


def mountings(seed, radius_m):
    """Mountings on a circle; a sensor may face any way."""
    random, found = np.random.default_rng(seed), {}
    for name in FIRST_M:
        place_rad, yaw_rad = random.uniform(-math.pi, math.pi, 2)
        place_m = (radius_m * math.cos(place_rad), radius_m * math.sin(place_rad), 0.3)
        found[name] = place_m, (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))
    return found


def images(names):
    found = []
    for name in names:
        range_m = np.arange(FIRST_M[name], 3.0, 0.01)
        made = image(AZIMUTH_DEG, np.zeros(len(AZIMUTH_DEG)), range_m=range_m, seed=3)
        settings = made.settings.replace("processing.range_m", (FIRST_M[name], 3.0))
        found.append(made.replace(settings=settings, stamp=Stamp(sensor=name, timestamp_ns=10**18)))
    return found


def farthest_hidden_m(mounted):
    """Largest distance from the origin of a place ahead of a sensor that its image does not reach, by trying places."""
    places_m = np.stack(np.meshgrid(*[np.arange(-2.0, 2.0, 0.004)] * 2), axis=-1).reshape(-1, 2)
    is_hidden = np.zeros(len(places_m), bool)
    for name, ((x_m, y_m, _), (_, _, z, w)) in mounted.items():
        offset_m = places_m - (x_m, y_m)
        away_deg = np.degrees(np.arctan2(offset_m[:, 1], offset_m[:, 0]) - 2 * math.atan2(z, w))
        is_ahead = np.abs((away_deg + 180) % 360 - 180) <= AZIMUTH_DEG[-1]
        is_hidden |= is_ahead & (np.hypot(*offset_m.T) < FIRST_M[name])
    return np.hypot(*places_m[is_hidden].T).max()


def with_points(fused, ranges_m):
    cloud = PointCloud(
        np.array([[0.0, each, 0.3] for each in ranges_m], np.float32).reshape(-1, 3),
        np.full(len(ranges_m), 0.1, np.float32),
        fused.settings,
        fused.stamp,
        confirmed=np.ones(len(ranges_m), bool),
    )
    return fused.replace(points=cloud)


@pytest.mark.parametrize("seed", range(4))
def test_lowest_range_of_a_fused_scan_excludes_all_places_that_are_not_observed(seed):
    mounted = mountings(seed, radius_m=(0.0, 0.1, 0.2, 0.4)[seed])
    fused = with_points(Fuser(mounted)(images(mounted)).image, [2.0])
    scan = scan_message(fused)
    assert scan["range_min"] == pytest.approx(farthest_hidden_m(mounted), abs=0.01)
    assert scan["range_min"] < min(scan["ranges"]) == pytest.approx(2.0)


def test_nearer_reflectors_stay_above_the_lowest_range():
    mounted = mountings(2, radius_m=0.2)
    fused = Fuser(mounted)(images(mounted)).image
    scan = scan_message(with_points(fused, [0.5, 2.0]))
    lowest, nearest = np.float32(scan["range_min"]), np.float32(min(scan["ranges"]))
    assert nearest == np.float32(0.5)
    assert 0.4999 < lowest < nearest  # AMCL discards readings that equal the lowest range.


def test_fused_files_keep_the_lowest_range(tmp_path):
    mounted = mountings(2, radius_m=0.2)
    fuser = Fuser(mounted)
    fused = with_points(fuser(images(["front", "left"])).image, [])
    with EnergyscapeWriter(tmp_path / "fused.h5") as writer:
        writer.write(fused)
        writer.write(fuser(images(mounted)).image)  # The settings of both are equal.
    with open_energyscapes(tmp_path / "fused.h5") as reader:
        read = scan_message(reader[0])
    assert read["range_min"] == scan_message(fused)["range_min"] == pytest.approx(farthest_hidden_m(mounted), abs=0.01)
    assert np.isinf(read["ranges"]).all()


def test_limited_ranges_raise_the_lowest_range():
    mounted = mountings(0, radius_m=0.0)
    fused = with_points(Fuser(mounted)(images(mounted)).image, [2.0])
    assert scan_message(fused.select(range_m=(1.0, 2.5)))["range_min"] == pytest.approx(1.0, abs=0.02)

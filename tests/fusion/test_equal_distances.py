"""Reflectors at about equal distances from two sensors, whose calls arrive together."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from tests.small_platforms import HEIGHT_M, images_of, mounted, rendered, settings_of

AHEAD = (0.0, 0.0, 0.0, 1.0)
BESIDE = {"left": ((0.0, 0.2, HEIGHT_M), AHEAD), "right": ((0.0, -0.2, HEIGHT_M), AHEAD)}
PLATFORMS = {"beside": (BESIDE, 0.0), "2": (mounted(2), math.pi / 4), "4": (mounted(4), 3 * math.pi / 4)}


@pytest.mark.parametrize("diameter_m", [0.0, 0.012])
@pytest.mark.parametrize("platform", PLATFORMS)
def test_reflector_at_equal_distances_has_a_point_within_its_uncertainty(platform, diameter_m):
    """Calls that cancel each other shift their echoes by up to half of the pulse; the uncertainty contains this."""
    mountings, turn_rad = PLATFORMS[platform]
    settings, random = settings_of(diameter_m=diameter_m), np.random.default_rng(7)
    along, across = (
        np.array([math.cos(turn_rad), math.sin(turn_rad)]),
        np.array([-math.sin(turn_rad), math.cos(turn_rad)]),
    )
    fuser = ertis.Fuser(mountings)
    for number, (range_m, off_m) in enumerate([(0.9, 0.0), (2.4, 0.0), (1.3, 0.006), (2.0, 0.03), (1.3, 0.056)]):
        place_m = [*(range_m * along + off_m * across), HEIGHT_M]
        strength_db = [6 * math.log2(range_m)]
        signals = rendered(mountings, settings, [place_m], strength_db, diameter_m=diameter_m, random=random)
        points = fuser(images_of(signals, settings, 10 * number).values()).points
        error_m = points.position_m[:, :2] - place_m[:2]
        assert len(points) > 0, (range_m, off_m)
        assert np.linalg.norm(error_m, axis=1).max() < 0.03, (range_m, off_m)
        nearest = np.argmin(np.linalg.norm(error_m, axis=1))
        errors = np.abs([error_m[nearest] @ along, error_m[nearest] @ across])
        assert np.all(errors < 4 * points.uncertainty_m[nearest]), (range_m, off_m)

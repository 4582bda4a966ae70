"""Fused points of images with rounded levels, rendered by sums of delayed calls."""

import math

import numpy as np

import ertis_numba as ertis
from tests.small_platforms import HEIGHT_M, images_of, mounted, rendered, settings_of

COUNT, DRAWS = 4, 16


def rounded(image):
    level_db = np.rint(2 * 20 * np.log10(np.maximum(image.amplitude.astype(np.float64), 1e-9))) / 2
    return image.replace(amplitude=(10 ** (level_db / 20)).astype(np.float32), level_step_db=0.5)


def test_errors_of_fused_points_are_those_that_are_stated():
    """Each sensor hears four calls from a reflector, with the same error of its direction."""
    settings, random = settings_of(diameter_m=0.0), np.random.default_rng(71)
    fuser, found = ertis.Fuser(mounted(COUNT)), []
    for _ in range(DRAWS):
        turn, range_m = random.uniform(-math.pi, math.pi), random.uniform(0.8, 3.0)
        place_m = np.array([range_m * math.cos(turn), range_m * math.sin(turn), HEIGHT_M])
        signals = rendered(mounted(COUNT), settings, tuple(place_m), 0.0, diameter_m=0.0, random=random, noise=2e-5)
        points = fuser([rounded(each) for each in images_of(signals, settings).values()]).points
        assert len(points) == 1
        error_m = (points.position_m[0] - place_m)[:2]
        along = np.array([math.cos(turn), math.sin(turn)])
        errors_m = error_m @ along, error_m @ [-along[1], along[0]]
        found.append(np.array(errors_m) / points.uncertainty_m[0])
    assert (np.sqrt(np.mean(np.square(found), axis=0)) < 1.3).all()
    assert np.abs(found).max() < 4

"""Fused points of random scenes with all images and without any one of them, rendered without the simulator."""

import functools

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.analysis.points import EchoPointExtractor
from ertis_numba.fusion.overlaps import PredictedEchoes, overlap
from tests.small_platforms import images_of, mounted, random_reflectors, rendered, settings_of

SEEDS = 104, 105, 109
PULSE_M, BEAM = 0.014, 0.14


@functools.cache
def errors(diameter_m):
    """Errors of the points along and across, in metres, and standard deviations: with all images, and without one.

    Also returns the number of reflectors that no point shows within 10 cm.
    """
    fuser = ertis.Fuser(mounted(), emitter_diameter_m=diameter_m)
    found, lost = {True: [], False: []}, {True: 0, False: 0}
    for seed in SEEDS:
        places_m, strength_db = random_reflectors(seed)
        random = np.random.default_rng(seed)
        images = images_of(
            rendered(mounted(), settings_of(), places_m, strength_db, diameter_m=diameter_m, random=random),
            settings_of(),
        )
        for missing in (None, *images):
            points = fuser(image for name, image in images.items() if name != missing).points
            offset_m = points.position_m[:, None, :2].astype(np.float64) - places_m[:, :2]
            apart_m = np.linalg.norm(offset_m, axis=2)
            offset_m = offset_m[np.arange(len(points)), apart_m.argmin(axis=1)]
            along = points.position_m[:, :2] / np.linalg.norm(points.position_m[:, :2], axis=1, keepdims=True)
            across = np.stack([-along[:, 1], along[:, 0]], axis=1)
            turned_m = np.stack([(offset_m * along).sum(axis=1), (offset_m * across).sum(axis=1)], axis=1)
            found[missing is None].append(np.concatenate([turned_m, points.uncertainty_m], axis=1))
            lost[missing is None] += int((apart_m.min(axis=0) > 0.1).sum())
    return {key: np.concatenate(each) for key, each in found.items()}, lost


@pytest.mark.parametrize("is_complete", [True, False])
@pytest.mark.parametrize("diameter_m", [0.012, 0.0])
def test_points_are_right_with_and_without_all_images(diameter_m, is_complete):
    found, lost = errors(diameter_m)
    error_m, sd_m = found[is_complete][:, :2], found[is_complete][:, 2:]
    assert np.sqrt(np.mean(np.sum(error_m**2, axis=1))) < (0.004 if is_complete else 0.006)
    assert np.linalg.norm(error_m, axis=1).max() < 0.03
    assert np.sqrt(np.mean((error_m / sd_m) ** 2)) < 1.5
    n_reflectors = 10 * len(SEEDS) * (1 if is_complete else 4)
    assert lost[is_complete] < (0.1 if is_complete else 0.2) * n_reflectors


def disturbed(late_m, turn_rad, power):
    """Disturbance of an echo ahead, of power 1, by one that comes later, from another direction."""
    direction = np.array([[[np.cos(turn_rad), np.sin(turn_rad), 0.0]]])
    predicted = PredictedEchoes(np.full((1, 1, 1), 2.0 + late_m), np.full((1, 1, 1), power), direction)
    ahead = np.array([[1.0, 0.0, 0.0]])
    found = overlap(
        predicted,
        np.zeros(1, np.int64),
        np.full((1, 1), 2.0),
        ahead,
        np.ones(1),
        np.ones((1, 1, 1), np.bool_),
        ahead=ahead,
        pulse_m=np.array([PULSE_M]),
        beam=np.array([BEAM]),
    )
    return [float(each[0, 0]) for each in found]


@pytest.mark.parametrize(("late_m", "turn_rad"), [(0.004, 0.0), (0.010, 0.05), (0.0, 0.1)])
def test_overlapping_echoes_have_an_error_of_their_separation(late_m, turn_rad):
    power, path_m2, angle_rad2 = disturbed(late_m, turn_rad, 1.0)
    assert power > 0.3
    assert np.sqrt(path_m2) == pytest.approx(0.28 * np.sqrt(power) * late_m)
    assert np.sqrt(angle_rad2) == pytest.approx(0.28 * np.sqrt(power) * np.sin(turn_rad), rel=0.02)


@pytest.mark.parametrize(("late_m", "turn_rad", "power"), [(1.0, 0.0, 1.0), (0.3, 0.6, 1.0), (0.01, 0.05, 1e-5)])
def test_distant_and_faint_echoes_disturb_nothing(late_m, turn_rad, power):
    assert disturbed(late_m, turn_rad, power) == [0.0, 0.0, 0.0]


def test_side_lobes_of_another_echo_shift_directions_within_their_deviations():
    """A post ahead, and one of 4 dB more, far beside it in angle, at about the same range."""
    random, place, extract = np.random.default_rng(500), mounted(1), EchoPointExtractor(settings_of())
    height_m, sensor_x_m = place["front"][0][2], place["front"][0][0]
    error_rad, sd_rad = [], []
    for _ in range(12):
        turn_rad, range_m = random.uniform(0.4, 1.0) * np.array([-1.0, 0.6]), random.uniform(1.0, 2.5)
        late_m = random.uniform(-0.04, 0.04)
        away_m = range_m + np.array([0.0, late_m / 2])
        places_m = np.stack([sensor_x_m + away_m * np.cos(turn_rad), away_m * np.sin(turn_rad), [height_m] * 2], axis=1)
        signals = rendered(
            place, settings_of(), places_m, np.array([0.0, 4.0]), diameter_m=0.0, random=random, noise=1e-6
        )
        found_m = extract(images_of(signals, settings_of())["front"]).position_m
        found_rad = np.arctan2(found_m[:, 1], found_m[:, 0])
        error_rad.append(found_rad[np.abs(found_rad - turn_rad[0]).argmin()] - turn_rad[0])
        sd_rad.append(np.sqrt(disturbed(late_m, turn_rad[1] - turn_rad[0], 10**0.4)[2]) / np.cos(turn_rad[0]))
    assert np.degrees(np.sqrt(np.mean(np.square(error_rad)))) > 0.2
    assert 0.3 < np.sqrt(np.mean((np.array(error_rad) / sd_rad) ** 2)) < 1.3

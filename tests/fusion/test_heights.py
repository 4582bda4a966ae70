"""Reflectors above or below the sensors of planar images: errors of fused points against their standard deviations."""

import functools

import numpy as np
import pytest
import scipy.optimize

import ertis_numba as ertis
from ertis_numba.fusion.heights import at_any_height
from ertis_numba.fusion.locating import LocatedReflector
from ertis_numba.fusion.sensor_echoes import PulseEchoes, SensorEchoes
from tests.small_platforms import HEIGHT_M, images_of, mounted, rendered, settings_of

YAWS_RAD = np.radians([0.0, 90.0, 180.0, -90.0])
SENSOR_M = np.array([place_m for place_m, _ in mounted().values()])
PATH_SD_M, ANGLE_SD_RAD = 1.2e-3, np.radians(0.2)
SLANT = 0.3
"""Ratio of the moments YZ and YY of an array of few microphones."""


def drawn(random, limit_deg, count):
    """Places of reflectors, 0.5 to 3.8 m from the platform, at most some degrees above or below the sensors."""
    range_m, turn_rad = random.uniform(0.5, 3.8, count), random.uniform(-np.pi, np.pi, count)
    up_rad = np.radians(random.uniform(-limit_deg, limit_deg, count))
    level_m = range_m * np.cos(up_rad)
    place_m = np.stack([level_m * np.cos(turn_rad), level_m * np.sin(turn_rad), range_m * np.sin(up_rad)], axis=1)
    return place_m + np.array([0.0, 0.0, HEIGHT_M])


def axes_of(yaw_rad):
    """Unit vectors ahead and to the left of a sensor."""
    return np.array([[np.cos(yaw_rad), np.sin(yaw_rad), 0.0], [-np.sin(yaw_rad), np.cos(yaw_rad), 0.0]])


def echoes_of(random, place_m, slant):
    """Echoes of reflectors at all sensors within 80° of ahead, for the calls of the two nearest emitters."""
    found = []
    for receiver, yaw_rad in enumerate(YAWS_RAD):
        ahead, left = axes_of(yaw_rad)
        offset_m = place_m - SENSOR_M[:, None]
        apart_m = np.linalg.norm(offset_m, axis=2)
        seen = offset_m[receiver] / apart_m[receiver, :, None]
        sine = seen @ left + slant * seen[:, 2]
        rows = np.flatnonzero((seen @ ahead > np.cos(np.radians(80.0))) & (np.abs(sine) < np.sin(np.radians(80.0))))
        for emitter in range(len(YAWS_RAD)):
            heard = rows[(np.argsort(apart_m[:, rows], axis=0)[:2] == emitter).any(axis=0)]
            turn_rad = np.arcsin(sine[heard]) + random.normal(0.0, ANGLE_SD_RAD, len(heard))
            path_m = apart_m[emitter, heard] + apart_m[receiver, heard] + random.normal(0.0, PATH_SD_M, len(heard))
            direction = np.cos(turn_rad)[:, None] * ahead + np.sin(turn_rad)[:, None] * left
            found += [
                (reflector, emitter, receiver, *each)
                for reflector, each in zip(heard.tolist(), zip(path_m, direction, strict=True), strict=True)
            ]
    return found


def level_place(start_m, rows):
    """Return the place at the height of the sensors that fits echoes best, by SciPy."""

    def residual(level_m):
        place_m = np.append(level_m, HEIGHT_M)
        for _, emitter, receiver, path_m, direction in rows:
            offset_m = place_m - SENSOR_M[receiver]
            to_m = np.linalg.norm(offset_m)
            yield (path_m - to_m - np.linalg.norm(place_m - SENSOR_M[emitter])) / PATH_SD_M
            yield np.cross(offset_m, direction)[2] / to_m / ANGLE_SD_RAD

    found = scipy.optimize.least_squares(lambda level_m: [*residual(level_m)], start_m, method="lm")
    covariance_m2 = np.diag([0.0, 0.0, 1e-6])
    covariance_m2[:2, :2] = np.linalg.inv(found.jac.T @ found.jac)
    return np.append(found.x, HEIGHT_M), covariance_m2


@functools.cache
def errors_and_deviations(limit_deg, slant, count=250):
    """Errors along and across in m, their standard deviations, and those of reflectors that are known to be level."""
    random = np.random.default_rng(int(10 * limit_deg + 100 * slant))
    place_m = drawn(random, limit_deg, count)
    every = echoes_of(random, place_m, slant)
    every.sort(key=lambda each: each[2])
    sensors = []
    for receiver in range(len(SENSOR_M)):
        rows = [each for each in every if each[2] == receiver]
        path_m = np.full((len(rows), len(SENSOR_M)), np.nan)
        path_m[np.arange(len(rows)), [each[1] for each in rows]] = [each[3] for each in rows]
        sd_m, sd_rad = np.full(len(rows), PATH_SD_M), np.full(len(rows), ANGLE_SD_RAD)
        flags = np.ones((2, len(rows)), np.bool_)
        direction = np.array([each[4] for each in rows])
        sensors.append(
            SensorEchoes(receiver, np.arange(4), direction, path_m, sd_m, sd_rad, sd_m, path_m, flags[0], ~flags[1])
        )
    echoes = PulseEchoes.joined(sensors, len(SENSOR_M))
    located, kept = [], []
    for reflector in range(count):
        numbers = [number for number, each in enumerate(every) if each[0] == reflector]
        if not numbers:
            continue
        kept.append(reflector)
        fitted = level_place(place_m[reflector, :2], [every[number] for number in numbers])
        emitter = np.array([every[number][1] for number in numbers])
        deviation = np.tile([PATH_SD_M, ANGLE_SD_RAD], (len(numbers), 1))
        located.append(LocatedReflector(*fitted, 1.0, np.array(numbers), emitter, deviation))
    moments = {}
    for receiver, yaw_rad in enumerate(YAWS_RAD):
        axes = np.stack([axes_of(yaw_rad)[1], [0.0, 0.0, 1.0]])
        moments[receiver] = 1e-4 * axes.T @ np.array([[1.0, slant], [slant, 0.4]]) @ axes
    position_m, covariance_m2 = at_any_height(located, echoes, SENSOR_M, moments)
    along = position_m[:, :2] / np.linalg.norm(position_m[:, :2], axis=1)[:, None]
    turned = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)
    error_m = np.einsum("rai,ri->ra", turned, position_m[:, :2] - place_m[kept, :2])
    level_m2 = np.array([each.covariance_m2 for each in located])
    sd_m, level_sd_m = (
        np.sqrt(np.einsum("rai,rij,raj->ra", turned, each[:, :2, :2], turned)) for each in (covariance_m2, level_m2)
    )
    return error_m, sd_m, level_sd_m


@pytest.mark.parametrize("slant", [0.0, SLANT])
@pytest.mark.parametrize("limit_deg", [0.0, 3.0, 10.0])
def test_errors_of_reflectors_at_any_height_fit_their_deviations(limit_deg, slant):
    error_m, sd_m, _ = errors_and_deviations(limit_deg, slant)
    ratio = error_m / sd_m
    assert (np.sqrt(np.mean(ratio**2, axis=0)) < 1.3).all()
    assert (np.mean(np.abs(ratio) < 2, axis=0) > 0.93).all()
    assert np.abs(ratio).max() < 6
    # Level reflectors have smaller errors than their deviations, which allow for other elevations.
    assert (np.sqrt(np.mean(ratio**2, axis=0)) > {0.0: 0.25, 3.0: 0.5, 10.0: 0.7}[limit_deg]).all()


def test_places_and_directions_of_level_reflectors_stay_accurate():
    error_m, sd_m, level_sd_m = errors_and_deviations(0.0, 0.0)
    assert np.sqrt(np.mean(error_m**2)) < 1.2 * np.sqrt(np.mean(level_sd_m**2))
    assert np.median(sd_m[:, 1]) < 1.1 * np.median(level_sd_m[:, 1])


@pytest.mark.parametrize("diameter_m", [0.012, 0.0])
def test_confirmed_points_of_rendered_reflectors_are_right_within_their_deviations(diameter_m):
    fuser, ratio = ertis.Fuser(mounted(), emitter_diameter_m=diameter_m), []
    for seed in (71, 72, 73):
        random = np.random.default_rng(seed)
        place_m = drawn(random, 10.0, 6)
        strength_db = 6 * np.log2(np.maximum(0.5, np.linalg.norm(place_m[:, :2], axis=1)))
        signals = rendered(mounted(), settings_of(), place_m, strength_db, diameter_m=diameter_m, random=random)
        points = fuser(images_of(signals, settings_of()).values()).points
        found_m = points.position_m[:, :2].astype(np.float64)
        offset_m = found_m[:, None] - place_m[:, :2]
        nearest = np.linalg.norm(offset_m, axis=2).argmin(axis=1)
        along = found_m / np.linalg.norm(found_m, axis=1)[:, None]
        turned = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)
        each_m = np.einsum("rai,ri->ra", turned, offset_m[np.arange(len(nearest)), nearest])
        ratio.append((each_m / points.uncertainty_m)[points.confirmed])
    ratio = np.concatenate(ratio)
    assert len(ratio) >= 12
    assert np.sqrt(np.mean(ratio**2)) < 1.5
    assert np.abs(ratio).max() < 5

"""Association of echoes with reflectors: exact and noisy echoes of known reflectors, and echoes without one."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.fusion.association import Reflectors
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.rig import Emitters, mounted_sensors
from ertis_numba.fusion.sensor_echoes import SensorEchoes

N_SENSORS = 4
PATH_SD_M, ANGLE_SD_RAD = 2e-3, math.radians(0.25)
GRID = PolarGrid.around(2.0, 0.03, 4.0, is_planar=True, height_m=0.0)
MODEL = Emitters(ertis.Settings(), [0.0] * N_SENSORS)


def sensors():
    """Four sensors, 0.2 m from the centre, each facing outwards."""
    found = {}
    for number in range(N_SENSORS):
        yaw_rad = number * math.pi / 2
        turned = (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))
        found[str(number)] = (0.2 * math.cos(yaw_rad), 0.2 * math.sin(yaw_rad), 0.0), turned
    return mounted_sensors(found)


def random_places(seed, count=6):
    draws = np.random.default_rng(seed)
    azimuth_rad = (np.arange(count) + draws.uniform(0.1, 0.9, count)) * 2 * math.pi / count
    range_m = draws.uniform(1.0, 3.0, count)
    return np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad), np.zeros(count)], axis=1)


def echoes_of(places_m, pairs=None, share=0.0, draws=None, *, is_flat=True):
    """Return echoes of reflectors of strength 1 at all pairs, mirrored from behind, with noise from `draws`."""
    mounted, found = sensors(), []
    for number, sensor in enumerate(mounted):
        path_m, direction, power = [], [], []
        for place_m in places_m:
            local_m = sensor.local_m(place_m[None])[0]
            if local_m[0] < 0 and not is_flat:
                continue
            to_m = np.linalg.norm(local_m)
            azimuth_rad = math.atan2(local_m[1], abs(local_m[0]))
            for emitter in range(N_SENSORS):
                if pairs is not None and (emitter, number) not in pairs:
                    continue
                noise = np.zeros(2) if draws is None else draws.normal(size=2)
                turned_rad = azimuth_rad + ANGLE_SD_RAD * noise[1]
                from_m = np.linalg.norm(place_m - mounted[emitter].translation_m)
                path_m.append(from_m + to_m + PATH_SD_M * noise[0])
                direction.append(sensor.rotation @ [math.cos(turned_rad), math.sin(turned_rad), 0.0])
                power.append(MODEL.spreading(from_m, to_m))
        count = len(path_m)
        found.append(
            SensorEchoes(
                receiver=number,
                emitters=np.arange(N_SENSORS),
                direction=np.array(direction).reshape(-1, 3),
                path_m=np.repeat(np.array(path_m).reshape(-1, 1), N_SENSORS, axis=1),
                path_sd_m=np.full(count, PATH_SD_M),
                angle_sd_rad=np.full(count, ANGLE_SD_RAD),
                power=np.array(power),
                share=np.full((count, N_SENSORS), share),
                is_clear=np.ones(count, bool),
                is_faint=np.zeros(count, bool),
            )
        )
    return found


def reflectors(echoes, bound=np.inf, *, is_flat=True, model=MODEL):
    receivers = {number: SimpleNamespace(is_flat=is_flat, pulse_m=0.014, width=0.14) for number in range(N_SENSORS)}
    models = dict.fromkeys(receivers, model)
    return Reflectors(echoes, sensors(), receivers, models, GRID, np.full(GRID.n_cells, bound, dtype=np.float32))


def errors_m(found, places_m):
    """Return the distance of the nearest reflector from each place."""
    return np.linalg.norm(found.position_m[:, None] - places_m, axis=2).min(axis=0, initial=np.inf)


@pytest.mark.parametrize("is_flat", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_reflectors_explain_all_echoes_without_the_help_of_an_attribution(seed, is_flat):
    """Of the 16 echoes of each reflector, 12 are foreign, and flat arrays show echoes from behind as if from ahead."""
    places_m = random_places(seed)
    found = reflectors(echoes_of(places_m, is_flat=is_flat), is_flat=is_flat)
    assert len(found.position_m) == len(places_m)
    assert errors_m(found, places_m).max() < 1e-3


def test_positions_are_more_precise_than_those_of_the_nearest_sensor():
    """All ranges and directions together cannot be worse than those of one sensor, and their covariance is right."""
    draws = np.random.default_rng(11)
    fused, single, normalized = [], [], []
    mounted = sensors()
    for seed in range(60):
        place_m = random_places(seed, 1)
        nearest = int(np.argmin([np.linalg.norm(place_m - each.translation_m) for each in mounted]))
        echoes = echoes_of(place_m, draws=draws)
        found = reflectors(echoes)
        offset_m = found.position_m[np.argmin(np.linalg.norm(found.position_m - place_m, axis=1))] - place_m[0]
        covariance_m2 = found.covariance_m2[0][:2, :2]
        normalized.append(offset_m[:2] @ np.linalg.solve(covariance_m2, offset_m[:2]))
        fused.append(offset_m)
        own = echoes[nearest]
        alone_m = mounted[nearest].translation_m + own.path_m[nearest, nearest] / 2 * own.direction[nearest]
        single.append(alone_m - place_m[0])
    fused_m, single_m = (np.sqrt(np.mean(np.square(each), axis=0)) for each in (fused, single))
    assert np.linalg.norm(fused_m) < 0.75 * np.linalg.norm(single_m)
    assert 1.2 < np.mean(normalized) < 3.5  # chi-squared with two degrees of freedom, wider for robust weights


@pytest.mark.parametrize(("share", "diameter_m", "count"), [(1.0, 0.012, 1), (0.0, 0.012, 0), (1.0, 0.0, 0)])
def test_own_echo_alone_is_a_reflector_if_attributed_and_few_pairs_should_hear_it(share, diameter_m, count):
    """Omnidirectional emitters would cause echoes at all pairs."""
    echoes = echoes_of(np.array([[1.5, 0.2, 0.0]]), pairs={(0, 0)})
    echoes[0].share[:, 0] = share
    found = reflectors(echoes, model=Emitters(ertis.Settings(), [diameter_m] * N_SENSORS))
    assert len(found.position_m) == count


def test_foreign_echo_alone_is_left_out():
    echoes = echoes_of(np.array([[1.5, 0.2, 0.0]]), pairs={(1, 0)})
    echoes[0].share[:, 1] = 1.0
    assert not len(reflectors(echoes).position_m)


def test_missing_echoes_exclude_reflectors():
    places_m = random_places(3)
    echoes = echoes_of(places_m)
    assert len(reflectors(echoes, bound=0.5).position_m) == len(places_m)
    assert not len(reflectors(echoes, bound=0.1).position_m)


def test_no_echoes_yield_no_reflectors():
    found = reflectors(echoes_of(np.empty((0, 3))))
    assert found.position_m.shape == (0, 3)
    assert found.covariance_m2.shape == (0, 3, 3)


def test_error_of_a_split_call_does_not_shrink_with_the_number_of_echoes():
    """Beside the beam of its emitter, the echoes of a call are early or late alike at all receivers."""
    model = Emitters(ertis.Settings(), [0.012] * N_SENSORS)
    place_m = np.array([[0.5, 0.9, 0.0]])  # 72° from the axis of the first sensor
    echoes = echoes_of(place_m, pairs={(0, receiver) for receiver in range(N_SENSORS)})
    heard = [each._replace(path_m=each.path_m + 8e-3, power=each.power * 10 ** (-14 / 10)) for each in echoes]
    found = reflectors(heard, model=model)
    error_m = found.position_m[0] - place_m[0]
    along = place_m[0] / np.linalg.norm(place_m)
    assert abs(along @ error_m) > 2e-3
    assert abs(along @ error_m) < 1.5 * np.sqrt(along @ found.covariance_m2[0] @ along)

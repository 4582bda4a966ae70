"""Echoes from before the first range of images, in signals that the tests render."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.near_echo import near_echo_m
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.storage import write_recording
from tests.small_platforms import HEIGHT_M, RATE_HZ, mounted, rendered, settings_of

SETTINGS = settings_of().replace("processing.range_m", (0.6, 3.5))
FAR_M, FAR_DB = [[1.8, 0.5, HEIGHT_M], [1.2, -1.7, HEIGHT_M], [-2.0, 0.2, HEIGHT_M]], [0.0, 3.0, 3.0]
FRONT_M = 0.2


def signals_with(near_m=(), strength_db=-6.0, *, seed=0, count=4, level=0.0, diameter_m=0.012):
    """Signals of a platform; ``near_m`` are places of reflectors, and ``level`` is the amplitude of direct sound."""
    places_m, strengths_db = [*FAR_M, *near_m], [*FAR_DB, *[strength_db] * len(near_m)]
    random = np.random.default_rng(seed)
    given = mounted(count)
    found = rendered(given, SETTINGS, places_m, strengths_db, diameter_m=diameter_m, random=random)
    mics_m, speed_m_s = np.asarray(microphones(SETTINGS.array).positions_m), sound_speed_m_s(SETTINGS.air)
    time_s = np.arange(len(found["front"])) / RATE_HZ
    own_s = np.linalg.norm(mics_m, axis=1) / speed_m_s
    direct = level * np.stack([call_at(SETTINGS.call, time_s - each_s) for each_s in own_s], axis=1)
    return {name: (each + direct).astype(np.float32) for name, each in found.items()}


def measured(signals):
    return {
        name: ertis.Measurement(each, SETTINGS, ertis.Stamp(sensor=name, sequence=0, sync_count=0, timestamp_ns=10**18))
        for name, each in signals.items()
    }


def others_m(name, count=4):
    places = {each: place for each, (place, _) in mounted(count).items()}
    return [math.dist(places[name], place) for each, place in places.items() if each != name]


@pytest.mark.parametrize("level", [0.0, 0.3])
@pytest.mark.parametrize(("range_m", "azimuth_deg"), [(0.25, 0), (0.3, -15), (0.4, 20), (0.5, 0), (0.52, -10)])
def test_obstacle_before_the_first_range_is_found_beside_direct_sound(range_m, azimuth_deg, level):
    turn = math.radians(azimuth_deg)
    place_m = [FRONT_M + range_m * math.cos(turn), range_m * math.sin(turn), HEIGHT_M]
    found = near_echo_m(measured(signals_with([place_m], level=level))["front"], others_m("front"))
    assert found == pytest.approx(range_m, abs=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_direct_sound_and_echoes_in_the_image_are_no_near_echoes(seed):
    level, diameter_m = (0.0, 0.1, 0.5)[seed % 3], (0.012, 0.0)[seed % 2]
    found = measured(signals_with(seed=seed, level=level, diameter_m=diameter_m))
    assert [near_echo_m(each, others_m(name)) for name, each in found.items()] == [None] * 4


def test_reflector_at_the_first_range_is_no_near_echo():
    found = measured(signals_with([[FRONT_M + 0.62, 0.0, HEIGHT_M]], 3.0))
    assert near_echo_m(found["front"], others_m("front")) is None


def test_passive_measurements_have_no_near_echo():
    found = measured(signals_with([[FRONT_M + 0.3, 0.0, HEIGHT_M]]))["front"]
    assert near_echo_m(replace(found, stamp=replace(found.stamp, behaviour="passive"))) is None


def test_fuse_names_the_sensor_and_the_range(tmp_path):
    found = measured(signals_with([[FRONT_M + 0.3, 0.0, HEIGHT_M]], count=2))
    write_recording(tmp_path / "rec.h5", [*found.values()], mounting=mounted(2))
    done = CliRunner().invoke(cli, ["fuse", str(tmp_path / "rec.h5"), "--json"])
    warnings = [each for each in json.loads(done.stdout)["warnings"] if "before the first range" in each]
    assert warnings[0].startswith("sensor front: the strongest echo comes from 0.3 m, perhaps of another sensor's call")


def test_obstacle_is_found_by_microphones_with_known_delays():
    """Delays of 20 µs, most of a period, which the layout states."""
    delay_s = np.random.default_rng(3).uniform(-20e-6, 20e-6, len(microphones(SETTINGS.array).positions_m))
    signals = signals_with([[FRONT_M + 0.3, 0.0, HEIGHT_M]])["front"]
    frequency_hz = np.fft.rfftfreq(len(signals), 1 / RATE_HZ)[:, None]
    late = np.fft.irfft(
        np.fft.rfft(signals, axis=0) * np.exp(-2j * np.pi * frequency_hz * delay_s), len(signals), axis=0
    )
    measurement = measured({"front": late.astype(np.float32)})["front"]
    positions_m = tuple(map(tuple, microphones(SETTINGS.array).positions_m.tolist()))
    array = SETTINGS.array.replace(layout="delayed", positions_m=positions_m, delay_s=tuple(delay_s.tolist()))
    stated = SETTINGS.replace(array=array)
    assert near_echo_m(replace(measurement, settings=stated), others_m("front")) == pytest.approx(0.3, abs=0.02)

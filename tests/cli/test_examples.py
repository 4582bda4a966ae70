"""Example programs that receive data from a central node or send data to it."""

import contextlib
import csv
import importlib.util
import io
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.geometry.air import transmission_loss_db
from ertis_numba.network.subscriber import Subscriber
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.scene import Scene
from ertis_numba.storage import write_recording
from tests.files import noise
from tests.publishing import Publisher, cloud, image
from tests.stand_in import StandIn

EXAMPLES = Path(__file__).parents[2] / "examples"
WAIT_S = 60.0


def example(name):
    (path,) = EXAMPLES.glob(f"?_{name}.py")
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def safety_stop():
    return example("safety_stop")


@pytest.fixture(scope="module")
def acoustic_flow():
    return example("acoustic_flow")


@pytest.fixture(scope="module")
def log_points():
    return example("log_points")


@contextlib.contextmanager
def running(monkeypatch, main, *arguments):
    """Run the main function of an example in a thread until the block ends; yield a function returning its output."""
    subscribers, printed = [], io.StringIO()

    class Kept(Subscriber):
        def __init__(self, *given, **named):
            super().__init__(*given, **named)
            subscribers.append(self)

    monkeypatch.setattr("ertis_numba.Subscriber", Kept, raising=False)
    monkeypatch.setattr(sys, "stdout", printed)
    thread = threading.Thread(target=main, args=arguments, daemon=True)
    thread.start()
    try:
        yield lambda: printed.getvalue().splitlines()
    finally:
        for subscriber in subscribers:
            subscriber.close()
        thread.join(WAIT_S)


# Safety stop: limits at 0.8 m and 1.6 m, released a quarter farther away and after three images.


def test_safety_stop_stops_at_once_and_resumes_late(safety_stop):
    way, speeds = safety_stop.Way(), []
    far, near = 5.0, 0.5
    for now_s, nearest_m in enumerate([far, far, far, far, far, far, near, far, far, far, near]):
        way.see(nearest_m, now_s)
        speeds.append(safety_stop.SPEEDS[way.speed])
    assert speeds == ["stop"] * 2 + ["slow"] * 3 + ["go", "stop", "stop", "stop", "slow", "stop"]


def test_safety_stop_has_hysteresis(safety_stop):
    way = safety_stop.Way()
    for now_s in range(20):
        way.see(0.9, now_s)  # beyond the stop limit, within the release limit
    assert way.speed == 0
    for now_s in range(3):
        way.see(1.1, now_s)
    assert way.speed == 1
    for now_s in range(20):
        way.see(0.9, now_s)
    assert way.speed == 1
    way.see(0.79, 20)
    assert way.speed == 0


def test_safety_stop_holds_through_missing_echoes(safety_stop):
    way = safety_stop.Way()
    for now_s in range(30):
        way.see(0.5 if now_s % 3 == 0 else 5.0, now_s)
    assert way.speed == 0


def test_safety_stop_waits_for_a_farther_echo_if_a_near_one_disappears(safety_stop):
    way = safety_stop.Way()
    for now_s, nearest_m in enumerate([5.0] * 6 + [0.6] + [np.inf] * 20):
        way.see(nearest_m, now_s)
    assert way.speed == 0
    for now_s in range(30, 33):
        way.see(3.0, now_s)
    assert way.speed == 1
    for now_s in range(40, 50):
        way.see(np.inf, now_s)  # the obstacle was far when it disappeared
    assert way.speed == 2


def test_safety_stop_stops_without_images(safety_stop):
    way = safety_stop.Way()
    for number in range(6):
        way.see(9.0, 0.1 * number)
    way.wait(0.9)
    assert way.speed == 2
    way.wait(1.1)
    assert way.speed == 0


def test_safety_stop_ignores_points_beside_and_behind(safety_stop):
    points = [[2.0, 0.3, 0.1], [0.4, 0.5, 0.0], [0.3, -0.41, 0.0], [-0.2, 0.0, 0.0]]
    assert safety_stop.nearest_in_way_m(cloud(position_m=points)) == 2.0
    assert safety_stop.nearest_in_way_m(cloud(position_m=[])) == np.inf


def test_safety_stop_prints_every_change_of_speed(safety_stop, monkeypatch):
    def now(sequence, x_m, late_s=0.0):
        made = cloud(sequence, position_m=[[x_m, 0, 0]])
        stamp = image(sequence, timestamp_ns=time.time_ns() - round(1e9 * late_s)).stamp
        return made.replace(stamp=stamp)

    def until(lines):
        publisher.pump(lambda: printed() == lines)

    def see(x_m, count=3, late_s=0.0):
        for _ in range(count):
            sequence = next(numbers)
            publisher.pump(lambda: all(peer.has_room for peer in publisher.peers.values()))
            publisher.publish(now(sequence, x_m, late_s))

    numbers = iter(range(100))
    monkeypatch.setattr(safety_stop, "SILENCE_S", WAIT_S)  # Images are late on a busy machine.
    with Publisher() as publisher, running(monkeypatch, safety_stop.main, publisher.address, "front") as printed:
        publisher.pump(lambda: len(publisher.peers) == 1)
        until(["stop"])  # no image arrived yet
        see(4.0, late_s=2 * WAIT_S)  # too old
        see(4.0, late_s=-2 * WAIT_S)  # stamped in the future
        see(4.0)
        until(["stop", "slow"])
        see(4.0)
        until(["stop", "slow", "go"])
        see(0.5, count=1)
        until(["stop", "slow", "go", "stop"])
        see(1.3)
        until(["stop", "slow", "go", "stop", "slow"])
        monkeypatch.setattr(safety_stop, "SILENCE_S", 0.1)
        until(["stop", "slow", "go", "stop", "slow", "stop"])  # no more images


# Acoustic flow.


def test_flow_measures_radial_speed_of_echoes(acoustic_flow):
    before = image(0, reflectors=[(-36, 1.2, 1.0), (36, 2.0, 0.5)])
    now = image(1, reflectors=[(-36, 1.15, 1.0), (36, 2.013, 0.5)])  # 0.1 s later
    directions, speeds_m_s = acoustic_flow.flow(before, now)
    azimuth_deg = np.degrees(now.azimuth_rad[directions])
    assert {-36, 36} <= set(np.round(azimuth_deg))
    # Elsewhere, the strongest echoes are side lobes of these.
    np.testing.assert_allclose(speeds_m_s[np.abs(azimuth_deg + 36) < 7], -0.5, atol=0.02)
    np.testing.assert_allclose(speeds_m_s[np.abs(azimuth_deg - 36) < 7], 0.13, atol=0.02)


def test_flow_is_empty_without_matching_echoes(acoustic_flow):
    directions, _ = acoustic_flow.flow(image(0, reflectors=[(0, 1.2, 1.0)]), image(1, reflectors=[(0, 2.2, 1.0)]))
    assert not len(directions)  # faster than the search range
    directions, _ = acoustic_flow.flow(image(0), image(1))
    assert not len(directions)


def test_flow_of_simulated_person_equals_the_true_speed(acoustic_flow):
    scene = Scene.from_toml(
        """
        seed = 5
        rate_hz = 10.0
        count = 2
        [[sensors]]
        name = "front"
        electronics.noise_dbfs = -60.0
        [[points]]
        position_m = [2.0, 0.5, 0.0]
        velocity_m_s = [-0.8, -0.2, 0.0]
        """
    )
    simulator = Simulator(scene)
    settings = simulator.sensor.settings()
    pipeline = Pipeline(settings.replace(processing=Processing(directions="90", range_m=(0.6, 4.0))), device="cpu")
    before, now = (pipeline.process(simulator.render(index)) for index in range(2))
    directions, speeds_m_s = acoustic_flow.flow(before, now)
    towards = np.array([2.0, 0.5]) / np.hypot(2.0, 0.5)
    nearest = np.abs(now.azimuth_rad[directions] - np.arctan2(0.5, 2.0)).argmin()
    assert speeds_m_s[nearest] == pytest.approx(np.array([-0.8, -0.2]) @ towards, abs=0.02)


def test_flow_example_prints_speeds_of_consecutive_images(acoustic_flow, monkeypatch):
    items = [image(k, reflectors=[(12, 2 - 0.05 * k, 1.0)]) for k in range(3)]
    with (
        Publisher() as publisher,
        running(monkeypatch, acoustic_flow.main, publisher.address, "front") as printed,
    ):
        publisher.pump(lambda: publisher.peers)
        for item in items:
            publisher.pump(lambda: all(peer.has_room for peer in publisher.peers.values()))
            publisher.publish(item)
        publisher.pump(lambda: len(printed()) == 2)
        assert printed()[0].startswith("#1: -0.5")
        assert printed()[1].startswith("#2: -0.5")


# Log of points.


def logged(log_points, path, capsys):
    items = [cloud(1, position_m=[[1, 0, 0], [0, 2, 0]]), cloud(2, position_m=[]), cloud(3, sensor="left")]
    with Publisher() as publisher, publisher.playing(items):
        log_points.main(publisher.address, str(path), "3")
    assert capsys.readouterr().out == f"{path}: 3 points of 3 clouds, 0 clouds dropped\n"
    return items


def test_point_log_csv_is_in_the_platform_frame(log_points, tmp_path, capsys):
    path = tmp_path / "points.csv"
    items = logged(log_points, path, capsys)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["sensor"], row["sequence"]) for row in rows] == [("front", "1"), ("front", "1"), ("left", "3")]
    assert rows[0]["timestamp_ns"] == str(items[0].stamp.timestamp_ns)
    # The points are rotated by half a turn about z and then moved by (1, 2, 3).
    places = [[float(row[axis]) for axis in ("x_m", "y_m", "z_m")] for row in rows]
    np.testing.assert_allclose(places, [[0, 2, 3], [1, 0, 3], [0, 2, 3]], atol=1e-6)
    assert [float(row["amplitude"]) for row in rows] == [1.0, 0.5, 1.0]
    assert [each.name for each in tmp_path.iterdir()] == ["points.csv"]


def test_point_log_npz_has_all_columns(log_points, tmp_path, capsys):
    path = tmp_path / "points.npz"
    logged(log_points, path, capsys)
    with np.load(path) as table:
        assert set(table) == set(log_points.COLUMNS)
        assert table["sequence"].tolist() == [1, 1, 3]
        assert table["sensor"].tolist() == ["front", "front", "left"]
        np.testing.assert_allclose(table["x_m"], [0, 1, 0], atol=1e-6)


def test_empty_point_log_is_a_table_without_rows(log_points, tmp_path):
    log_points.Log().save(tmp_path / "none.csv")
    assert (tmp_path / "none.csv").read_text() == ",".join(log_points.COLUMNS) + "\n"


# Measurements of a user's own program.


def test_send_your_own_example_stores_measurements(tmp_path, capsys):
    given = noise()
    write_recording(tmp_path / "given.h5", given)
    with StandIn() as central:
        example("send_your_own").main(central.address, str(tmp_path / "given.h5"))
    assert capsys.readouterr().out == "3 stored\n"
    ((key, held),) = central.held.items()
    assert key[0] == "mine"
    assert [words for _, words in held.values()] == [each.data.tobytes() for each in given]
    assert [*held] == [0, 1, 2]


# Leak of compressed air.


@pytest.fixture(scope="module")
def leak_recording(tmp_path_factory):
    scene = ertis.load_scene(EXAMPLES.parent / "data" / "synthetic" / "scenes" / "leak.toml")
    path = tmp_path_factory.mktemp("leak") / "leak.h5"
    return ertis.write_recording(path, [ertis.render(scene, index) for index in range(2)]), scene.noises[0]


def test_leak_example_prints_direction_uncertainty_and_source_level(leak_recording, capsys):
    path, leak = leak_recording
    example("find_a_leak").main(str(path), f"{leak.range_m}")
    azimuth, elevation, level = capsys.readouterr().out.splitlines()
    for line, name, true_deg in ((azimuth, "azimuth", leak.azimuth_deg), (elevation, "elevation", leak.elevation_deg)):
        found = re.fullmatch(rf"{name} ([+-][\d.]+)° ± ([\d.]+)°", line)
        assert 0 < float(found[2]) < 0.1
        assert float(found[1]) == pytest.approx(true_deg, abs=5 * float(found[2]))
    found = re.fullmatch(r"([\d.]+) dB re 20 µPa at 1 m from 40 to 80 kHz", level)
    every_hz = np.linspace(*leak.band_hz, 9001)
    density = leak.density(every_hz)
    share = density[(every_hz >= 40e3) & (every_hz <= 80e3)].sum() / density.sum()
    # The sensitivity of -26 dBFS is the level of a sine of 94 dB, relative to a full-scale sine.
    wanted_db = 94 + 26 + 3.01 + leak.level_db + 10 * np.log10(share)
    assert float(found[1]) == pytest.approx(wanted_db, abs=0.7)


def test_leak_example_states_the_level_at_the_array_without_a_distance(leak_recording, capsys):
    path, leak = leak_recording
    find_a_leak = example("find_a_leak")
    levels = []
    for arguments in ([str(path)], [str(path), f"{leak.range_m}"]):
        find_a_leak.main(*arguments)
        levels.append(re.fullmatch(r"([\d.]+) (.*) from 40 to 80 kHz", capsys.readouterr().out.splitlines()[-1]))
    assert [level[2] for level in levels] == ["dB re 20 µPa", "dB re 20 µPa at 1 m"]
    loss_db = transmission_loss_db(ertis.Settings().air, leak.range_m, np.array([np.sqrt(40e3 * 80e3)]))
    assert float(levels[1][1]) - float(levels[0][1]) == pytest.approx(loss_db[0], abs=0.2)


def test_leak_example_explains_unusable_input_in_one_line(leak_recording, tmp_path):
    """It claims no leak in echoes, or if no microphone works."""
    path, _ = leak_recording
    with ertis.open_recording(path) as recording:
        heard = recording[0]
    call = replace(heard, stamp=replace(heard.stamp, behaviour="active"))
    write_recording(tmp_path / "call.h5", [call])
    write_recording(tmp_path / "stuck.h5", [replace(heard, data=np.zeros_like(heard.data))])
    with ertis.AcousticCamera(heard.settings) as camera:
        ertis.write_acoustic_maps(tmp_path / "maps.h5", [camera.process(heard)])
    for arguments, message in {
        ("--help",): "pass a recording and, optionally, the distance of the leak in metres",
        ("none.h5",): "none.h5: No such file or directory",
        ("maps.h5",): "maps.h5 is a file of acoustic maps, wanted a recording",
        ("call.h5",): "call.h5 has measurements with a call; choose a recording of 'ertis capture --passive'",
        (
            "stuck.h5",
        ): "stuck.h5: stuck at 0: every channel; find the cause with 'ertis sensors check' and record again",
        (str(path), "near"): "could not convert string to float: 'near'",
    }.items():
        done = subprocess.run(
            [sys.executable, EXAMPLES / "8_find_a_leak.py", *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done.stderr
        assert done.stderr.startswith(message)


@pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")  # A small grid saves time.
def test_leak_example_finds_nothing_in_noise(tmp_path, capsys):
    settings = ertis.Settings().replace(**{"processing.directions": "3d:300", "processing.mode": "passive"})
    write_recording(tmp_path / "noise.h5", noise(settings, count=1))
    example("find_a_leak").main(str(tmp_path / "noise.h5"))
    assert capsys.readouterr().out == "no leak found\n"

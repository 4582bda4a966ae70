"""Poses and velocities of a platform from the images of a central node, as an application receives them."""

import contextlib
import json
import math
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.network.processes import until
from ertis_cli._listen_pulses import listen_pulses
from ertis_cli._product_printer import ProductTable
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.network.odometry_subscriber import OdometrySubscriber
from tests.pages import environment
from tests.publishing import (
    PATIENCE_S,
    PATIENT_APPLICATIONS,
    Publisher,
    end_when,
    events_of,
    image,
    patient_applications,
    results_of,
)

__all__ = ["patient_applications"]  # A fixture, imported for use here.

pytestmark = PATIENT_APPLICATIONS

AHEAD, BEHIND = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)
MOUNTINGS = {"front": ((0.2, 0.0, 0.0), AHEAD), "back": ((-0.2, 0.0, 0.0), BEHIND)}
STEP_M, STEP_RAD = np.array([0.05, 0.01]), math.radians(1.0)
MOUNTING_FILE = (
    '[[sensors]]\nname = "front"\nposition_m = [0.2, 0.0, 0.0]\n\n'
    '[[sensors]]\nname = "back"\nposition_m = [-0.2, 0.0, 0.0]\nyaw_deg = 180.0\n'
)


def places_m():
    """Reflectors around the path, at most one in each direction from a sensor."""
    draws = np.random.default_rng(4)
    angle_rad = np.radians(np.concatenate([np.arange(-40, 41, 16), 180 + np.arange(-40, 41, 16)]))
    range_m = draws.uniform(1.2, 2.4, len(angle_rad))
    return np.column_stack([range_m * np.cos(angle_rad), range_m * np.sin(angle_rad)])


def seen(pulse, sensor, **stamp):
    """The image of a sensor of the platform, which moves by a constant step at each pulse."""
    yaw_rad, position_m = pulse * STEP_RAD, pulse * STEP_M
    facing_rad = yaw_rad + (math.pi if sensor == "back" else 0.0)
    x_m = MOUNTINGS[sensor][0][0]
    relative_m = places_m() - position_m - x_m * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
    azimuth_deg = np.degrees(np.arctan2(relative_m[:, 1], relative_m[:, 0]) - facing_rad)
    azimuth_deg = (azimuth_deg + 180) % 360 - 180
    reflectors = [
        (float(azimuth), float(range_m), 0.5)
        for azimuth, range_m in zip(azimuth_deg, np.hypot(*relative_m.T), strict=True)
        if abs(azimuth) < 60
    ]
    return image(pulse, sensor=sensor, reflectors=reflectors, **stamp)


def pulses(*numbers, absent=()):
    return [[seen(number, sensor) for sensor in MOUNTINGS if (number, sensor) not in absent] for number in numbers]


def images(*numbers, **options):
    return [each for pulse in pulses(*numbers, **options) for each in pulse]


class MountedPublisher(Publisher):
    """Publisher that sends the mounting of each sensor."""

    def _describe(self, item, key, peer):
        self.translation_m, self.rotation_xyzw = MOUNTINGS[item.stamp.sensor]
        return super()._describe(item, key, peer)


def received(sent, last, *, publisher_type=Publisher, notes=None, patience_s=PATIENCE_S, **options):
    """Return arrivals up to a SYNC pulse, by count, and the trajectory; each pulse waits for the previous one.

    A pulse without an image of a sensor is returned after ``patience_s``.
    """
    found, used = {}, threading.Semaphore(0)

    def one_by_one():
        for pulse in sent:
            yield from pulse
            assert used.acquire(timeout=PATIENCE_S)

    def note(text):
        if notes is not None and text.startswith("SYNC pulse"):
            notes.append(text)
            used.release()

    with (
        pytest.MonkeyPatch.context() as patch,
        publisher_type() as publisher,
        publisher.playing(one_by_one()),
        OdometrySubscriber(publisher.address, **{"mountings": MOUNTINGS, "on_note": note} | options) as subscriber,
    ):
        patch.setattr("ertis_numba.network.pulse_receiver._PATIENCE_S", patience_s)
        while last not in found:
            arrival = subscriber.receive(2 * PATIENCE_S)
            assert arrival is not None
            found[arrival.sync_count] = arrival
            used.release()
        return found, subscriber.trajectory


def assert_at_step(pose, number):
    assert (pose.x_m, pose.y_m) == pytest.approx(tuple(number * STEP_M), abs=1e-3)
    assert pose.yaw_rad == pytest.approx(number * STEP_RAD, abs=2e-3)


def test_poses_and_velocities_are_those_of_the_platform():
    found, trajectory = received(pulses(*range(4)), 3)
    last = found[3]
    assert_at_step(last.pose, 3)
    assert math.hypot(*last.velocity.velocity_m_s) == pytest.approx(np.hypot(*STEP_M) / 0.1, abs=0.02)
    assert last.velocity.yaw_rate_rad_s == pytest.approx(STEP_RAD / 0.1, abs=0.02)
    assert (last.sensors, last.missing, last.age_s > 0) == (("front", "back"), (), True)
    assert (list(found), found[0].velocity) == ([0, 1, 2, 3], None)
    assert trajectory.time_ns.tolist() == [arrival.pose.timestamp_ns for arrival in found.values()]
    np.testing.assert_allclose(trajectory.position_m[-1], [*(3 * STEP_M), 0.0], atol=1e-3)


def test_missing_sensor_is_named_and_the_others_determine_the_motion():
    found, _ = received(pulses(0, 1, 2, 3, absent={(number, "back") for number in (2, 3)}), 3, patience_s=1.0)
    assert (found[3].sensors, found[3].missing) == (("front",), ("back",))
    assert found[3].pose.is_measured
    assert_at_step(found[3].pose, 3)


def test_lost_pulses_are_counted_and_bridged():
    found, _ = received(pulses(0, 1, 4), 4)
    assert [arrival.n_lost for arrival in found.values()] == [0, 0, 2]
    assert found[4].pose.is_measured
    assert_at_step(found[4].pose, 4)


def test_pulses_of_another_session_are_not_lost():
    restarted = [each.replace(stamp=replace(each.stamp, session_id=8, sync_count=50)) for each in images(2)]
    found, _ = received([*pulses(0, 1), restarted], 50)
    assert found[50].n_lost == 0
    assert_at_step(found[50].pose, 2)


def test_slow_application_gets_the_latest_pulses():
    end_s = time.monotonic() + PATIENCE_S
    with (
        Publisher() as publisher,
        publisher.playing(images(*range(6))),
        OdometrySubscriber(publisher.address, mountings=MOUNTINGS) as subscriber,
    ):
        while subscriber.n_skipped < 4:
            assert time.monotonic() < end_s
            time.sleep(0.01)
        arrivals = [subscriber.receive(PATIENCE_S) for _ in range(2)]
    assert [(arrival.sync_count, arrival.n_lost) for arrival in arrivals] == [(4, 0), (5, 0)]
    assert (subscriber.n_skipped, arrivals[1].pose.is_measured) == (4, True)


def test_pulse_after_a_long_gap_has_no_velocity():
    found, _ = received(pulses(0, 1, 20), 20)
    assert (found[20].velocity, found[20].pose.is_measured) == (None, False)


def test_sensor_that_joins_with_a_mounting_of_the_central_node_is_used():
    sent = pulses(*range(6), absent={(0, "back"), (1, "back")})
    found, _ = received(sent, 5, publisher_type=MountedPublisher, mountings=None, patience_s=1.0)
    assert set(found[5].sensors) == {"front", "back"}
    assert [arrival.sensors for arrival in found.values()][:2] == [("front",), ("front",)]
    assert found[5].velocity.n_matches > 8  # The front sensor has six reflectors.
    assert_at_step(found[5].pose, 5)


def test_pulse_of_a_clock_that_was_set_back_is_left_out_and_noted():
    early = seen(1, "front").stamp.timestamp_ns - 250_000_000
    notes = []
    sent = [*pulses(0, 1), [seen(2, sensor, timestamp_ns=early) for sensor in MOUNTINGS], *pulses(3)]
    found, _ = received(sent, 3, notes=notes)
    assert notes == ["SYNC pulse 2 is left out: it is 0.25 s before the last one; was a clock set back?"]
    assert (list(found), found[3].n_lost) == ([0, 1, 3], 1)
    assert_at_step(found[3].pose, 3)


def test_path_begins_with_the_first_pulse_of_all_sensors():
    """An application that connects during a pulse misses the images that were sent before."""
    sent = [[seen(0, "back")], *pulses(1, 2)]
    found, trajectory = received(sent, 2, patience_s=1.0)
    assert [found[count].sensors for count in (0, 1)] == [("back",), ("front", "back")]
    assert len(trajectory) == 2
    assert found[2].pose.is_measured
    assert math.hypot(found[2].pose.x_m, found[2].pose.y_m) == pytest.approx(np.hypot(*STEP_M), abs=1e-3)


def test_sensor_that_given_mountings_lack_is_noted():
    notes = []
    with (
        MountedPublisher() as publisher,
        publisher.playing(images(0)),
        OdometrySubscriber(
            publisher.address, mountings={"front": MOUNTINGS["front"]}, on_note=notes.append
        ) as subscriber,
    ):
        subscriber.receive(PATIENCE_S)
        assert until(lambda: "the given mountings lack sensor back; that of the central node applies" in notes)


def test_sensors_of_unknown_mountings_are_left_out_and_noted():
    notes = []
    with Publisher() as publisher:
        publisher.translation_m = publisher.rotation_xyzw = None
        with (
            publisher.playing(images(0, 1)),
            OdometrySubscriber(publisher.address, on_note=notes.append) as subscriber,
        ):
            assert until(lambda: sum("is left out, because its mounting is unknown" in note for note in notes) == 2)
        assert subscriber.trajectory is None


def test_closed_odometry_subscriber_ends_the_loop():
    with Publisher() as publisher, publisher.playing([]), OdometrySubscriber(publisher.address) as subscriber:
        assert subscriber.receive(0.05) is None
        subscriber.close()
        assert list(subscriber) == []


def test_invalid_address_is_refused():
    with pytest.raises(ArgumentError, match="nowhere"):
        OdometrySubscriber("nowhere")


@pytest.fixture
def mounting(tmp_path):
    path = tmp_path / "mounting.toml"
    path.write_text(MOUNTING_FILE)
    return path


def test_listen_prints_poses_and_writes_the_trajectory(tmp_path, mounting):
    target = tmp_path / "path.tum"
    arguments = ["--odometry", "--mounting", str(mounting), "-n", "2", "--duration", "200", "-o", str(target)]
    with Publisher() as publisher, publisher.playing(images(*range(6))):
        shown = CliRunner().invoke(cli, ["listen", publisher.address, *arguments, "--json"])
    assert shown.exit_code == 0, shown.output
    subscribed, first, second, summary = map(json.loads, shown.stdout.splitlines())
    assert (subscribed["event"], subscribed["products"]) == ("subscribed", ["energyscape"])
    assert (first["event"], first["x_m"], first["velocity_m_s"], first["measured"]) == ("odometry", 0.0, None, True)
    assert math.hypot(*second["velocity_m_s"]) == pytest.approx(np.hypot(*STEP_M) / 0.1, abs=0.02)
    assert second["yaw_rate_deg_s"] == pytest.approx(10.0, abs=1.0)
    assert (second["sensors"], second["missing"], np.shape(second["covariance"])) == (["front", "back"], [], (3, 3))
    assert second["lost"] == second["sync_count"] - first["sync_count"] - 1
    assert (summary["received"], summary["dropped"]) == (2, 0)
    assert f"{target}: 2 poses" in shown.stderr
    path = ertis.read_trajectory(target)
    assert path.time_ns.tolist() == [first["timestamp_ns"], second["timestamp_ns"]]
    assert path.position_m[1].tolist() == pytest.approx([second["x_m"], second["y_m"], 0.0], abs=1e-5)


def test_listen_prints_a_line_per_pose(mounting, monkeypatch):
    sent = images(0, 1, 2, 20, absent={(20, "back")})
    arguments = ["--odometry", "--mounting", str(mounting), "--duration", "3"]
    arrivals = results_of(monkeypatch, OdometrySubscriber, "receive")
    end_when(
        monkeypatch, "ertis_cli._listen_pulses", lambda: any(each and each.sync_count == 20 for each in arrivals[:-1])
    )
    with Publisher() as publisher, publisher.playing(sent):
        shown = CliRunner().invoke(cli, ["listen", publisher.address, *arguments])
    assert shown.exit_code == 0, shown.output
    head, *_, last = shown.stdout.splitlines()
    assert head.split() == ["SYNC", "age", "x", "y", "yaw", "speed", "yaw", "rate", "sensors"]
    assert re.search(r" -   +-  front, without back, \d+ pulses lost, last velocity assumed$", last)


def test_ctrl_c_ends_listen_and_writes_the_trajectory(tmp_path, mounting):
    target = tmp_path / "path.tum"
    command = [sys.executable, "-m", "ertis_cli.main", "listen"]
    with Publisher() as publisher, publisher.playing(images(0, 1)):
        arguments = [publisher.address, "--odometry", "--mounting", str(mounting), "--json", "-o", str(target)]
        with subprocess.Popen(
            [*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(tmp_path)
        ) as process:
            came = events_of(process.stdout)
            _, first = next(came), next(came)
            process.send_signal(signal.SIGINT)
            rest, errors = process.communicate()
    assert process.returncode == 0, errors
    assert json.loads(rest.splitlines()[-1])["event"] == "listened"
    assert ertis.read_trajectory(target).time_ns[0] == first["timestamp_ns"]


def test_sensor_of_unknown_mounting_does_not_end_listen(tmp_path):
    (tmp_path / "front.toml").write_text('[[sensors]]\nname = "front"\nposition_m = [0.2, 0.0, 0.0]\n')
    target = tmp_path / "path.tum"
    arguments = [
        "--odometry",
        "--mounting",
        str(tmp_path / "front.toml"),
        "--json",
        "-n",
        "2",
        "--duration",
        "60",
        "-o",
        str(target),
    ]
    command = [sys.executable, "-m", "ertis_cli.main", "listen"]
    came = threading.Event()

    def items():
        yield seen(0, "front")
        assert came.wait(60.0)
        yield seen(1, "back")
        yield seen(2, "front")

    with Publisher() as publisher:
        publisher.translation_m = publisher.rotation_xyzw = None
        with (
            publisher.playing(items()),
            subprocess.Popen(
                [*command, publisher.address, *arguments],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=environment(tmp_path),
            ) as process,
        ):
            came_of = events_of(process.stdout)
            _, event = next(came_of), next(came_of)["event"]
            assert event == "odometry"
            came.set()
            rest, errors = process.communicate()
    assert json.loads(rest.splitlines()[-1]) == {"event": "listened", "received": 2, "dropped": 0, "skipped": 0}
    assert (process.returncode, errors.count("sensor back is left out, because its mounting is unknown")) == (0, 1), (
        errors
    )
    assert len(ertis.read_trajectory(target).time_ns) == 2


def test_listen_without_pulses_writes_no_trajectory(tmp_path, monkeypatch):
    target = tmp_path / "path.tum"
    connected = results_of(monkeypatch, ProductTable, "subscribed")
    end_when(monkeypatch, "ertis_cli._listen_pulses", lambda: connected)
    with Publisher() as publisher, publisher.playing([]):
        arguments = ["--odometry", "-o", str(target), "--duration", "0.3"]
        shown = CliRunner().invoke(cli, ["listen", publisher.address, *arguments])
    assert shown.exit_code == 0, shown.output
    assert f"{target} is not written, because no pulse was received" in shown.stderr
    assert not target.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--odometry", "--fuse"], "--fuse and --odometry cannot be combined"),
        (["--odometry", "--product", "points"], "--product applies only without --odometry"),
        (["--odometry", "--save", "a.h5"], "--save applies only without --odometry"),
        (["--fuse", "-o", "a.tum"], "-o applies only with --odometry; --save FILE.h5 saves products"),
        (["-o", "a.tum"], "-o applies only with --odometry"),
    ],
)
def test_listen_refuses_options_that_do_not_fit_odometry(arguments, message):
    shown = CliRunner().invoke(cli, ["listen", "tcp://127.0.0.1:5602", *arguments])
    assert (shown.exit_code, message in shown.output) == (2, True), shown.output


class _Silent(contextlib.nullcontext):
    """Stand-in for a connected subscriber that receives nothing at first."""

    connected, n_skipped, counts = True, 0, SimpleNamespace(dropped=0, received=0)

    def __init__(self):
        super().__init__(self)
        self._items = iter([None, "pulse"])

    def receive(self, _):
        return next(self._items)

    def close(self):
        pass


def test_listen_notes_that_no_image_of_a_sensor_comes(monkeypatch, capsys):
    monkeypatch.setattr("ertis_cli._product_printer._SILENT_S", 0.0)
    options = {"head": "", "n": 1, "duration": None, "quiet": False, "as_json": False}
    listen_pulses("tcp://here", ["nope"], lambda _: _Silent(), lambda _: None, **options)
    assert "no energyscape of nope received from tcp://here yet; is 'ertis capture --to'" in capsys.readouterr().err


def test_listen_refuses_mountings_without_the_sensor(mounting):
    arguments = ["--odometry", "--sensor", "nope", "--mounting", str(mounting)]
    shown = CliRunner().invoke(cli, ["listen", "tcp://127.0.0.1:1", *arguments])
    assert shown.exit_code == 1
    assert "does not contain sensor 'nope'; add its mounting, or use sensors of this file: front" in shown.output


def test_listen_refuses_a_trajectory_of_another_format_at_once(tmp_path):
    shown = CliRunner().invoke(cli, ["listen", "tcp://127.0.0.1:1", "--odometry", "-o", str(tmp_path / "path.csv")])
    assert shown.exit_code == 1
    assert "path.csv ends in .csv, but poses are written as TUM text" in str(shown.exception) + shown.output


def test_listen_refuses_an_existing_trajectory_at_once(tmp_path):
    target = tmp_path / "path.tum"
    target.write_text("mine")
    shown = CliRunner().invoke(cli, ["listen", "tcp://127.0.0.1:1", "--odometry", "-o", str(target)])
    assert (shown.exit_code, target.read_text()) == (1, "mine"), shown.output
    assert "path.tum exists; choose another name" in str(shown.exception) + shown.output

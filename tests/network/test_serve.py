"""``ertis serve`` as a process: it receives measurements, publishes images, and survives killed workers."""

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.frames import Energyscape, Measurement, Stamp
from ertis_numba.journal import JournalEntry
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ClientKeys, KeyPair
from ertis_numba.network.messages import Group
from ertis_numba.network.sensor_node import SensorNode
from ertis_numba.network.status import Status
from ertis_numba.network.subscriber import Subscriber
from ertis_numba.pipeline import Pipeline
from ertis_numba.storage import open_recording
from tests.cases import CASES, SHORT, noise
from tests.network.test_record import REPORTED

TIMEOUT_S = 60.0
MEASUREMENT = noise(SHORT)
LOOPBACK = ("--listen", "tcp://127.0.0.1:0", "--publish", "tcp://127.0.0.1:0")


class Served:
    """Process of ``ertis serve`` with its events and its final report."""

    def __init__(self, process):
        self.process = process
        self.started = self.event("listening")
        self.listen, self.publish = self.started["address"], self.started["publish"]

    def event(self, name):
        for line in self.process.stdout:
            if (event := json.loads(line))["event"] == name:
                return event
        raise AssertionError(f"it ended without {name!r}: {self.process.stderr.read()}")

    def end(self):
        self.process.send_signal(signal.SIGINT)
        served = self.event("served")
        assert self.process.wait(TIMEOUT_S) == 0
        return served


@contextmanager
def serving(*options, quiet=True):
    command = [sys.executable, "-m", "ertis_cli", "serve", "--json", *(["--quiet"] if quiet else []), *options]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            yield Served(process)
        finally:
            process.kill()


class Sensors:
    """Sensors of one node that measure at the same time."""

    def __init__(self, node, *names, passive=()):
        self.node, self.names, self.passive, self.numbers = node, names, passive, itertools.count()
        for name in names:
            node.add_sensor(name, SHORT, translation_m=(0.5, 0.0, 0.0))

    def measure(self):
        number, now_ns = next(self.numbers), time.time_ns()
        stamps = [
            Stamp(
                sensor=name,
                sequence=number,
                sync_count=number,
                session_id=11,
                timestamp_ns=now_ns,
                behaviour="passive" if name in self.passive else "active",
            )
            for name in self.names
        ]
        self.node.append(
            [JournalEntry(Measurement(MEASUREMENT.data, SHORT, stamp), time.monotonic_ns()) for stamp in stamps]
        )


def received(subscriber, kind):
    """Return the next product of a kind."""
    end_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end_s:
        product = subscriber.receive(1.0)
        if isinstance(product, kind):
            return product
    raise AssertionError(f"no {kind.__name__} has come")


def local(address):
    """Return an address with the local host in place of all interfaces."""
    assert address.startswith("tcp://0.0.0.0:")
    return address.replace("0.0.0.0", "127.0.0.1")


def is_gone(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_serve_publishes_images_and_stores_measurements(tmp_path):
    """Measurements of one-bit and of PCM microphones are sent, stored and imaged alike."""
    pcm = noise(CASES["PCM, calibrated"])
    storing = (
        "--record",
        str(tmp_path),
        "--name",
        "tour",
        "--rotate-every",
        "500",
        "--quarantine",
        str(tmp_path / "q"),
    )
    with (
        serving(*LOOPBACK, *storing, "--workers", "1", "--device", "cpu") as served,
        SensorNode(served.listen) as node,
        Subscriber(served.publish, products=("energyscape", "group", "status"), credit=64) as subscriber,
    ):
        received(subscriber, Status)
        sensors = Sensors(node, "left", "right")
        images, groups = [], []
        for number in range(4):
            sensors.measure()
            while len(images) < 2 * (number + 1) or len(groups) <= number:
                product = subscriber.receive(TIMEOUT_S)
                assert product is not None
                images += [product] * isinstance(product, Energyscape)
                groups += [product] * isinstance(product, Group)
        node.add_sensor("ring", pcm.settings)
        stamp = Stamp(sensor="ring", session_id=11, timestamp_ns=time.time_ns())
        node.append([JournalEntry(Measurement(pcm.data, pcm.settings, stamp), time.monotonic_ns())])
        image_of_pcm = received(subscriber, Energyscape)
        assert node.flush(TIMEOUT_S)
        reported = served.end()
    assert set(reported) == REPORTED
    assert (tmp_path / "q").is_dir()
    with Pipeline(SHORT, device="cpu") as pipeline:
        wanted = pipeline.process(MEASUREMENT)
    assert all(np.array_equal(image.amplitude, wanted.amplitude) for image in images)
    with Pipeline(image_of_pcm.settings, max_error_db=image_of_pcm.settings.accuracy.max_error_db) as pipeline:
        assert np.array_equal(image_of_pcm.amplitude, pipeline.process(pcm).amplitude)
    assert {(image.stamp.sensor, image.stamp.sequence) for image in images} == set(
        itertools.product(("left", "right"), range(4))
    )
    assert [image.stamp.behaviour for image in [*images, image_of_pcm]] == ["active"] * 8 + ["unknown"]
    assert [(group.sensors, group.flags) for group in groups] == [(("left", "right"), ())] * 4
    (recording,) = reported["recordings"]
    assert Path(recording).name.startswith("tour_")
    with open_recording(recording, sensor="ring") as stored:
        assert np.array_equal(stored[0].data, pcm.data)
    for name in ("left", "right"):
        sensor = reported["sensors"][name]
        assert (sensor["received"], sensor["published"], sensor["stored"], sensor["dropped"]) == (4, 4, 4, {})
        with open_recording(recording, sensor=name) as stored:
            assert {stamp.behaviour for stamp in stored.stamps()} == {"active"}
            assert [measurement.stamp.sequence for measurement in stored] == [0, 1, 2, 3]


def test_serve_stores_and_forwards_passive_measurements_without_images(tmp_path):
    count = 5
    with (
        serving(*LOOPBACK, "--record", str(tmp_path), "--workers", "1", "--device", "numpy", quiet=False) as served,
        SensorNode(served.listen) as node,
        Subscriber(served.publish, products=("energyscape", "raw", "status"), credit=64) as subscriber,
        Subscriber(served.publish, credit=64) as of_images,
    ):
        while len(received(subscriber, Status).processing.subscribers) < 2:
            pass
        sensors = Sensors(node, "ear", "eye", passive=("ear",))
        found = []
        for number in range(count):
            sensors.measure()
            while len(found) < 3 * (number + 1):  # two measurements, one image
                product = subscriber.receive(TIMEOUT_S)
                assert product is not None
                found += [product] * isinstance(product, Energyscape | Measurement)
        assert node.flush(TIMEOUT_S)
        while (status := received(subscriber, Status)).sensors["ear"].passive < count:
            pass
        assert [received(of_images, Energyscape).stamp.sequence for _ in range(count)] == list(range(count))
        assert of_images.counts.missed == of_images.counts.dropped == 0
        assert subscriber.counts.missed == subscriber.counts.dropped == 0
        reported = served.end()
        log = served.process.stderr.read().splitlines()
    images = [each.stamp for each in found if isinstance(each, Energyscape)]
    raw = [each for each in found if isinstance(each, Measurement) and each.stamp.sensor == "ear"]
    assert [(stamp.sensor, stamp.sequence) for stamp in images] == [("eye", number) for number in range(count)]
    assert [each.stamp.sequence for each in raw] == list(range(count))
    assert all(each.stamp.behaviour == "passive" and np.array_equal(each.data, MEASUREMENT.data) for each in raw)
    for name, passive in (("ear", count), ("eye", 0)):
        assert status.sensors[name].dropped == {}
        sensor = reported["sensors"][name]
        assert (sensor["received"], sensor["stored"], sensor["published"]) == (count, count, count)
        assert (sensor["passive"], sensor["dropped"]) == (passive, {})
    with open_recording(reported["recordings"][0], sensor="ear") as stored:
        assert [each.stamp.sequence for each in stored] == list(range(count))
        assert all(np.array_equal(each.data, MEASUREMENT.data) for each in stored)
    (line,) = (line for line in log if "no images" in line)
    assert "INFO" in line.upper()
    assert "ear" in line
    assert f"{count} published, {count} of them without an image, because no call was emitted" in "\n".join(log)


def test_killed_worker_loses_no_measurement_and_no_process_remains():
    with (
        serving(*LOOPBACK, "--workers", "1", "--device", "numpy") as served,
        SensorNode(served.listen) as node,
        Subscriber(served.publish, products=("energyscape", "status"), credit=64) as subscriber,
    ):
        status = received(subscriber, Status)
        sensors = Sensors(node, "front")
        sensors.measure()
        received(subscriber, Energyscape)
        (worker,) = status.processing.workers
        os.kill(worker.pid, signal.SIGKILL)
        sensors.measure()
        image = received(subscriber, Energyscape)
        assert image.stamp.sequence == 1
        assert node.flush(TIMEOUT_S)
        while (status := received(subscriber, Status)).sensors["front"].published < 2:
            pass
        front = status.sensors["front"]
        assert (front.received, front.dropped, front.in_flight) == (2, {}, 0)
        assert status.processing.respawned == 1
        pids = [status.processing.publisher_pid, *(each.pid for each in status.processing.workers)]
        served.process.kill()
        served.process.wait(TIMEOUT_S)
        end_s = time.monotonic() + TIMEOUT_S
        while not all(map(is_gone, pids)):
            assert time.monotonic() < end_s, pids
            os.sched_yield()


def test_keys_grant_each_node_its_listed_permissions(tmp_path):
    pairs = {name: KeyPair.new(name) for name in ("central", "viewer", "front")}
    for pair in pairs.values():
        pair.save(tmp_path / "keys")
    allow = tmp_path / "keys" / "allow.toml"
    listed = AllowList(
        keys=(
            Permission(name="viewer", public=pairs["viewer"].public, role="application"),
            Permission(name="front", public=pairs["front"].public, role="sensor", serials=("front",)),
        )
    )
    listed.save(allow)
    keys = {name: ClientKeys(pair, pairs["central"].public) for name, pair in pairs.items()}
    options = ("--key", str(tmp_path / "keys" / "central.secret.toml"), "--allow", str(allow))
    open_to_all = ("--listen", "tcp://0.0.0.0:0", "--publish", "tcp://0.0.0.0:0")
    notes = []
    with (
        serving(*open_to_all, *options, "--workers", "1", "--device", "numpy") as served,
        SensorNode(local(served.listen), keys=keys["front"]) as node,
        Subscriber(local(served.publish), products=("energyscape", "status"), keys=keys["viewer"]) as subscriber,
        Subscriber(local(served.publish), keys=keys["front"], on_note=notes.append) as another,
    ):
        received(subscriber, Status)
        Sensors(node, "front").measure()
        assert received(subscriber, Energyscape).stamp.sensor == "front"
        while not notes:
            another.receive(0.1)
        assert another.counts.received == 0
    assert any("front has the role sensor" in note for note in notes)


@pytest.mark.parametrize(
    ("options", "reported", "code"),
    [
        (("--publish", "tcp://0.0.0.0:0"), "there are no keys", 1),
        (("--quarantine", "missing/folder"), "missing/folder: No such file or directory; choose a folder", 1),
        (("--record", "missing", "--rotate-size", "0"), "--rotate-size is 0; use a number from 1", 2),
        (("--metrics", "foo"), "--metrics is 'foo'; use HOST:PORT", 2),
        (("--duration", "0"), "--duration is 0; use a number above 0", 2),
        (("--deadline", "0"), "--deadline is 0; use a number above 0", 2),
        (("--range", "5:1"), "--range runs from 5 to 1", 2),
        (("--listen", "nonsense"), "error: --listen 'nonsense' cannot be used; use tcp://HOST:PORT", 2),
        (("--publish", "nonsense"), "error: --publish 'nonsense' cannot be used; use tcp://HOST:PORT", 2),
        (("--publish", "tcp://[1::2::3]:1"), "error: --publish 'tcp://[1::2::3]:1' cannot be used", 2),
        (("--directions", "foo"), "directions 'foo' is not a grid; use 90", 2),
        (("--directions", "3x:5"), "directions '3x:5' is not a grid; use 90", 2),
        (("--directions", "2d:0"), "count of directions '2d:0' is 0; use a whole number from 1", 2),
        (("--directions", "2d:1000001"), "count of directions '2d:1000001' is 1000001; use a whole number from 1", 2),
        (("--directions", "2d:99999999999"), "directions '2d:99999999999' has a count of 11 digits; use at most", 2),
        (
            ("--directions", "missing.csv"),
            "directions missing.csv: No such file or directory; choose a readable CSV",
            1,
        ),
    ],
)
def test_serve_refuses_invalid_options_in_one_line(options, reported, code):
    serve = ["serve", "--listen", "tcp://127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--duration", "0.1"]
    done = CliRunner().invoke(cli, [*serve, *options])
    assert done.exit_code == code
    (line,) = done.stderr.splitlines()
    assert reported in line


def test_serve_refuses_directions_of_its_environment_variable():
    serve = ["serve", "--listen", "tcp://127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--duration", "0.1"]
    done = CliRunner().invoke(cli, serve, env={"ERTIS_SERVE_DIRECTIONS": "foo"})
    assert done.exit_code == 2
    (line,) = done.stderr.splitlines()
    assert "directions 'foo' is not a grid" in line
    assert "(from the variable ERTIS_SERVE_DIRECTIONS)" in line


def test_refused_serve_leaves_no_files(tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        publish = ("--publish", f"tcp://127.0.0.1:{other.getsockname()[1]}")
        folders = ("--record", str(tmp_path / "new"), "--quarantine", str(tmp_path / "q"))
        done = CliRunner().invoke(cli, ["serve", "--listen", "tcp://127.0.0.1:0", *publish, *folders])
    assert done.exit_code == 1
    assert "is in use by another program; end that program or choose another --publish" in done.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())

"""``ertis capture --to``: measurements reach a central node, or the command reports an error."""

import contextlib
import json
import queue
import signal
import subprocess
import sys
import zlib

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import RefusedError
from ertis_numba.devices.capture import CaptureSession
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.emulator import Emulator
from ertis_numba.devices.setup import Setup
from ertis_numba.network import messages
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.central_client import CentralClient
from ertis_numba.network.keys import KeyPair, ServerKeys
from ertis_numba.network.log import logger
from ertis_numba.network.pose_publisher import PosePublisher
from ertis_numba.network.processing import ProcessingOptions
from ertis_numba.network.processing.publisher import Publisher
from ertis_numba.network.sensor_node import SensorNode
from ertis_numba.settings import Call, Processing, Recording, Settings
from ertis_numba.storage import open_recording, sensor_names
from tests.central import Node, running
from tests.emulated import N_SAMPLES, PATIENT, PATIENT_ERTIS, patient
from tests.journals import ENVIRONMENT, TINY, entries
from tests.stand_in import StandIn

__all__ = ["patient"]  # A fixture, imported for use here.

pytestmark = PATIENT
ERTIS = (sys.executable, "-m", "ertis_cli")
SETTINGS = Settings(recording=Recording(n_samples=N_SAMPLES), processing=Processing(range_m=(0.1, 0.5)))
SOON_S = 60.0
MOUNTING = """
[[sensors]]
name = "one"
position_m = [0.2, 0.0, 0.4]

[[sensors]]
name = "two"
position_m = [0.0, -0.5, 0.4]
yaw_deg = -90.0
"""
TURNED = ((0.0, -0.5, 0.4), (0.0, 0.0, -(0.5**0.5), 0.5**0.5))


@pytest.fixture(scope="module")
def words():
    """Four measurements cut from one simulated measurement."""
    whole = open_recording("data/synthetic/reflectors.h5")[0].data
    return [np.ascontiguousarray(whole[start : start + N_SAMPLES]) for start in range(0, 4 * N_SAMPLES, N_SAMPLES)]


@pytest.fixture
def sensors(tmp_path, words):
    (tmp_path / "settings.toml").write_text(SETTINGS.to_toml())
    (tmp_path / "mounting.toml").write_text(MOUNTING)
    with (
        Emulator(words, name="one", link=tmp_path / "one") as one,
        Emulator(words[::-1], name="two", link=tmp_path / "two") as two,
    ):
        yield one, two


def command(tmp_path, *arguments, ports=("one",)):
    given = [part for port in ports for part in ("--port", str(tmp_path / port), "--name", port)]
    return ["capture", "--settings", "settings.toml", "--json", *given, *map(str, arguments)]


def start(tmp_path, *arguments):
    """Start a capture in its own process, which signals may end."""
    line = [*PATIENT_ERTIS, *command(tmp_path, *arguments)]
    return subprocess.Popen(
        line, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def run(tmp_path, *arguments, **options):
    """Run a capture in this process."""
    with contextlib.chdir(tmp_path):
        done = CliRunner().invoke(cli, command(tmp_path, *arguments, **options))
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, [json.loads(line) for line in done.stdout.splitlines()], done.stderr


def held_crc32(central):
    """CRC-32 of each measurement that a central node holds, by sensor, session and number."""
    return {
        (*key, number): message.crc32 for key, held in central.held.items() for number, (message, _) in held.items()
    }


def kept(events, name="crc32"):
    return {(each["sensor"], each["session_id"], each["sequence"]): each[name] for each in events if name in each}


@pytest.mark.usefixtures("sensors")
def test_capture_to_delivers_measurements_of_two_sensors(tmp_path, words):
    with StandIn() as central:
        code, events, err = run(
            tmp_path,
            "--to",
            central.address,
            "-n",
            4,
            "--rate",
            20,
            "--mounting",
            "mounting.toml",
            ports=("one", "two"),
        )
        hellos = {hello.sensor: hello for hello, _ in central.hellos.queue}
    assert code == 0, err
    assert kept(events) == held_crc32(central)
    times = {(name, session_id, number): message.timestamp_ns for (name, session_id), held in central.held.items()
             for number, (message, _) in held.items()}  # fmt: skip
    assert times == kept(events, "timestamp_ns")
    assert all(each["uncertainty_ns"] > 0 for each in events if each["event"] == "kept")
    (session_id,) = {session_id for _, session_id, _ in kept(events)}
    given = {"one": words, "two": words[::-1]}
    assert held_crc32(central) == {
        (name, session_id, number): zlib.crc32(each.tobytes())
        for name, several in given.items()
        for number, each in enumerate(several)
    }
    assert hellos["one"].translation_m == (0.2, 0.0, 0.4)
    assert hellos["two"].translation_m == TURNED[0]
    assert hellos["two"].rotation_xyzw == pytest.approx(TURNED[1])
    final = events[-1]
    assert (final["event"], final["output"], final["kept"], final["lost"]) == ("captured", central.address, 8, 0)
    assert final["central"] == {"stored": 8, "accepted": 0, "dropped": {}}
    assert [final[name] for name in ("refused", "overwritten", "damaged", "unacked", "reconnects")] == [0] * 5
    acked_through = [each for each in events if each["event"] == "acked_through" and each["sensor"] == "one"]
    assert acked_through[-1] == {
        "event": "acked_through",
        "sensor": "one",
        "session_id": session_id,
        "acked_through": 3,
        "status": "stored",
        "dropped": [],
    }
    assert not list(tmp_path.glob("*.h5*"))


@pytest.mark.usefixtures("sensors")
def test_capture_output_stores_sensor_mounting(tmp_path):
    code, events, err = run(tmp_path, "-o", "rec.h5", "-n", 1, "--mounting", "mounting.toml", ports=("two", "one"))
    assert code == 0, err
    assert {each["event"] for each in events} == {"stored", "captured"}
    assert sensor_names(tmp_path / "rec.h5") == ("two", "one")
    with open_recording(tmp_path / "rec.h5", sensor="two") as recording:
        assert tuple(recording.translation_m) == TURNED[0]
        assert tuple(recording.rotation_xyzw) == pytest.approx(TURNED[1])


@pytest.mark.usefixtures("sensors")
def test_capture_to_fails_when_nothing_is_acknowledged(tmp_path):
    code, events, err = run(tmp_path, "--to", "tcp://127.0.0.1:9", "-n", 3, "--patience", "0.1")
    assert code == 1
    message = "3 measurements not acknowledged by the central node at tcp://127.0.0.1:9"
    assert err.splitlines()[-1].startswith(f"ertis: error: {message}, which does not answer; start 'ertis record' or ")
    assert (events[-1]["event"], events[-1]["kept"], events[-1]["unacked"]) == ("captured", 3, 3)


@pytest.mark.usefixtures("sensors")
def test_capture_to_sends_spooled_measurements_next_time(tmp_path):
    code, first, err = run(tmp_path, "--to", "tcp://127.0.0.1:9", "--spool", "spool", "-n", 3, "--patience", "0.1")
    assert code == 0, err
    assert "3 measurements unacknowledged in spool; the next capture with --spool sends them" in err
    with StandIn() as central:
        code, second, err = run(tmp_path, "--to", central.address, "--spool", "spool", "-n", 2)
    assert code == 0, err
    assert kept(first) | kept(second) == held_crc32(central)
    assert len(held_crc32(central)) == 5
    assert not list((tmp_path / "spool").iterdir())


@pytest.mark.usefixtures("sensors")
@pytest.mark.parametrize(
    ("given", "lost", "remedy"),
    [
        (["--ring"], "overwritten", "add --spool DIR to keep measurements"),
        (["--spool", "spool", "--spool-size"], "refused", "raise --spool-size"),
    ],
)
def test_capture_to_limits_size_of_ring_and_spool(tmp_path, words, given, lost, remedy):
    size_mb = 2.5 * words[0].nbytes / 1e6
    code, events, err = run(tmp_path, "--to", "tcp://127.0.0.1:9", *given, size_mb, "-n", 3, "--patience", "0.1")
    assert code == 1
    assert (events[-1][lost], events[-1]["unacked"]) == (1, 2)
    assert remedy in err.splitlines()[-1]


@pytest.mark.usefixtures("sensors")
def test_capture_to_reports_drops_of_the_central_node(tmp_path):
    with StandIn(acks="accepted") as central:
        central.dropped = ((0, "superseded"), (2, "failed twice"))
        code, events, err = run(tmp_path, "--to", central.address, "-n", 3)
    assert code == 0, err
    reported = [each["dropped"] for each in events if each["event"] == "acked_through" and each["dropped"]]
    assert reported == [[[0, "superseded"], [2, "failed twice"]]]
    assert events[-1]["central"] == {"stored": 0, "accepted": 3, "dropped": {"superseded": 1, "failed twice": 1}}
    assert "1 measurement dropped by the central node (superseded)" in err


@pytest.mark.usefixtures("sensors")
@pytest.mark.parametrize("kill", [False, True])
def test_capture_to_loses_nothing_on_sigterm_or_sigkill(tmp_path, kill):
    """SIGTERM sends all measurements first. After SIGKILL the spool holds every reported measurement."""
    with StandIn() as central:
        events = []
        central.silent = kill
        with start(tmp_path, "--to", central.address, "--rate", 50, "--spool", "spool") as process:
            for line in process.stdout:
                events.append(json.loads(line) if line.endswith("\n") else {})
                if len(events) == 12:
                    process.send_signal(signal.SIGKILL if kill else signal.SIGTERM)
        assert process.returncode == (-signal.SIGKILL if kill else 0)
        central.silent = False
        if kill:
            code, more, err = run(tmp_path, "--to", central.address, "--spool", "spool", "-n", 1)
            assert code == 0, err
            events += more
    assert kept(events).items() <= held_crc32(central).items()
    assert len(held_crc32(central)) <= len(kept(events)) + kill
    assert not list((tmp_path / "spool").iterdir())


@pytest.mark.usefixtures("sensors")
def test_capture_to_stops_at_once_on_second_signal(tmp_path):
    with start(tmp_path, "--to", "tcp://127.0.0.1:9", "-n", 2, "--patience", 3600) as process:
        has_all = is_waiting = False
        for line in process.stdout:
            event = json.loads(line)
            has_all |= event.get("sequence") == 1
            is_waiting |= "does not answer" in event.get("text", "")  # the note about the central node
            if has_all and is_waiting:
                break
        process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.8)
        # A busy process may take two signals for one. A further signal while it ends would end it without its message.
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(SOON_S)
        _, err = process.communicate(timeout=SOON_S)
    assert process.returncode == 130
    assert "measurements that the central node has not acknowledged are lost" in err


@pytest.mark.usefixtures("sensors")
def test_capture_to_requires_allowed_keys(tmp_path):
    mine, theirs = KeyPair.new("node"), KeyPair.new("central")
    secret, _ = mine.save(tmp_path / "keys")
    allow = tmp_path / "allow.toml"
    AllowList().allow(Permission(name="node", public=mine.public, role="sensor", serials=("one",))).save(allow)
    with StandIn(keys=ServerKeys(theirs, allow)) as central:
        to = ("--to", central.address, "-n", 2, "--patience", "1")
        code, events, err = run(tmp_path, *to, "--key", secret, "--server-key", theirs.public)
        assert (code, events[-1]["kept"], central.taken) == (0, 2, 2), err
        code, _, err = run(tmp_path, *to)
        assert (code, central.taken) == (1, 2)
        assert "set one (--key)" in err
        other, _ = KeyPair.new("other").save(tmp_path / "keys")
        code, _, err = run(tmp_path, *to, "--key", other, "--server-key", theirs.public)
        assert (code, central.taken) == (1, 2)
        reported = "2 measurements not acknowledged by the central node at tcp://127.0.0.1:"
        assert err.splitlines()[-1].startswith(f"ertis: error: {reported}")
        assert err.splitlines()[-1].endswith(": the central node does not know this key; add it there with "
                                             "'ertis keys allow'")  # fmt: skip


FOR_APPLICATIONS = (
    "this address is for applications that receive products; for sensor nodes, poses and 'ertis sensors configure', "
    "use the first address that 'ertis serve' prints"
)


def _send_pose(poses):
    """Send a pose, and raise its refusal, which may arrive during either call."""
    poses.send(5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    poses.flush(SOON_S)


def test_image_address_refuses_long_settings_admins_and_poses_with_the_other_address():
    long = TINY.replace(call=Call(waveform=tuple(np.sin(np.arange(1500)).tolist())))
    text = long.to_toml().encode()
    assert len(text) > 20_000
    publisher = Publisher(ProcessingOptions(publish="tcp://127.0.0.1:0"), logger("test"))
    publisher.start()
    try:
        with Node(publisher.address) as node:
            node.send(messages.Hello(sensor="a", session_id=1, next_sequence=0, settings_crc32=zlib.crc32(text)), text)
            assert node.hear(messages.Refused).reason == FOR_APPLICATIONS
        with CentralClient(publisher.address) as client, pytest.raises(RefusedError) as refused:
            client.configure("a", TINY, SOON_S)
        assert str(refused.value) == FOR_APPLICATIONS
        with PosePublisher(publisher.address, ["a"]) as poses, pytest.raises(RefusedError) as refused:
            _send_pose(poses)
        assert str(refused.value) == FOR_APPLICATIONS
    finally:
        publisher.close()


@pytest.mark.usefixtures("sensors")
def test_capture_to_image_address_suggests_the_other_address(tmp_path):
    publisher = Publisher(ProcessingOptions(publish="tcp://127.0.0.1:0"), logger("test"))
    publisher.start()
    try:
        code, events, err = run(tmp_path, "--to", publisher.address, "-n", 1, "--patience", "1")
    finally:
        publisher.close()
    remedy = FOR_APPLICATIONS
    assert any(remedy in each.get("text", "") for each in events)
    assert code == 1
    assert err.splitlines()[-1].endswith(f"not acknowledged by the central node at {publisher.address}: {remedy}")


def test_sensor_nodes_are_warned_of_a_shared_sensor_name(tmp_path):
    notes = [queue.Queue(), queue.Queue()]
    with running(tmp_path) as central, contextlib.ExitStack() as stack:
        for session_id, reported in enumerate(notes):
            node = stack.enter_context(SensorNode(central.address, on_note=reported.put))
            node.add_sensor("left", TINY)
            node.append(entries(1, session_id=session_id))
        for reported in notes:
            assert reported.get(timeout=SOON_S) == (
                "another sensor node sends sensor left, too; use a different name for each (--name), or end one"
            )
        node.append(entries(1, session_id=7))
        assert node.flush(SOON_S)
    assert all(reported.empty() for reported in notes)


@pytest.mark.usefixtures("sensors")
@pytest.mark.parametrize(
    ("arguments", "message", "code"),
    [
        (["--to", "tcp://127.0.0.1:9", "-o", "a.h5"], "--to and --output cannot be combined; choose one", 2),
        (["--spool", "spool"], "--ring, --fixed-settings, --key and --server-key need a central node; add --to", 2),
        (["--ring", "1"], "--ring, --fixed-settings, --key and --server-key need a central node; add --to", 2),
        (["--to", "tcp://127.0.0.1:9", "--spool-size", "1"], "--spool-size is given without --spool; add --spool", 2),
        (["--to", "here"], "address 'here' cannot be used; use tcp://HOST:PORT", 2),
        (["--to", "tcp://10.1.1.1:5601"], "can be reached from other machines, but there are no keys", 1),
        (
            ["--to", "tcp://127.0.0.1:9", "--spool", "settings.toml"],
            "settings.toml: File exists; choose a writable spool folder",
            1,
        ),
        (
            ["--to", "tcp://127.0.0.1:9", "--spool", "/proc"],
            "/proc: No such file or directory; choose a writable spool folder",
            1,
        ),
        (["--to", "tcp://127.0.0.1:9", "--ring", "0.1"], "--ring is 0.1 MB, but one measurement has 0.131 MB; use", 1),
        (
            ["--to", "tcp://127.0.0.1:9", "--spool", "s", "--spool-size", "1e-9"],
            "--spool-size is 1e-09 MB, but one measurement has 0.131 MB",
            1,
        ),
        (["--mounting", "none.toml"], "none.toml", 1),
        (
            ["--mounting", "empty.toml"],
            "empty.toml sets no key; add sensors, reflectors or sources, see 'ertis reference settings scene'",
            1,
        ),
    ],
)
def test_capture_to_reports_errors_in_one_line(tmp_path, arguments, message, code):
    (tmp_path / "empty.toml").touch()
    came, events, err = run(tmp_path, *arguments)
    assert (came, events) == (code, [])
    assert message in err.splitlines()[-1]
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.glob("*.h5*"))


@pytest.mark.parametrize(
    ("arguments", "message", "code"),
    [
        (["--duration", "0"], "--duration is 0; use a number above 0", 2),
        (["--name", "a/b"], "sensor name 'a/b' cannot name a group in a file", 2),
        (["--to", "tcp://127.0.0.1:9", "--spool", "new/spool"], "ertis: error: serial port 'none' does not exist", 1),
    ],
)
def test_rejected_capture_creates_no_file(tmp_path, monkeypatch, arguments, message, code):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli, ["capture", "--port", "none", *arguments])
    assert done.exit_code == code
    assert message in done.stderr
    assert not list(tmp_path.iterdir())


def test_capture_session_counts_measurements_a_full_spool_rejects(tmp_path, sensors):
    del sensors
    with (
        SonarDriver.open(str(tmp_path / "one")) as sonar,
        SensorNode("tcp://127.0.0.1:9", spool=tmp_path / "spool", spool_bytes=2 * 4 * N_SAMPLES) as node,
    ):
        sonar.configure(Setup.of(SETTINGS))
        reported = []
        session = CaptureSession(
            {"one": sonar}, SETTINGS, trigger="command", rate_hz=50.0, n=5, on_stored=reported.extend
        )
        session.run(node)
        counts = session.counts["one"]
        assert (counts.stored, dict(counts.missing)) == (2, {"there was no room for it": 3})
        assert [entry.measurement.stamp.sequence for entry in reported] == [0, 1]
        assert node.counts["one"].refused == 3


@pytest.mark.usefixtures("sensors")
def test_capture_to_is_recorded_by_the_record_command(tmp_path):
    command = [*ERTIS, "record", "--listen", "tcp://127.0.0.1:*", "-o", "recordings", "--json"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as central:
        address = json.loads(central.stdout.readline())["address"]
        code, events, err = run(tmp_path, "--to", address, "-n", 4, "--rate", 20, ports=("one", "two"))
        central.send_signal(signal.SIGTERM)
        central.communicate(timeout=SOON_S)
    assert (code, events[-1]["central"]["stored"]) == (0, 8), err
    (path,) = (tmp_path / "recordings").glob("*.h5")
    found = {}
    for name in ("one", "two"):
        with open_recording(path, sensor=name) as recording:
            found |= {
                (name, each.stamp.session_id, each.stamp.sequence): zlib.crc32(each.data.tobytes())
                for each in recording
            }
    assert found == kept(events)

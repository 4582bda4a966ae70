"""Status of a real central node, as tables and as JSON."""

import contextlib
import io
import json
import queue
import tempfile
import threading
from pathlib import Path

import msgspec
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from ertis_cli.status import _drawn

from ertis_numba.base.errors import ArgumentError, NetworkError, RefusedError
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.central_client import CentralClient
from ertis_numba.network.central_node import Archive, CentralNode
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.status import (
    ArchiveStatus,
    Percentiles,
    ProcessingStatus,
    SensorStatus,
    Status,
    SubscriberStatus,
    WorkerStatus,
)

CENTRAL, ROBOT, VIEWER = (KeyPair.new(name) for name in ("central", "robot", "viewer"))
PATIENCE_S = 60.0
BUSY = Status(
    version="1",
    pid=7,
    host="here",
    address="tcp://127.0.0.1:5601",
    state="fault",
    fault="the disk is full",
    uptime_s=3_723.4,
    peers=1,
    refused={"unknown key": 3},
    sensors={
        "front": SensorStatus(
            connected=True,
            rate_hz=19.97,
            received=41,
            stored=40,
            published=37,
            passive=8,
            queue=2,
            missing={"the spool was full": 5},
            dropped={"superseded": 4},
            image_latency=Percentiles(p50_ms=12.25, p99_ms=40.0),
        ),
        "left": SensorStatus(),
    },
    archive=ArchiveStatus(
        folder="/data", recording="a.h5", free_bytes=12_300_000, room_bytes=3_000_000_000, sealing_failed=1
    ),
    processing=ProcessingStatus(
        address="tcp://127.0.0.1:5602",
        choice="one each: 2.0 ms against 3.0 ms",
        workers=[WorkerStatus(pid=8, state="busy")],
        subscribers=[SubscriberStatus(name="viewer", products=("energyscape",), sent=30, dropped=7)],
        groups={"complete": 9, "clock": 1},
    ),
)


@contextlib.contextmanager
def central_node(keys=None):
    """Address of a real central node in a thread."""
    opened = queue.Queue()

    def run():
        try:
            with tempfile.TemporaryDirectory() as folder, _open(folder, keys) as node:
                opened.put(node)
                node.run()
        except BaseException as error:
            opened.put(error)
            raise

    thread = threading.Thread(target=run)
    thread.start()
    node = opened.get(timeout=PATIENCE_S)
    assert isinstance(node, CentralNode), node
    try:
        yield node.address
    finally:
        node.stop()
        thread.join(PATIENCE_S)


def _open(folder, keys):
    return CentralNode("tcp://127.0.0.1:0", keys=keys, archive=Archive(Path(folder)))


@pytest.fixture
def keys(tmp_path):
    listed = AllowList(
        keys=(
            Permission(name="robot", public=ROBOT.public, role="sensor", serials=("front",)),
            Permission(name="viewer", public=VIEWER.public, role="application"),
        )
    )
    listed.save(tmp_path / "allow.toml")
    return ServerKeys(CENTRAL, tmp_path / "allow.toml")


def test_status_client_receives_repeated_statuses():
    with central_node() as address, CentralClient(address) as node:
        first, second = node.status(PATIENCE_S), node.status(PATIENCE_S)
    assert first.address == second.address == address
    assert (first.state, first.keys, first.sensors) == ("storage", False, {})
    assert second.uptime_s >= first.uptime_s > 0


def test_application_may_request_the_status_and_sensor_node_may_not(keys):
    with central_node(keys) as address:
        with CentralClient(address, keys=ClientKeys(VIEWER, CENTRAL.public)) as node:
            status = node.status(PATIENCE_S)
        with (
            CentralClient(address, keys=ClientKeys(ROBOT, CENTRAL.public)) as node,
            pytest.raises(RefusedError, match="may not request the status"),
        ):
            node.status(PATIENCE_S)
    assert status.keys is True
    assert not any(status.refused.values())


def test_refused_status_client_gets_the_reason_at_once(keys):
    with central_node(keys) as address:
        with (
            CentralClient(address, keys=ClientKeys(KeyPair.new("x"), CENTRAL.public)) as node,
            pytest.raises(RefusedError, match="the central node does not know this key"),
        ):
            node.status(PATIENCE_S)
        with (
            CentralClient(address, keys=ClientKeys(VIEWER, ROBOT.public)) as node,
            pytest.raises(RefusedError, match="its key is not the"),
        ):
            node.status(3.0)
        with CentralClient(address) as node, pytest.raises(RefusedError, match=r"set one \(keys\)"):
            node.status(PATIENCE_S)


def test_interrupted_status_client_does_not_wait_for_its_socket(monkeypatch):
    """A signal may arrive between the opening of a socket and its assignment, as it once did in ``ertis demo``."""

    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("ertis_numba.network.sockets.Monitor", interrupted)
    with pytest.raises(KeyboardInterrupt), CentralClient("tcp://127.0.0.1:1") as node:
        node.status(PATIENCE_S)


def test_missing_central_node_is_reported_with_the_remedy():
    with CentralClient("tcp://127.0.0.1:1") as node, pytest.raises(NetworkError, match=r"within 0\.1 s; start"):
        node.status(0.1)
    with pytest.raises(NetworkError, match="use it in a with statement"):
        node.status(0.1)


def test_status_of_another_machine_needs_keys():
    with pytest.raises(ArgumentError, match="there are no keys"):
        CentralClient("tcp://192.0.2.1:5601")


def test_command_prints_one_table_without_a_terminal():
    with central_node() as address:
        result = CliRunner().invoke(cli, ["sensors", "status", address], catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout.startswith(f"{address} on ")
    assert "storage" in result.stdout


def test_command_prints_one_json_object(keys, tmp_path):
    secret, _ = VIEWER.save(tmp_path / "keys")
    with central_node(keys) as address:
        result = CliRunner().invoke(
            cli,
            ["sensors", "status", address, "--json", "--key", str(secret), "--server-key", CENTRAL.public],
            catch_exceptions=False,
        )
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["event"] == "status"
    reported = msgspec.convert(report, Status)
    assert (reported.address, reported.state, reported.keys) == (address, "storage", True)


def test_command_without_an_answer_fails_with_one_line():
    result = CliRunner().invoke(cli, ["sensors", "status", "tcp://127.0.0.1:1", "--patience", "0.1"])
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1


class _Asked:
    """Node that answers, is away, answers again, and then stops."""

    def __init__(self):
        self._answers = [
            BUSY,
            NetworkError("it has not answered"),
            RefusedError("it hung up"),
            BUSY,
            KeyboardInterrupt(),
        ]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def status(self, _):
        answer = self._answers.pop(0)
        if isinstance(answer, BaseException):
            raise answer
        return answer


@pytest.mark.parametrize("as_json", [False, True])
def test_command_waits_for_a_central_node_that_disappears(monkeypatch, as_json):
    monkeypatch.setattr("ertis_numba.network.central_client.CentralClient", lambda *_, **__: _Asked())
    monkeypatch.setattr("ertis_cli.status._REFRESH_S", 0.0)
    result = CliRunner().invoke(cli, ["sensors", "status", BUSY.address, "--watch", *(["--json"] if as_json else [])])
    if as_json:
        events = [json.loads(line) for line in result.stdout.splitlines()]
        assert [each["event"] for each in events] == ["status", "away", "away", "status"]
        assert events[1] == {"event": "away", "address": BUSY.address, "text": "it has not answered"}
    else:
        reported = [line for line in result.stdout.splitlines() if line.startswith("away: ")]
        assert reported == [f"away: {why}; last status:" for why in ("it has not answered", "it hung up")]


def _printed(status):
    from rich.console import Console  # noqa: PLC0415

    stream = io.StringIO()
    Console(file=stream, width=200).print(_drawn(status))
    return stream.getvalue()


def test_table_shows_everything_that_needs_attention():
    text = _printed(BUSY)
    for part in (
        "up 1:02:03",
        "fault: the disk is full",
        "refused: 3 unknown key",
        "5 the spool was full",
        "4 superseded",
        "12.2/40.0",
        "left (away)",
        "a.h5 is not writable, 0 MB in its journal, 0 sealed, 0 to seal, 1 not sealed",
        "1 not sealed",
        "disk: 12 MB free, room for 3.0 GB",
        "workers: 1, 1 busy",
        "cores: one each: 2.0 ms against 3.0 ms",
        "groups: 9 complete, 1 clock",
        "viewer: energyscape of all sensors, 30 sent, 7 dropped",
    ):
        assert part in text, part
    row = next(line.split() for line in text.splitlines() if line.lstrip().startswith("front"))
    assert row[1:6] == ["20.0", "41", "40", "37", "2"]


@pytest.mark.parametrize(
    ("recording", "fault", "reported"),
    [
        ("", "", "no recording yet"),
        ("", "the disk is full", "not writable"),
        ("a.h5", "", "a.h5 is being written, 0 MB in its journal"),
    ],
)
def test_archive_state_is_reported(recording, fault, reported):
    archive = msgspec.structs.replace(BUSY.archive, recording=recording)
    text = _printed(msgspec.structs.replace(BUSY, archive=archive, fault=fault))
    assert f"archive /data: {reported}, 0 sealed, 0 to seal" in text

"""The central node stores measurements once and in order, and answers every message."""

import random

import msgspec
import pytest

from ertis_numba.base.errors import ArgumentError, JournalInUseError
from ertis_numba.network import messages
from ertis_numba.network.central_node import Archive, CentralNode
from ertis_numba.network.central_node._reporting import Condition
from ertis_numba.network.messages import Ack, Gap, Ping, Pong, Refused, Report, Welcome
from ertis_numba.network.status import Status
from ertis_numba.settings import Air, Recording
from tests.central import WAIT_MS, Node, data_of, running, stored, wanted
from tests.files import line
from tests.journals import EPOCH, TINY, entries


def test_acknowledged_measurements_are_in_the_recording(tmp_path):
    given = entries(5)
    with running(archive=Archive(tmp_path / "a")) as central, Node(central.address) as node:
        welcome = node.hello(first=10)
        assert (welcome.state, welcome.acks, welcome.acked_through) == ("storage", "stored", -1)
        node.measure(*given)
        assert node.hear_settled(14).status == "stored"
    assert stored(tmp_path / "a") == (wanted(given), [("left", EPOCH, 0, 9, "never reached the central node")])
    assert [event["event"] for event in central.events] == ["listening", "joined", "sealed"]


def test_duplicate_measurement_is_acknowledged_but_stored_once(tmp_path):
    given = entries(3)
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(*given)
        node.hear_settled(12)
        node.measure(*given[1:])
        node.send(Ping())
        assert node.hear(Pong).state == "storage"
        assert node.hear(Ack).acked_through == 12
    assert stored(tmp_path)[0] == wanted(given)
    assert (central.latest.sensors["left"].received, central.latest.sensors["left"].repeated) == (3, 2)


def test_measurements_after_missing_numbers_are_discarded(tmp_path):
    given = entries(4)
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(given[0])
        node.hear_settled(10)
        node.measure(given[2], given[3])
        assert [node.hear(Ack).acked_through for _ in range(1)] == [10]
        node.measure(*given[1:])
        node.hear_settled(13)
    assert stored(tmp_path)[0] == wanted(given)


def test_gaps_are_acknowledged_in_order(tmp_path):
    given = entries(6)
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(given[0])
        node.send(Gap(sensor="left", session_id=EPOCH, first=12, last=13, reason="beyond a hole"))
        node.send(Gap(sensor="left", session_id=EPOCH, first=10, last=12, reason="the ring was full"))
        node.send(Gap(sensor="left", session_id=EPOCH, first=11, last=12, reason="the ring was full"))
        node.measure(*given[3:])
        node.hear_settled(15)
    found, missing = stored(tmp_path)
    assert found == wanted([given[0], *given[3:]])
    assert [each[2:] for each in missing] == [(0, 9, "never reached the central node"), (11, 12, "the ring was full")]
    assert central.latest.sensors["left"].missing == {"never reached the central node": 10, "the ring was full": 2}


def test_reconnected_sensor_node_continues_its_session(tmp_path):
    given = entries(6)
    with running(tmp_path) as central:
        with Node(central.address) as node:
            node.hello()
            node.measure(*given[:3])
            node.hear_settled(12)
        with Node(central.address) as node:
            assert node.hello(first=12).acked_through == 12
            node.measure(*given[2:])
            node.hear_settled(15)
    assert stored(tmp_path)[0] == wanted(given)


def test_restarted_central_node_continues_stored_sessions(tmp_path):
    given = entries(6)
    for first, last in ((0, 3), (2, 6)):
        with running(tmp_path) as central, Node(central.address) as node:
            assert node.hello(first=10 + first).acked_through == (-1 if first == 0 else 12)
            node.measure(*given[first:last])
            node.hear_settled(9 + last)
    found, missing = stored(tmp_path)
    assert found == wanted(given)
    assert [each[2:4] for each in missing] == [(0, 9)]


def test_conflicting_measurement_of_one_number_is_stored_aside(tmp_path):
    given, others = entries(3), entries(3, seed=2)
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(*given)
        node.hear_settled(12)
        for other in (others[1], others[0], others[1]):
            node.measure(other)
            node.hear(Ack)
    twins = sorted(tmp_path.glob("*_conflicts.h5.journal"))
    found = stored(tmp_path)[0]
    assert sorted(found) == sorted(wanted([*given, *others[:2]]))
    assert len(twins) == 2  # numbers within one recording must increase
    sensor = central.latest.sensors["left"]
    assert (sensor.stored, sensor.conflicts, sensor.repeated) == (3, 2, 3)


def test_changed_settings_start_a_new_recording(tmp_path):
    given, others = entries(2), entries(2, first=12, settings=TINY.replace(call=TINY.call.replace(duration_s=2e-3)))
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(*given)
        node.hear_settled(11)
        node.hello(first=12, settings=others[0].measurement.settings)
        node.measure(*others)
        node.hear_settled(13)
        node.hello(first=14, settings=TINY, translation_m=(1.0, 0.0, 0.0))
        node.measure(*entries(1, first=14))
        node.hear_settled(14)
    assert len(list(tmp_path.glob("*.h5.journal"))) == 3
    assert len(stored(tmp_path)[0]) == 5


def test_changed_air_stays_in_one_recording(tmp_path):
    settings = TINY.replace(air=Air(temperature_c=5.0))
    given = [entries(1)[0], *entries(1, first=11, settings=settings)]
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(*given)
        node.hear_settled(11)
    assert stored(tmp_path)[0] == wanted(given)


INVALID_MEASUREMENTS = {
    "before its hello": ({"session_id": 6}, "hello", "send hello first"),
    "too short": ({"words": b"1234"}, "message", "a measurement has 4 bytes, but its settings give 4096"),
    "of do not match": ({"crc32": 1}, "message", "does not match"),
    "in no air": ({"temperature_c": float("nan")}, "message", "air.temperature_c"),
}


@pytest.mark.parametrize("what", INVALID_MEASUREMENTS)
def test_invalid_measurement_is_refused_with_its_reason(what, tmp_path):
    changes, code, reason = INVALID_MEASUREMENTS[what]
    given = entries(2)
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(given[0], **changes)
        refused = node.hear(Refused)
        node.measure(*given)
        node.hear_settled(11)
    assert (refused.code, refused.sensor) == (code, "left")
    assert reason in refused.reason
    assert sum(central.latest.refused.values()) == 1
    assert stored(tmp_path)[0] == wanted(given)


INVALID_HELLOS = {
    "settings of do not match": ({"settings_crc32": 1}, "do not match"),
    "no settings": ({"settings": b"["}, "settings of sensor left"),
    "no text": ({"settings": b"\xff"}, "not text"),
    "a file for a layout": ({"settings": b'[array]\nlayout = "/etc/passwd"'}, "send its positions"),
    "a file for directions": ({"settings": b'[processing]\ndirections = "x.csv"'}, "name a grid"),
    "a name with a line feed": ({"settings": b'[array]\nlayout = "a\\n"'}, "cannot be printed"),
    "a firmware with zeros": ({"firmware": "\0"}, "printable"),
    "a quaternion of length 0": ({"rotation_xyzw": (0.0, 0.0, 0.0, 0.0)}, "rotation_xyzw"),
    "more than is taken": ({"settings": line(8, 8).replace(recording=Recording(n_samples=2**23))}, "but the limit is"),
    "too much": ({"settings": b"#" * 300_000}, "exceed 262144 bytes"),
}


@pytest.mark.parametrize("what", INVALID_HELLOS)
def test_hello_with_invalid_settings_is_refused(what, tmp_path):
    changes, reason = INVALID_HELLOS[what]
    with running(tmp_path) as central, Node(central.address) as node:
        refused = node.hello(**changes)
        assert isinstance(refused, Refused)
        assert refused.code == "settings"
        assert reason in refused.reason
        assert isinstance(node.hello(), Welcome)


def test_malformed_messages_are_counted_and_other_peers_served(tmp_path):
    generator = random.Random(1)
    given = entries(3)
    known = [messages.encode(Ping()), *(messages.encode(data_of(entry)[0]) for entry in given)]
    with running(tmp_path) as central, Node(central.address) as node, Node(central.address) as stranger:
        node.hello()
        for _ in range(300):
            header = bytearray(generator.choice(known))
            header[generator.randrange(len(header))] ^= 1 << generator.randrange(8)
            stranger.socket.send_multipart([bytes(header), *[b"1234"] * generator.randrange(8)])
        stranger.socket.send_multipart([b"eRTN\x01more"])
        stranger.socket.send_multipart([b""])
        node.measure(*given)
        node.hear_settled(12)
        reported, n_repeated = "", 0
        while "has protocol version 1, " not in reported:  # flipping one bit never turns version 2 into 1
            if not stranger.socket.poll(500):  # a peer that does not read its socket loses answers
                stranger.socket.send_multipart([b"eRTN\x01more"])
                n_repeated += 1
            reported = stranger.hear(Refused).reason
    assert stored(tmp_path)[0] == wanted(given)
    refused = central.latest.refused
    assert refused["version"] >= 1
    assert "internal" not in refused
    assert 200 < sum(refused.values()) - n_repeated < 310


def test_gap_with_line_feed_in_reason_is_refused(tmp_path):
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello(first=0)
        node.send(Gap(sensor="left", session_id=EPOCH, first=0, last=3, reason="two\nlines"))
        assert node.hear(Refused).code == "message"


def test_status_request_is_answered(tmp_path):
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(*entries(2))
        node.hear_settled(11)
        node.send(messages.AskStatus())
        assert node.socket.poll(WAIT_MS)
        header, payload = node.socket.recv_multipart()
        assert messages.decode(header) == Report()
        status = msgspec.msgpack.decode(payload, type=Status)
    assert (status.state, status.peers, status.sensors["left"].stored) == ("storage", 1, 2)
    assert status.archive is not None
    assert status.archive.free_bytes > 0
    assert status.archive.ack.max_ms > 0


def test_silent_sensor_node_must_send_hello_again(tmp_path, monkeypatch):
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        node.measure(*entries(1))
        node.hear_settled(10)
        monkeypatch.setattr("ertis_numba.network.central_node._intake._SILENT_S", 0.01)
        while not any(event["event"] == "left" for event in central.events):
            node.socket.poll(10)
        monkeypatch.undo()
        node.measure(*entries(1, first=11))
        assert node.hear(Refused).code == "hello"
        assert node.hello(first=11).acked_through == 10


def test_central_node_requires_archive_or_processing():
    with pytest.raises(ArgumentError, match="neither archive nor processing"):
        CentralNode("tcp://127.0.0.1:0")


def test_message_without_handler_is_refused_at_the_start(tmp_path, monkeypatch):
    monkeypatch.setattr("ertis_numba.network.central_node._admission.ACCEPTED", (Ping, messages.Pong))
    with pytest.raises(TypeError, match="CentralNode has no handler of pong; define _on_pong"):
        CentralNode("tcp://127.0.0.1:0", archive=Archive(tmp_path))


def test_central_node_run_requires_with_statement(tmp_path):
    with pytest.raises(ArgumentError, match="not open"):
        CentralNode("tcp://127.0.0.1:0", archive=Archive(tmp_path)).run()


def test_archive_folder_is_locked_by_one_central_node(tmp_path):
    with running(tmp_path), pytest.raises(JournalInUseError, match="in use by another central node"), running(tmp_path):
        pass


def test_internal_error_of_one_message_does_not_stop_the_node(tmp_path, monkeypatch):
    given = entries(2)
    monkeypatch.setattr("ertis_numba.network.central_node._reporting._LOG_INTERVAL_S", 1000.0)
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        with monkeypatch.context() as patch:
            patch.setattr("ertis_numba.network.central_node._intake.Intake.ping", lambda *_: 1 / 0)
            node.send(Ping())
            assert (
                "the central node has an internal error (ZeroDivisionError: division by zero)"
                in node.hear(Refused).reason
            )
            node.send(Ping())
            node.hear(Refused)
            node.measure(*given)
            node.hear_settled(11)
    assert central.latest.refused["internal"] == 2
    assert [event["event"] for event in central.events].count("internal") == 1


@pytest.mark.parametrize("step", ["read", "require_role", "ServerSocket.who"])
def test_internal_error_while_reading_a_message_is_answered(step, tmp_path, monkeypatch):
    given = entries(2)
    monkeypatch.setattr("ertis_numba.network.central_node._reporting._LOG_INTERVAL_S", 1000.0)
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        with monkeypatch.context() as patch:
            patch.setattr(f"ertis_numba.network.central_node._node.{step}", lambda *_: 1 / 0)
            node.measure(*given)
            refused = [node.hear(Refused) for _ in given]
        node.measure(*given)  # the sender keeps unacknowledged measurements
        node.hear_settled(11)
    assert all(
        "the central node has an internal error (ZeroDivisionError: division by zero)" in each.reason
        for each in refused
    )
    assert {each.sensor for each in refused} == ({"left"} if step == "require_role" else {""})
    assert central.latest.refused["internal"] == 2
    assert [event["event"] for event in central.events].count("internal") == 1


def test_fault_text_with_non_utf8_path_is_sent(tmp_path, monkeypatch):
    with running(tmp_path) as central, Node(central.address) as node:
        monkeypatch.setattr(Archive, "stuck", "cannot write /disk/\udcff")
        node.send(Ping())
        assert node.hear((Pong, Refused)).text == "cannot write /disk/?"
        node.send(messages.AskStatus())
        node.hear(Report)


def test_status_is_computed_once_for_simultaneous_requests(tmp_path, monkeypatch):
    made, status = [], Condition.status
    monkeypatch.setattr("ertis_numba.network.central_node._reporting._REPORT_S", 1000.0)
    with running(tmp_path) as central, Node(central.address) as node:
        monkeypatch.setattr(Condition, "status", lambda condition: made.append(1) or status(condition))
        for _ in range(20):
            node.send(messages.AskStatus())
            node.hear(Report)
    assert len(made) < 15


def test_stuck_disk_is_reported_as_fault(tmp_path, monkeypatch):
    why = ["the disk does not answer"]
    with running(tmp_path) as central, Node(central.address) as node:
        monkeypatch.setattr(Archive, "stuck", property(lambda _: why[0]))
        while not any(event["event"] == "fault" for event in central.events):
            node.socket.poll(10)
        node.send(Ping())
        assert node.hear(Pong) == Pong(state="fault", text="the disk does not answer")
        assert central.status().fault == "the disk does not answer"
        why[0] = ""
        while not any(event["event"] == "resumed" for event in central.events):
            node.socket.poll(10)
    assert [event["text"] for event in central.events if event["event"] == "fault"] == ["the disk does not answer"]


def test_sensor_nodes_are_notified_of_shutdown(tmp_path):
    with running(tmp_path) as central, Node(central.address) as node:
        node.hello()
        central.stop()
        assert node.hear(Pong).state == "closing"

"""Link of a sensor node to a central node that refuses, fails, dies, falls silent or loses messages."""

import queue
import threading

import pytest

from ertis_numba.network import messages
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.sensor_node import SensorNode, _link as link, _outgoing_sessions as runs
from tests.journals import EPOCH, TINY, entries
from tests.sending import IMPATIENT, SOON_S, Node, has_all, impatient, silent, until
from tests.stand_in import StandIn

__all__ = ["impatient"]  # A fixture, imported for use here.


def test_link_sends_hello_at_once_to_a_forgetful_central_node(monkeypatch):
    """The link does not wait until measurements in flight are acknowledged."""
    monkeypatch.setattr(runs, "_PATIENCE_S", 1000.0)
    monkeypatch.setattr(link, "_GREET_AGAIN_S", SOON_S)  # A busy machine answers late.
    given = entries(20)
    with StandIn() as central, Node(central.address) as node:
        node.append(given[:10])
        assert node.flush(SOON_S)
        central.forget_peers.set()
        node.append(given[10:])
        assert node.flush(SOON_S)
        assert central.hellos.qsize() == 2
    assert has_all(central, given)


@IMPATIENT
@pytest.mark.parametrize("seed", range(3))
def test_link_accepts_lost_repeated_and_reordered_acks(seed):
    given = entries(120)
    with StandIn(seed=seed) as central, Node(central.address) as node:
        central.lost, central.repeated, central.late, central.ignored = 0.3, 0.3, 0.3, 0.05
        for entry in given:
            node.append([entry])
        assert node.flush(SOON_S)
        counts = node.counts["left"]
    assert has_all(central, given)
    assert central.wrong == []
    assert counts.stored == 120


@IMPATIENT
def test_ack_of_unsent_numbers_is_ignored():
    given = entries(3)
    with StandIn() as central, Node(central.address) as node:
        central.refusal = lambda message: (
            messages.Ack(sensor="left", session_id=EPOCH, acked_through=10**9, status="stored")
            if isinstance(message, messages.Data) and not lied.is_set()
            else None
        )
        lied = threading.Event()
        node.append(given)
        until(lambda: not central.hellos.empty())
        assert not node.flush(0.2)
        lied.set()
        assert node.flush(SOON_S)
    assert has_all(central, given)


@IMPATIENT
@pytest.mark.parametrize("forget", [False, True])
def test_link_survives_restarts_of_the_central_node(forget):
    """Restart it five times; with ``forget``, it acknowledges measurements that it holds in memory only and loses."""
    given = entries(100)
    with StandIn(acks="accepted" if forget else "stored") as central, Node(central.address) as node:
        for number, entry in enumerate(given):
            node.append([entry])
            if number % 20 == 10:
                before = central.connections
                until(lambda number=number: central.taken > number // 2)
                central.stop(forget=forget)
                central.start()
                until(lambda before=before: central.connections > before)
        assert node.flush(SOON_S)
        counts = node.counts["left"]
    assert has_all(central, given)
    assert counts.stored + counts.taken == 100
    assert (counts.taken == 100) == forget
    assert central.wrong == []


@IMPATIENT
def test_refused_sensor_retries_while_other_sensors_continue():
    left, right = entries(5), entries(5, sensor="right")
    with StandIn() as central, Node(central.address, ("left", "right")) as node:
        asked = queue.Queue()

        def refuse(message):
            if isinstance(message, messages.Hello) and message.sensor == "left" and asked.qsize() < 3:
                asked.put(message)
                return messages.Refused(code="serial", reason="left is not yours", sensor="left", session_id=EPOCH)
            return None

        central.refusal = refuse
        node.append([*left, *right])
        until(lambda: has_all(central, right, ("right", EPOCH)))
        assert node.flush(SOON_S)
        notes = list(node.notes.queue)
    assert has_all(central, left)
    assert notes == ["the central node refuses measurements of sensor left: left is not yours"]


@IMPATIENT
def test_refusal_with_varying_numbers_is_reported_once():
    asked = queue.Queue()

    def refuse(message):
        if isinstance(message, messages.Hello) and asked.qsize() < 5:
            asked.put(message)
            reason = f"no room for {asked.qsize()} more"
            return messages.Refused(code="size", reason=reason, sensor=message.sensor, session_id=message.session_id)
        return None

    with StandIn() as central, Node(central.address, ("left", "right")) as node:
        central.refusal = refuse
        node.append([*entries(1), *entries(1, sensor="right")])
        assert node.flush(SOON_S)
        notes = sorted(note.partition(":")[0] for note in node.notes.queue)
    about = "the central node refuses measurements of sensor"
    assert notes == [f"{about} left", f"{about} right"]


@IMPATIENT
def test_other_protocol_version_is_reported():
    with StandIn() as central, Node(central.address) as node:
        central.version = 9
        node.append(entries(1))
        assert "a header has protocol version 9, but this node uses 2" in node.notes.get(timeout=SOON_S)
        central.version = messages.VERSION
        assert node.flush(SOON_S)


@IMPATIENT
def test_fault_of_the_central_node_delays_measurements():
    given = entries(30)
    with StandIn() as central, Node(central.address) as node:
        node.append(given[:1])
        assert node.flush(SOON_S)
        central.state, central.text = "fault", "no room"
        until(lambda: node.central == "fault")
        node.append(given[1:])
        assert not node.flush(0.2)
        assert node.notes.get(timeout=SOON_S) == "the central node cannot store: no room; measurements are kept"
        assert central.seen == {10, 11}  # One measurement suffices to test whether it stores again.
        central.state = "storage"
        assert node.flush(SOON_S)
        assert node.notes.get(timeout=SOON_S) == "the central node can store again"
        assert node.central == "storage"
    assert has_all(central, given)


@IMPATIENT
def test_link_reconnects_to_a_silent_central_node():
    given = entries(10)
    with StandIn() as central, Node(central.address) as node:
        node.append(given[:5])
        assert node.flush(SOON_S)
        with silent(central, node):
            assert "does not answer; measurements are kept meanwhile" in node.notes.get(timeout=SOON_S)
            node.append(given[5:])
        assert "connected to the central node" in node.notes.get(timeout=SOON_S)
        assert node.flush(SOON_S)
        assert node.reconnects == 1
    assert has_all(central, given)
    assert central.connections > 1


@IMPATIENT
@pytest.mark.parametrize(
    ("listed", "server", "message"),
    [
        (False, True, "does not know this key"),
        (True, False, "pass its key (server)"),
        (True, True, None),
    ],
)
def test_link_authenticates_with_keys(tmp_path, listed, server, message):
    mine, theirs, other = (KeyPair.new(name) for name in ("node", "central", "other"))
    allow = tmp_path / "allow.toml"
    who = mine if listed else other
    permission = Permission(name="node", public=who.public, role="sensor", serials=("left",))
    AllowList().allow(permission).save(allow)
    keys = ClientKeys(mine, (theirs if server else other).public)
    with StandIn(keys=ServerKeys(theirs, allow)) as central, Node(central.address, keys=keys) as node:
        given = entries()
        node.append(given)
        if message is None:
            assert node.flush(SOON_S)
            assert has_all(central, given)
        else:
            until(lambda: any(message in note for note in list(node.notes.queue)))
            assert central.taken == 0


@IMPATIENT
def test_link_survives_a_failing_event_listener(caplog):
    given = entries(6)

    def fail(_):
        raise OSError("the pipe is closed")

    with StandIn() as central, SensorNode(central.address, on_note=fail, on_acked=fail) as node:
        node.add_sensor("left", TINY)
        node.append(given[:3])
        assert node.flush(SOON_S)
        with silent(central, node):  # The node reports the missing central node.
            node.append(given[3:])
        assert node.flush(SOON_S)
        assert node.counts["left"].stored == 6
    assert has_all(central, given)
    reported = [record.ertis_fields["text"] for record in caplog.records if record.name == "ertis.network.sensor_node"]
    assert sorted(reported) == [f"{name} failed: OSError: the pipe is closed" for name in ("on_acked", "on_note")]


def test_failed_link_is_replaced(monkeypatch):
    monkeypatch.setattr(link, "_FAILED_S", 0.0)
    given, failures = entries(3), [MemoryError("no room")]
    frames_of = link.frames_of

    def fail_once(*arguments):
        if failures:
            raise failures.pop()
        return frames_of(*arguments)

    monkeypatch.setattr(link, "frames_of", fail_once)
    with StandIn() as central, Node(central.address) as node:
        node.append(given)
        assert node.flush(SOON_S)
        assert "has failed (MemoryError: no room); reconnecting" in node.notes.get(timeout=SOON_S)
    assert has_all(central, given)

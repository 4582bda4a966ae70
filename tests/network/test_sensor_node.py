"""Sensor node over real sockets: each measurement arrives once and unchanged, or becomes a gap with a reason."""

import random
import zlib
from dataclasses import replace

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.journal import JournalEntry, JournalSensor
from ertis_numba.network import messages
from ertis_numba.network.sensor_node import SensorNode, _link as link, _outgoing_sessions as runs
from ertis_numba.settings import Air, Recording
from tests.journals import EPOCH, TINY, entries, python
from tests.sending import IMPATIENT, KEY, SOON_S, Node, has_all, impatient, until
from tests.stand_in import StandIn

__all__ = ["impatient"]  # A fixture, imported for use here.


def test_measurements_arrive_with_stamp_air_and_settings():
    given = entries(50, first=0)
    warm = TINY.replace(air=Air(temperature_c=31.5, humidity_percent=12.0, pressure_pa=99_000.0))
    given[3] = replace(given[3], measurement=replace(given[3].measurement, settings=warm))
    with StandIn() as central, Node(central.address) as node:
        assert node.append(given[:20]) == given[:20]
        for entry in given[20:]:
            node.append([entry])
        assert node.flush(SOON_S)
        hello, settings = central.hellos.get(timeout=SOON_S)
        counts = node.counts["left"]
    assert has_all(central, given)
    assert (hello.next_sequence, hello.firmware, hello.translation_m) == (0, "1.2.3", (1.0, 2.0, 3.0))
    assert settings.decode() == TINY.to_toml()
    assert (counts.accepted, counts.stored, counts.unacked, counts.unacked_bytes) == (50, 50, 0, 0)
    assert (central.wrong, central.resent, central.connections, node.reconnects) == ([], 0, 1, 0)
    acks = [node.acks.get_nowait() for _ in range(node.acks.qsize())]
    assert [ack.acked_through for ack in acks] == sorted({ack.acked_through for ack in acks})
    assert (acks[-1].sensor, acks[-1].session_id, acks[-1].acked_through, acks[-1].status) == (
        "left",
        EPOCH,
        49,
        "stored",
    )


@pytest.mark.parametrize("with_spool", [False, True])
def test_append_fills_in_the_crc32_of_all_measurements(tmp_path, with_spool):
    given = [replace(entry, crc32=None) for entry in entries(20, first=0)]
    with StandIn() as central, Node(central.address, spool=tmp_path if with_spool else None) as node:
        kept = node.append(given)
        assert [entry.crc32 for entry in kept] == [zlib.crc32(entry.measurement.data) for entry in given]
        assert node.flush(SOON_S)
    assert central.wrong == []
    assert [message.crc32 for message, _ in central.held[KEY].values()] == [entry.crc32 for entry in kept]


def test_gaps_arrive_in_order():
    given = entries(6, first=3)
    with StandIn() as central, Node(central.address) as node:
        node.append(given[:2])
        node.note_gap("left", 5, 5, "footer", session_id=EPOCH)
        node.note_gap("left", 4, 6, "unplugged", session_id=EPOCH)  # Only 6 is new.
        node.append(given[5:])
        node.note_gap("left", 0, 8, "late", session_id=EPOCH)  # No new number except 7, which was never given.
        assert node.flush(SOON_S)
    assert [*central.held[KEY]] == [3, 4, 8]
    assert central.gaps[KEY] == [(5, 5, "footer"), (6, 6, "unplugged"), (7, 7, runs.NEVER_GIVEN)]


def test_measurements_of_several_sensors_and_sessions_arrive(monkeypatch):
    for module, name in ((link, "_GREET_AGAIN_S"), (runs, "_PATIENCE_S")):  # A busy machine answers late.
        monkeypatch.setattr(module, name, SOON_S)
    left, right, later = entries(20), entries(20, sensor="right", seed=2), entries(5, first=0, session_id=9, seed=3)
    with StandIn(window=2) as central, Node(central.address, ("left", "right")) as node:
        for pair in zip(left, right, strict=True):
            node.append(pair)
        node.append(later)
        assert node.flush(SOON_S)
    assert has_all(central, left)
    assert has_all(central, right, ("right", EPOCH))
    assert has_all(central, later, ("left", 9))
    assert [hello.session_id for hello, _ in central.hellos.queue if hello.sensor == "left"] == [EPOCH, 9]


def test_measurements_in_flight_stay_within_the_window():
    with StandIn(window=4) as central, Node(central.address) as node:
        central.ignored = 1.0
        node.append(entries(20))
        until(lambda: central.seen == {10, 11, 12, 13})
        assert not node.flush(0.3)
        assert central.seen == {10, 11, 12, 13}
        central.ignored = 0.0
        assert node.flush(SOON_S)


def test_ended_sessions_are_closed():
    given = [entries(2, session_id=session_id) for session_id in range(20)]
    with StandIn() as central, Node(central.address) as node:
        central.max_runs = 3
        for several in given:
            node.append(several)
        assert node.flush(SOON_S)
        assert not node.notes.qsize()
    for session_id, several in enumerate(given):
        assert has_all(central, several, ("left", session_id))


def test_full_memory_drops_the_oldest():
    given = entries(40, first=0)
    central = StandIn()
    with central:
        address = central.address
    with Node(address, ring_bytes=10 * TINY.recording.n_samples) as node:
        for entry in given:
            node.append([entry])
            assert node.counts["left"].unacked_bytes <= 10 * TINY.recording.n_samples
        counts = node.counts["left"]
        assert (counts.accepted, counts.overwritten, counts.unacked) == (40, 30, 10)
        assert not node.flush(0.01)
        assert not node.flush(SOON_S, stop=lambda: True)
        with central:
            assert node.flush(SOON_S)
    assert [*central.held[KEY]] == list(range(30, 40))
    assert central.gaps[KEY] == [(0, 29, runs.MEMORY_FULL)]


def test_memory_is_constant_without_a_central_node():
    """Every other number is a gap, and neighbouring gaps differ in their reason."""
    small = TINY.replace(recording=Recording(n_samples=64))
    (blank,) = entries(1, settings=small)
    with StandIn() as central:
        address = central.address
    with SensorNode(address, ring_bytes=6400) as node:
        node.add_sensor("left", small)
        for number in range(0, 4000, 2):
            stamp = replace(blank.measurement.stamp, sequence=number)
            node.append([JournalEntry(replace(blank.measurement, stamp=stamp), 0)])
            node.note_gap("left", number + 1, number + 1, f"reason {number % 7}", session_id=EPOCH)
        run = node._spool.runs[KEY]  # noqa: SLF001  no public interface shows it
        assert len(run.items) < 300
        assert run.items[0].first == 0
        assert all(one.last + 1 == other.first for one, other in zip(run.items, list(run.items)[1:], strict=False))


@IMPATIENT
def test_memory_is_constant_while_one_sensor_is_refused():
    small = TINY.replace(recording=Recording(n_samples=64))
    refused = messages.Refused(code="serial", reason="no", sensor="left", session_id=EPOCH)
    with StandIn() as central, SensorNode(central.address) as node:
        central.refusal = lambda message: refused if getattr(message, "sensor", "") == "left" else None
        node.add_sensor("left", small)
        node.add_sensor("right", small)
        node.append(entries(1, settings=small))
        for entry in entries(3000, sensor="right", settings=small):
            node.append([entry])
        until(lambda: central.acked_through.get(("right", EPOCH)) == 3009)
        until(lambda: node.unacked == 1)
        node.append(entries(1, first=11, settings=small))
        assert len(node._spool._order) < 1010  # noqa: SLF001  no public interface shows it


def test_session_acknowledged_beyond_its_end_blocks_no_other():
    """A power cut may lose the end of a spool whose measurements were acknowledged."""
    later = entries(3, first=0, session_id=EPOCH + 1)
    with StandIn() as central, Node(central.address) as node:
        central.acked_through[KEY] = 15
        node.append([*entries(3), *later])  # Numbers 10 to 12.
        assert node.flush(SOON_S)
        assert node.acks.get_nowait().acked_through == 12
    assert KEY not in central.held
    assert has_all(central, later, ("left", EPOCH + 1))


def test_sensor_node_accepts_numpy_numbers():
    given = entries(2, first=0)
    stamp = given[0].measurement.stamp
    numpy = replace(
        stamp, sequence=np.int32(0), sync_count=np.int64(5), timestamp_ns=np.int64(9), session_id=np.uint32(EPOCH)
    )
    given[0] = replace(
        given[0], measurement=replace(given[0].measurement, stamp=numpy), monotonic_ns=np.int64(3), crc32=None
    )
    with StandIn() as central, Node(central.address) as node:
        node.append(given)
        node.note_gap("left", np.int64(2), np.int64(4), "footer", session_id=np.int64(EPOCH))
        assert node.flush(SOON_S)
        assert not node.notes.qsize()
    assert has_all(central, given)
    assert central.gaps[KEY] == [(2, 4, "footer")]


def test_dropped_measurements_are_counted_once():
    given = entries(8, first=0)
    with StandIn(acks="accepted") as central, Node(central.address) as node:
        central.dropped = ((2, "superseded"), (3, "superseded"), (5, "failed twice"))
        for entry in given:
            node.append([entry])
        assert node.flush(SOON_S)
        counts = node.counts["left"]
        reported = [ack.dropped for ack in node.acks.queue if ack.dropped]
    assert counts.dropped == {"superseded": 2, "failed twice": 1}
    assert (counts.taken, counts.stored) == (8, 0)
    assert reported == [central.dropped]


def test_sensor_node_counts_match_a_model_for_random_events():  # noqa: C901  one branch per kind of event
    """Compare the spool with a simple model under random losses, evictions, and late or excessive acks."""
    chance = random.Random(4)
    for _ in range(30):
        run = runs.OutgoingSession(JournalSensor.from_settings("left", TINY), EPOCH)
        taken, number, lost = -1, 0, set()
        for step in range(400):
            match chance.randrange(8):
                case 0 | 1:
                    run.add_measurement(number, 10, entry=None)
                    number += 1
                case 2:
                    run.add_gap(number, number + chance.randrange(3), chance.choice("ab"))
                    number = run.following
                case 3:
                    oldest = run.forget_oldest()
                    if oldest is not None:
                        lost.add(oldest.first)
                case 4 | 5:
                    item = run.to_send(4)
                    if item is not None:
                        assert item.last > run.sent
                        assert item.first <= run.sent + 1
                        run.mark_sent(item.last, step)
                        if item.first <= taken + 1 and chance.random() < 0.8:
                            taken = max(taken, item.last)
                case 6:
                    run.settle(chance.randint(run.acked_through - 2, max(taken, run.acked_through)), step)
                case 7:
                    run.go_back(step)
            assert run.acked_through <= taken
            assert run.sent <= run.reached
            expected = run.acked_through + 1
            for item in run.items:
                assert item.first == expected
                expected = item.last + 1
            assert not run.items or expected == run.following
            assert run.settle(run.reached + 1, step) == []
            assert sum(1 for _ in run.under_way()) <= 4 or run.items[0].reason


BAD = {
    "address": (lambda _: SensorNode("here"), "address 'here' cannot be used; use tcp://HOST:PORT"),
    "no keys": (
        lambda _: SensorNode("tcp://10.0.0.1:5601"),
        r"address tcp://10\.0\.0\.1:5601 can be reached from other machines, but there are no keys",
    ),
    "ring": (
        lambda _: SensorNode("tcp://127.0.0.1:1", ring_bytes=0),
        "ring_bytes is 0; use a whole number of at least 1",
    ),
    "limit without spool": (
        lambda _: SensorNode("tcp://127.0.0.1:1", spool_bytes=1),
        "spool_bytes is given without a spool; set its folder with spool",
    ),
    "unknown sensor": (
        lambda node: node.append(entries(1, sensor="right")),
        "sensor 'right' is not registered at this sensor node; add it first",
    ),
    "gap of it": (
        lambda node: node.note_gap("right", 0, 1, "x", session_id=1),
        "sensor 'right' is not registered at this sensor node; add it first",
    ),
    "gap backwards": (
        lambda node: node.note_gap("left", 2, 1, "x", session_id=1),
        "last missing sequence number is 1; use",
    ),
    "number": (
        lambda node: node.append(entries(1, first=2**48 + 1)),
        f"sequence is {2**48 + 1}; use a whole number from 0 to {2**48}",
    ),
    "number of a gap": (
        lambda node: node.note_gap("left", 20, 2**48 + 1, "x", session_id=EPOCH),
        f"last missing sequence number is {2**48 + 1}; use a whole number from 0 to {2**48}",
    ),
    "half a number": (
        lambda node: node.note_gap("left", 20, 21.5, "x", session_id=EPOCH),
        "last missing sequence number is 21.5; use a whole number",
    ),
    "session_id": (
        lambda node: node.note_gap("left", 1, 2, "x", session_id=-1),
        "session_id is -1; use a whole number from 0",
    ),
    "name": (lambda node: node.add_sensor("a" * 65, TINY), "sensor name 'a{65}' has 65 characters; the limit is 64"),
    "longer than the memory": (
        lambda node: node.add_sensor("b", TINY.replace(recording=Recording(n_samples=200_000))),
        r"a measurement of sensor b has 200000 bytes, but the memory has room for 100000; use a larger ring_bytes",
    ),
    "settings": (
        lambda node: node.append(entries(1, settings=TINY.replace(recording=Recording(n_samples=4097)))),
        "a measurement has other recording settings than sensor left",
    ),
    "again": (lambda node: node.append(entries(1)), "measurement 10 of sensor left follows 12"),
    "twice at once": (
        lambda node: node.append([*entries(1, first=20), *entries(1, first=20)]),
        "measurement 20 of sensor left follows 20",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_unsendable_measurements_are_refused(name):
    act, message = BAD[name]
    with Node("tcp://127.0.0.1:1", ring_bytes=100_000) as node:
        node.append(entries())
        with pytest.raises(ArgumentError, match=message):
            act(node)
        assert node.counts["left"].accepted == node.unacked == 3


def test_samples_of_any_type_are_sent_little_endian():
    (given,) = entries(1, first=0)
    strided = np.repeat(given.measurement.data, 2)[::2]
    given.measurement = replace(given.measurement, data=strided)
    with StandIn() as central, Node(central.address) as node:
        node.append([given])
        assert node.flush(SOON_S)
    assert central.held[KEY][0][1] == strided.tobytes()


def test_sensor_node_imports_no_heavy_library():
    done = python("import ertis_numba.network.sensor_node, sys; print(*sys.modules)")
    assert not {"h5py", "scipy", "numba", "ertis_numba.storage", "ertis_numba.pipeline"} & set(done.stdout.split())
    assert "zmq" in done.stdout

"""The intake alone: its counts, published measurements and limits, for any answers of its store."""

import time
import zlib

import numpy as np
import pytest

from ertis_numba.network.central_node import _admission, _intake
from ertis_numba.network.central_node._admission import Unwanted
from ertis_numba.network.central_node._intake import Intake
from ertis_numba.network.central_node._received_items import Forgotten, SensorSession, Stored
from ertis_numba.network.central_node._streams import SensorTrack
from ertis_numba.network.messages import Ack, Gap, Hello, Refused
from ertis_numba.settings import Air
from tests.central import data_of
from tests.journals import EPOCH, TINY, entries

RUN = SensorSession("left", EPOCH)


class Store:
    """Store that accepts items and never stores them."""

    def __init__(self):
        self.items = []

    def acked_through(self, _):
        return -1

    def offer(self, item):
        self.items.append(item)


class Viewer:
    """Viewer that counts the items shown to it."""

    def __init__(self):
        self.shown = []

    def register(self, *_):
        pass

    def offer(self, data, words, _):
        assert isinstance(words, np.ndarray)
        self.shown.append(data.sequence)


class Taken:
    """Intake with its sent messages and reports."""

    def __init__(self, *, store=True):
        self.store, self.viewer = Store() if store else None, Viewer()
        self.sent, self.reported = [], []
        self.intake = Intake(
            store=self.store,
            viewer=self.viewer,
            send=lambda _, message: self.sent.append(message),
            notify=lambda event, **more: self.reported.append((event, more)),
            on_stored=None,
            max_bytes=100_000,
        )

    def greet(self, peer=b"a", *, settings=TINY, session_id=EPOCH, key="", first=0):
        text = settings.to_toml().encode()
        hello = Hello(sensor="left", session_id=session_id, next_sequence=first, settings_crc32=zlib.crc32(text))
        return self.intake.greet(peer, hello, self.intake.read(hello, [text]), key)

    def measure(self, *given):
        for entry in given:
            data, words = data_of(entry)
            self.intake.measure(b"a", data, [memoryview(words)], time.monotonic_ns())

    def store_of(self, *items):
        for item in items:
            item.done = True
        self.intake.stored(Stored(list(items), 0.0))

    def acks(self):
        self.intake.acknowledge()
        return [message for message in self.sent if isinstance(message, Ack)]


def test_repeated_measurement_is_counted_and_published_once():
    taken, given = Taken(), entries(3, first=0)
    taken.greet()
    taken.measure(*given)
    first, second, third = taken.store.items
    taken.store_of(first)
    for forgotten in (Forgotten(second, "no room"), Forgotten(third)):
        taken.intake.forgotten(forgotten.item, forgotten.reason)
    taken.measure(*given[1:])
    track = taken.intake.tracks["left"]
    assert taken.viewer.shown == [0, 1, 2]
    assert (track.received, track.received_bytes) == (3, 3 * 4096)
    assert [item.first for item in taken.store.items] == [0, 1, 2, 1, 2]
    taken.store_of(*taken.store.items[3:])
    assert (track.stored, track.repeated, track.waiting) == (3, 0, 0)


def test_measurement_of_an_earlier_connection_is_not_stored_twice():
    taken, given = Taken(), entries(3, first=0)
    taken.greet()
    taken.measure(*given)
    first, second, third = taken.store.items
    taken.store_of(first)
    taken.intake.forgotten(second, "no room")
    taken.measure(given[1])  # on its way again, when the archive comes to what followed it
    taken.intake.forgotten(third, "")
    taken.measure(given[1])
    assert [item.first for item in taken.store.items] == [0, 1, 2, 1]
    assert taken.intake.tracks["left"].repeated == 1


def test_published_measurement_is_recognised_after_reconnection():
    taken, given = Taken(), entries(2, first=0)
    taken.greet()
    taken.measure(*given)
    taken.intake.bye(b"a")
    for item in taken.store.items[:2]:
        taken.intake.forgotten(item, "")
    taken.greet()
    taken.measure(*given)
    assert taken.viewer.shown == [0, 1]
    assert taken.intake.tracks["left"].received == 2


@pytest.mark.parametrize("first", [0, 1_000])
def test_number_of_waiting_gaps_is_bounded(first, monkeypatch):
    monkeypatch.setattr(_intake, "_WAITING_BYTES", 10_000)
    taken = Taken()
    taken.greet(first=first)
    for number in range(first, first + 100):
        taken.intake.miss(b"a", Gap(sensor="left", session_id=EPOCH, first=number, last=number, reason="lost"))
    assert 0 < len(taken.store.items) < 10
    reached = taken.store.items[-1].last
    taken.store_of(*taken.store.items)
    assert taken.acks()[-1].acked_through == reached
    taken.intake.miss(b"a", Gap(sensor="left", session_id=EPOCH, first=reached + 1, last=2_000, reason="lost"))
    assert taken.store.items[-1].last == 2_000


def test_length_of_gap_reasons_is_bounded():
    taken = Taken(store=False)
    taken.greet()
    for number in range(100):
        gap = Gap(sensor="left", session_id=EPOCH, first=number, last=number, reason=f"reason {number}")
        taken.intake.miss(b"a", gap)
    missing = taken.intake.tracks["left"].missing
    assert len(missing) < 40
    assert missing.total() == 100


def test_ack_lists_dropped_numbers_in_parts():
    taken = Taken(store=False)
    taken.greet()
    taken.intake.dropped([("left", EPOCH, number, "superseded") for number in range(40)])
    taken.intake.dropped([("nobody", EPOCH, 1, "superseded")])
    taken.measure(*entries(1, first=0))
    assert taken.acks()[-1].dropped == tuple((number, "superseded") for number in range(32))
    taken.intake.ping(b"a")
    assert taken.acks()[-1].dropped == tuple((number, "superseded") for number in range(32, 40))
    taken.intake.ping(b"a")
    assert taken.acks()[-1].dropped == ()


def test_sensor_sent_by_two_nodes_with_other_settings_is_refused():
    taken, other = Taken(), TINY.replace(air=Air(temperature_c=5.0))
    taken.greet(b"a")
    with pytest.raises(Unwanted, match="another sensor node sends sensor left, with other settings") as refused:
        taken.greet(b"b", settings=other, session_id=9)
    assert isinstance(refused.value.answer(Ack(sensor="left", session_id=9, acked_through=0, status="stored")), Refused)
    taken.greet(b"a", settings=other)  # its own may change
    taken.intake.bye(b"a")
    taken.greet(b"b", session_id=9)  # and who has left is in nobody's way


def test_sensor_sent_by_two_nodes_is_reported_once():
    taken = Taken()
    taken.greet(b"a")
    taken.greet(b"b", session_id=9)
    taken.intake.tick(time.monotonic())
    assert "shared" not in dict(taken.reported)  # the first may have gone, and be the second
    for peer in (b"a", b"b"):
        taken.intake.ping(peer)
    for _ in range(2):
        taken.intake.tick(time.monotonic())
    assert [more["sensor"] for event, more in taken.reported if event == "shared"] == ["left"]


def test_number_of_peers_per_key_is_limited(monkeypatch):
    monkeypatch.setattr(_admission, "_PEERS_OF_KEY", 2)
    taken = Taken()
    for peer in (b"a", b"b"):
        taken.greet(peer, session_id=peer[0], key="one")
    with pytest.raises(Unwanted, match="2 sensor nodes already use this key"):
        taken.greet(b"c", key="one")
    taken.greet(b"a", session_id=8, key="one")
    taken.greet(b"c", session_id=7, key="another")
    for peer in (b"d", b"e", b"f"):  # where there are no keys
        taken.greet(peer, session_id=peer[0])


def rate_hz(*times, session_ids=None, now_s=100.0):
    """Rate of measurements with times of arrival and of measurement, as the status reports it."""
    track = SensorTrack()
    for (arrived_s, measured_s), session_id in zip(times, session_ids or [1] * len(times), strict=True):
        track.took(4, session_id, arrived_s=arrived_s, measured_s=measured_s)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "monotonic", lambda: now_s)
        return track.status().rate_hz


def test_rate_of_kept_measurements_is_that_of_measuring():
    steady = [(98.0 + 0.1 * number, 5.0 + 0.1 * number) for number in range(20)]
    assert rate_hz(*steady) == pytest.approx(10)
    after_pause = [(99.0 + 0.001 * number, 5.0 + 0.1 * number) for number in range(20)]
    assert rate_hz(*after_pause) == pytest.approx(10)
    two_after_pause = [(99.0, 5.0), (99.0005, 5.1)]
    assert rate_hz(*two_after_pause) == pytest.approx(10)


def test_rate_without_recent_measurements_is_zero():
    assert rate_hz() == rate_hz((99.0, 5.0)) == rate_hz((90.0, 5.0), (90.1, 5.1)) == 0


def test_rate_is_that_of_the_latest_session():
    """The clock of another computer has other times."""
    times = [(98.0, 5e6), (98.1, 5e6 + 0.1), (98.5, 7.0), (98.7, 7.2), (98.9, 7.4)]
    assert rate_hz(*times, session_ids=[1, 1, 2, 2, 2]) == pytest.approx(5)

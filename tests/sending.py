"""A sensor node that queues its notes and acks, and checks of the messages that a stand-in received."""

import contextlib
import queue
import threading
import time

import pytest

from ertis_numba.network import connection, messages
from ertis_numba.network.sensor_node import SensorNode, _link as link, _outgoing_sessions as runs
from tests.journals import EPOCH, TINY

KEY = "left", EPOCH
SOON_S = 60.0


@pytest.fixture
def impatient(monkeypatch):
    """Shorten all intervals to fractions of a second, but do not mistake a busy machine for a silent central node."""
    for module, name, value in (
        (connection, "PING_INTERVAL_S", 0.05),
        (link, "SILENCE_LIMIT_S", SOON_S),
        (link, "_GREET_AGAIN_S", 0.1),
        (link, "_REFUSED_S", 0.1),
        (link, "_TURN_S", 0.01),
        (runs, "_PATIENCE_S", 0.05),
        (runs, "_MAX_PATIENCE_S", 0.2),
    ):
        monkeypatch.setattr(module, name, value)


IMPATIENT = pytest.mark.usefixtures("impatient")


@contextlib.contextmanager
def silent(central, node):
    """Silence a stand-in during the block, which begins once the node has noticed the silence."""
    central.silent = True
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(link, "SILENCE_LIMIT_S", 0.5)
        until(lambda: node.central == "away")
    yield
    central.silent = False


class Node(SensorNode):
    """A sensor node of one sensor that puts notes and acks into queues."""

    def __init__(self, address, sensors=("left",), **options):
        self.notes, self.acks = queue.Queue(), queue.Queue()
        super().__init__(address, on_note=self.notes.put, on_acked=self.acks.put, **options)
        for sensor in sensors:
            self.add_sensor(sensor, TINY, firmware="1.2.3", translation_m=(1, 2, 3))


def until(condition):
    """Wait until a condition holds."""
    end_s = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < end_s
        threading.Event().wait(0.005)


def same(held, wanted):
    """Compare a measurement held by the central node with the original, including all fields."""
    message, words = held
    entry, stamp, air = wanted, wanted.measurement.stamp, wanted.measurement.settings.air
    return words == entry.measurement.data.tobytes() and message == messages.Data(
        sensor=stamp.sensor,
        session_id=stamp.session_id,
        sequence=stamp.sequence,
        sync_count=stamp.sync_count,
        timestamp_ns=stamp.timestamp_ns,
        uncertainty_ns=stamp.timestamp_uncertainty_ns,
        monotonic_ns=entry.monotonic_ns,
        temperature_c=air.temperature_c,
        humidity_percent=air.humidity_percent,
        pressure_pa=air.pressure_pa,
        crc32=entry.crc32,
    )


def has_all(central, given, key=KEY):
    held = central.held.get(key, {})
    return [*held] == [entry.measurement.stamp.sequence for entry in given] and all(
        same(*pair) for pair in zip(held.values(), given, strict=True)
    )

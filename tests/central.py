"""A minimal sensor node and a central node in a thread, for the tests of the central node."""

import threading
import zlib
from contextlib import contextmanager

import zmq

from ertis_numba.journal import SUFFIX, Journal, JournalEntry
from ertis_numba.network import messages, sockets
from ertis_numba.network.central_node import Archive, CentralNode
from ertis_numba.storage import open_recording, sensor_names
from tests.journals import EPOCH, TINY

WAIT_MS = 60_000


class Node:
    """A sensor node that sends one protocol message per call."""

    def __init__(self, address, keys=None):
        self._context = zmq.Context()
        self.socket = sockets.client(self._context, address, keys=keys)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._context.destroy(linger=200)

    def send(self, message, *payload):
        self.socket.send_multipart([messages.encode(message), *payload])

    def hear(self, kind=None):
        """Return the next message, or the next one of a kind."""
        while True:
            assert self.socket.poll(WAIT_MS), f"no {kind} came"
            message = messages.decode(self.socket.recv_multipart()[0])
            if kind is None or isinstance(message, kind):
                return message

    def hear_settled(self, acked_through):
        """Read acks until one acknowledges a number; return that ack."""
        while True:
            ack = self.hear(messages.Ack)
            if ack.acked_through >= acked_through:
                return ack

    def hello(self, sensor="left", *, session_id=EPOCH, first=10, settings=TINY, **more):
        text = settings if isinstance(settings, bytes) else settings.to_toml().encode()
        crc32 = more.pop("settings_crc32", zlib.crc32(text))
        self.send(
            messages.Hello(sensor=sensor, session_id=session_id, next_sequence=first, settings_crc32=crc32, **more),
            text,
        )
        return self.hear((messages.Welcome, messages.Refused))

    def measure(self, *given, **changes):
        for entry in given:
            self.send(*data_of(entry, **changes))


def data_of(entry, **changes):
    """Build the Data message of a journal entry."""
    stamp, air = entry.measurement.stamp, entry.measurement.settings.air
    words = changes.pop("words", entry.measurement.data.tobytes())
    fields = {
        "sensor": stamp.sensor,
        "session_id": stamp.session_id,
        "sequence": stamp.sequence,
        "sync_count": stamp.sync_count,
        "timestamp_ns": stamp.timestamp_ns,
        "uncertainty_ns": stamp.timestamp_uncertainty_ns,
        "monotonic_ns": entry.monotonic_ns,
        "temperature_c": air.temperature_c,
        "humidity_percent": air.humidity_percent,
        "pressure_pa": air.pressure_pa,
        "crc32": zlib.crc32(words),
    }
    return messages.Data(**fields | changes), words


@contextmanager
def running(folder=None, **options):
    """Run a central node in a thread, with its archive in ``folder``."""
    events = []
    address = options.pop("address", "tcp://127.0.0.1:0")
    archive = options.pop("archive", None) or (None if folder is None else Archive(folder, seal=False))
    with CentralNode(address, archive=archive, on_event=events.append, **options) as central:
        central.events = events
        thread = threading.Thread(target=central.run)
        thread.start()
        try:
            yield central
        finally:
            central.stop()
            thread.join()


def stored(folder):
    """Read all recordings and journals: (sensor, session, sequence) and data in order, and the gaps."""
    found, missing = [], []
    for path in sorted(folder.glob(f"*.h5{SUFFIX}")):
        with Journal.open(path) as journal:
            found += wanted(journal.entries())
            missing += [(gap.sensor, gap.session_id, gap.first, gap.last, gap.reason) for gap in journal.gaps]
    for path in sorted(folder.glob("*.h5")):
        for name in sensor_names(path):
            with open_recording(path, sensor=name) as reader:
                found += wanted(JournalEntry(measurement, 0) for measurement in reader)
                missing += [(name, gap.session_id, gap.first, gap.last, gap.reason) for gap in reader.gaps]
    return found, missing


def wanted(entries):
    """The part of the result of `stored` that belongs to entries."""
    return [
        ((stamp.sensor, stamp.session_id, stamp.sequence), entry.measurement.data.tobytes())
        for entry in entries
        for stamp in [entry.measurement.stamp]
    ]

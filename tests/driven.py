"""Image processing driven as in a central node: a small event loop, measurements and an application."""

import select
import time
import zlib
from contextlib import contextmanager, suppress

import zmq

from ertis_numba.network import sockets
from ertis_numba.network.log import EventLog
from ertis_numba.network.messages import Bye, Data, Description, Hello, Subscribe, decode, encode
from ertis_numba.network.processing import ImageProcessing, ProcessingOptions
from ertis_numba.settings import Recording, Settings
from tests import cases

TIMEOUT_S = 200.0  # Some tests wait for compilers.
ANY = "tcp://127.0.0.1:0"
SHORT = cases.CASES["line of 8"].replace(
    recording=Recording(n_samples=20_480), processing=cases.SHORT.processing.replace(range_m=(0.3, 0.6))
)
"""Settings with small records and images, because the tests concern processes and messages."""
MEASUREMENT = cases.noise(SHORT)


def hello(sensor="front", settings=SHORT, session_id=7, **changes):
    text = settings.to_toml().encode()
    return Hello(sensor=sensor, session_id=session_id, next_sequence=0, settings_crc32=zlib.crc32(text), **changes)


def data(sensor="front", sequence=0, *, session_id=7, settings=SHORT, **changes):
    now_ns = time.time_ns()
    values = {
        "sync_count": sequence,
        "timestamp_ns": now_ns,
        "uncertainty_ns": 1000,
        "monotonic_ns": time.monotonic_ns(),
        "temperature_c": settings.air.temperature_c,
        "humidity_percent": settings.air.humidity_percent,
        "pressure_pa": settings.air.pressure_pa,
        "crc32": 0,
    }
    return Data(sensor=sensor, session_id=session_id, sequence=sequence, **(values | changes))


class Loop:
    """An event loop that drives an `ImageProcessing` and checks its counts after every step."""

    def __init__(self, processing):
        self.processing = processing
        self.offered = 0
        self._sensors = set()
        self._tick_s = 0.0

    def fresh(self):
        """Return a loop over the same processing that has seen no sensor, with an empty log."""
        self.lines.clear()
        loop = Loop(self.processing)
        loop.lines = self.lines
        return loop

    def step(self):
        processing = self.processing
        poll = select.poll()
        for fd in processing.fds():
            poll.register(fd, select.POLLIN)
        for fd, _ in poll.poll(5):
            if fd in processing.fds():
                processing.ready(fd)
        if time.monotonic() - self._tick_s > 0.05:
            self._tick_s = time.monotonic()
            processing.tick(self._tick_s)
        for application in Application.running:
            application.keep()
        self.check()

    def counts(self):
        return [self.processing.counts(sensor) for sensor in self._sensors]

    def check(self):
        for counts in self.counts():
            assert counts.in_flight >= 0
            assert counts.received == counts.published + sum(counts.dropped.values()) + counts.in_flight

    def until(self, condition):
        end_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end_s, (self.processing.status(), self.counts())
            self.step()

    def offer(self, sensor="front", words=None, **values):
        self._sensors.add(sensor)
        words = MEASUREMENT.data if words is None else words
        self.processing.offer(data(sensor, self.offered, **values), words, time.monotonic_ns())
        self.offered += 1
        self.check()

    def settle(self):
        self.until(lambda: not any(counts.in_flight for counts in self.counts()))

    def workers(self, state):
        return [worker for worker in self.processing.status().workers if worker.state == state]


@contextmanager
def driven(**options):
    log = Lines("processing")
    processing = ImageProcessing(
        ProcessingOptions(**({"publish": ANY, "device": "numpy", "workers": 1, "deadline_s": TIMEOUT_S} | options)), log
    )
    processing.start()
    loop = Loop(processing)
    loop.lines = log.lines
    try:
        yield loop
    finally:
        processing.close()


class Lines(EventLog):
    """An event log that keeps its events and their fields in a list."""

    def __init__(self, name):
        super().__init__(name)
        self.lines = []

    def _log(self, level, event, fields):  # noqa: ARG002  the signature of the base class
        self.lines.append((event, fields))


class Application:
    """An application that subscribes with one message per call."""

    running = set()  # noqa: RUF012  shared by all instances

    def __init__(self, address, keys=None):
        self._context = zmq.Context()
        self._reported_names, self._said_s = None, 0.0
        self.socket = sockets.client(self._context, address, keys=keys)
        self.consumed = 0
        self.descriptions = {}
        self.got = []
        self.others = []

    def subscribe(self, *products, **values):
        self.send(Subscribe(products=products, consumed=self.consumed, **values))

    def send(self, message):
        self._reported_names = message if isinstance(message, Subscribe) else None
        self._said_s = time.monotonic()
        try:
            # Waiting here for a publisher would block the loop that starts it.
            self.socket.send(encode(message), zmq.NOBLOCK)
        except zmq.Again:
            if self._reported_names is None:
                raise
            self._said_s = 0.0  # `keep` repeats it with the next step

    def keep(self):
        """Repeat the last subscription as a subscriber does, because it expires otherwise."""
        if self._reported_names is not None and time.monotonic() - self._said_s > 0.5:
            self.send(self._reported_names)

    def read(self):
        while self.socket.poll(0):
            header, *payloads = self.socket.recv_multipart()
            message = decode(header)
            if isinstance(message, Description):
                settings = Settings.from_toml(payloads[0].decode(), "description")
                self.descriptions[message.number] = message, settings, payloads[1:]
            elif hasattr(message, "number"):
                self.got.append((message, b"".join(payloads)))
            else:
                self.others.append(message)

    def kinds(self):
        return [type(message).__name__ for message, _ in self.got]

    def __enter__(self):
        self.running.add(self)
        return self

    def __exit__(self, *_):
        self.running.remove(self)
        with suppress(zmq.Again):
            self.send(Bye())  # Other tests may use the publisher.
        self._context.destroy(linger=200)

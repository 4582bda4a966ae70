"""Publisher process, which sends products to applications; `Publisher` starts it."""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zmq

from ertis_numba.base.errors import DataError, ErtisError, FormatVersionError
from ertis_numba.network import sockets
from ertis_numba.network.keys import KeyPair, ServerKeys
from ertis_numba.network.message_fields import as_line
from ertis_numba.network.messages import (
    AskStatus,
    Bye,
    Configure,
    Data,
    Gap,
    Hello,
    Image,
    Message,
    Ping,
    PlatformPose,
    Points,
    Pong,
    Raw,
    Refused,
    Report,
    Subscribe,
    decode,
    encode,
)
from ertis_numba.network.processing import pipe_messages
from ertis_numba.network.processing.pipe_messages import ToPublisher
from ertis_numba.network.processing.shared_slots import SlotView
from ertis_numba.network.processing.subscribers import QueuedProduct, Subscribers
from ertis_numba.network.trace import mark
from ertis_numba.network.zap_authenticator import ZapAuthenticator
from ertis_numba.processes import connect
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    from ertis_numba.processes import Pipe

_PIECE_BYTES: Final = 512 * 1024  # CURVE needs three times as long for the same bytes in one large frame.
_AT_ONCE: Final = 64
_TICK_MS: Final = 200
_REPORT_INTERVAL_S: Final = 1.0
# Enough for applications. A larger message would end the connection without an answer, and sensor nodes at the wrong
# address send settings.
_HEARD_BYTES: Final = Settings.max_bytes
_SENSORS_ELSEWHERE: Final = (
    "this address is for applications that receive products; for sensor nodes, poses and 'ertis sensors configure', "
    "use the first address that 'ertis serve' prints"
)


class _Publisher:
    def __init__(self, pipe: "Pipe[ToPublisher]", begin: pipe_messages.Begin) -> None:
        self._pipe = pipe
        self._views: dict[int, SlotView] = {}
        self._status = b""
        self._reports = 0
        self._wanted: pipe_messages.Wanted | None = None
        self._next_tick_s = self._next_report_s = 0.0
        keys = None
        if begin.public:
            keys = ServerKeys(KeyPair(begin.public, begin.secret, begin.name), Path(begin.allow))
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._authenticator = ZapAuthenticator(context, keys)
        self._socket = sockets.server(context, begin.address, keys=keys, max_bytes=_HEARD_BYTES, option="--publish")
        self._authenticator.watch(self._socket)
        self._subscribers = Subscribers(self._socket, with_keys=keys is not None)
        address = sockets.bound(self._socket)
        self._authenticator.self_test(address)
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._pipe.fileno(), zmq.POLLIN)
        if self._authenticator.socket is not None:
            self._poller.register(self._authenticator.socket, zmq.POLLIN)
        pipe.send(pipe_messages.Started(address=address))

    def run(self) -> None:
        while not self._pipe.closed:
            ready = dict(self._poller.poll(_TICK_MS))
            if self._authenticator.socket in ready:
                self._authenticator.serve()
            if self._pipe.fileno() in ready or self._pipe.waiting:
                for note in self._pipe.receive():
                    self._obey(note)
            if self._socket in ready:
                self._hear_all()
            self._tick(time.monotonic())

    def _hear_all(self) -> None:
        """Process waiting requests of applications."""
        for _ in range(_AT_ONCE):
            if not sockets.is_readable(self._socket):
                break
            self._hear(self._socket.recv_multipart(zmq.NOBLOCK, copy=False))
        self._report_wanted()

    def _report_wanted(self) -> None:
        """Report the sensors whose points are subscribed, after each change."""
        wanted = pipe_messages.Wanted(points=self._subscribers.sensors_for("points"))
        if wanted != self._wanted:
            self._wanted = wanted
            self._pipe.send(wanted)

    def _tick(self, now_s: float) -> None:
        if now_s >= self._next_tick_s:
            self._next_tick_s = now_s + _TICK_MS / 1000
            self._authenticator.tick()
            self._subscribers.tick(self._may_receive)
            self._report_wanted()
        if now_s >= self._next_report_s:
            self._next_report_s = now_s + _REPORT_INTERVAL_S
            self._subscribers.notify(Pong(state="processing"))
            if not self._pipe.waiting:
                refused = dict(self._authenticator.refused)
                self._pipe.send(
                    pipe_messages.Served(
                        subscribers=self._subscribers.status(),
                        refused=refused,
                        reports=self._reports,
                        keys_note=self._authenticator.note,
                    )
                )

    def _may_receive(self, frames: Sequence[zmq.Frame]) -> bool:
        permission = self._authenticator.who(frames)
        return permission is not None and permission.may_receive

    def _obey(self, note: ToPublisher) -> None:
        match note:
            case pipe_messages.SlotMemory():
                descriptor = self._pipe.files.popleft()
                self._views[note.slot] = SlotView(descriptor, note.words_bytes, note.image_bytes)
                os.close(descriptor)
            case pipe_messages.Describe():
                about = note.description
                self._subscribers.describe(about.sensor, about.number, [encode(about), *note.payloads])
            case pipe_messages.Publish():
                self._publish(note)
            case pipe_messages.Grouped():
                self._subscribers.offer(QueuedProduct("group", "", note.group))
            case pipe_messages.StatusNote():
                self._status, self._reports = note.status, self._reports + 1
                self._subscribers.offer(QueuedProduct("status", "", Report(), [note.status]))

    def _publish(self, note: pipe_messages.Publish) -> None:
        """Copy the subscribed parts of a slot once, send them to all subscribers, and release it."""
        view, sensor = self._views[note.slot], note.data.sensor
        mark("image fetched", sensor, note.data.sequence)
        common: dict[str, Any] = {
            name: getattr(note.data, name)
            for name in (
                *("session_id", "sequence", "sync_count", "timestamp_ns", "uncertainty_ns", "monotonic_ns"),
                "behaviour",
            )
        } | {"sensor": sensor, "number": 0, "dropped": 0}
        times: dict[str, Any] = {"received_ns": note.received_ns, "published_ns": 0}
        about = None if note.description is None else self._subscribers.description(sensor, note.description)
        raw_about = self._subscribers.description(sensor, note.raw_description)
        items = []
        if about is not None and self._subscribers.wanted("energyscape", sensor):
            rows, columns = note.shape
            payloads = _pieces(view.image(rows * columns * np.dtype(note.dtype).itemsize))
            levels = {} if note.levels is None else note.levels._asdict()
            image = Image(description=about[0], shape=note.shape, dtype=note.dtype, **levels, **common, **times)
            items.append(QueuedProduct("energyscape", sensor, image, payloads, about))
        if about is not None and note.n_points >= 0 and self._subscribers.wanted("points", sensor):
            cloud = Points(description=about[0], n_points=note.n_points, **common, **times)
            points = view.points(16 * note.n_points)
            items.append(QueuedProduct("points", sensor, cloud, [points], about))
        if raw_about is not None and self._subscribers.wanted("raw", sensor):
            air = {name: getattr(note.data, name) for name in ("temperature_c", "humidity_percent", "pressure_pa")}
            raw = Raw(description=note.raw_description, crc32=note.data.crc32, **common, **air)
            words = view.words(note.words_bytes)
            items.append(QueuedProduct("raw", sensor, raw, [words], raw_about))
        for item in items:
            self._subscribers.offer(item)
        published_ns = time.monotonic_ns()
        mark("published", sensor, note.data.sequence)  # Before this process wakes others that may take its core.
        self._pipe.send(pipe_messages.ProductsQueued(job=note.job, published_ns=published_ns))

    def _hear(self, frames: list[zmq.Frame]) -> None:
        """Process a request of an application, or refuse it; never raises for its content."""
        permission = self._authenticator.who(frames)
        if permission is None:
            if frames:
                self._subscribers.forget(frames[0].bytes)
            return
        if not permission.may_receive:
            reason = (
                f"this address is for applications, but {permission.name} has the role {permission.role}; use the "
                "address that 'ertis serve' prints first, or allow the key as application"
            )
            self._refuse(frames, Refused(code="role", reason=reason), "role")
            return
        if len(frames) != 2:
            text = (
                _SENSORS_ELSEWHERE if _is_for_sensors(frames) else f"a message has {len(frames) - 1} frames; send one"
            )
            self._refuse(frames, Refused(code="message", reason=text), "message")
            return
        try:
            message = decode(frames[1].bytes, (Subscribe, AskStatus, Ping, Bye))
        except FormatVersionError as error:
            self._refuse(frames, Refused(code="version", reason=as_line(str(error))), "version")
        except DataError as error:
            text = _SENSORS_ELSEWHERE if _is_for_sensors(frames) else as_line(str(error))
            self._refuse(frames, Refused(code="message", reason=text), "message")
        else:
            self._answer(frames, permission.name, message)

    def _answer(self, frames: list[zmq.Frame], name: str, message: Message) -> None:
        match message:
            case Subscribe():
                if not self._subscribers.hear(frames, name, message):
                    reason = "too many applications are connected, for this key or in all; end one"
                    self._refuse(frames, Refused(code="size", reason=reason), "too many")
            case AskStatus() if self._status:
                self._reply(frames, [encode(Report()), self._status])
            case Ping():
                self._reply(frames, [encode(Pong(state="processing"))])
            case Bye():
                self._subscribers.forget(frames[0].bytes)

    def _refuse(self, frames: list[zmq.Frame], refused: Refused, why: str) -> None:
        self._authenticator.refused[why] += 1
        self._reply(frames, [encode(refused)])

    def _reply(self, frames: list[zmq.Frame], answer: list[bytes]) -> None:
        try:
            self._socket.send_multipart([frames[0].bytes, *answer], zmq.NOBLOCK)
        except zmq.ZMQError:  # The peer is gone, or does not read.
            return


def _is_for_sensors(frames: list[zmq.Frame]) -> bool:
    """Return True for a message of a sensor node, an admin or a source of poses, which belongs to the other address."""
    try:
        return len(frames) > 1 and isinstance(decode(frames[1].bytes), Hello | Configure | Data | Gap | PlatformPose)
    except DataError:
        return False


def _pieces(data: memoryview) -> "list[bytes | memoryview | zmq.Frame]":
    """Return an image in frames that are quick to encrypt."""
    return [data[begin : begin + _PIECE_BYTES] for begin in range(0, len(data), _PIECE_BYTES)]


def _main() -> None:
    pipe: Pipe[ToPublisher] = connect(ToPublisher)
    begin = next(pipe.messages(), None)
    if not isinstance(begin, pipe_messages.Begin):
        return
    try:
        publisher = _Publisher(pipe, begin)
    except (ErtisError, OSError) as error:
        pipe.send(pipe_messages.Started(address="", error=str(error)))
    else:
        publisher.run()


if __name__ == "__main__":
    _main()

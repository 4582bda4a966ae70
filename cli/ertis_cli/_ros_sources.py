"""Sources of ``ertis ros``: the products of a central node, the measurements of a file at their speed, and sensors."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ertis_cli._sensors import ConfiguredSensors, named_sensors, opened_sensors, require_one_each
from ertis_cli._stop_signals import Signals

if TYPE_CHECKING:
    from ertis_numba.journal import JournalEntry
    from ertis_numba.network.keys import ClientKeys
    from ertis_numba.ros import RosPublisher
    from ertis_numba.settings import Settings

__all__ = ["publish_file", "publish_node", "publish_ports"]

_Place = tuple[int, str, int]  # Time in ns, sensor and index of a measurement.
_POLL_INTERVAL_S: Final = 0.1
_CLOCK_INTERVAL_S: Final = 0.02
_UNANSWERED_S: Final = 3.0
"""Time without an answer after which this is reported."""
_UNTIMED_S: Final = 0.1
"""Interval between measurements without timestamps."""


def publish_node(
    address: str,
    ros: "RosPublisher",
    *,
    images: bool,
    sensors: Sequence[str],
    keys: "ClientKeys | None",
    is_over: Callable[[], bool],
    on_note: Callable[[str], None],
    on_published: Callable[[], None],
    on_ready: Callable[[], None],
    signals: Signals,
) -> None:
    """Publish products of a central node, points unless images; raise NetworkError at the end if none came."""
    from ertis_numba.base.errors import NetworkError
    from ertis_numba.network.status import Status
    from ertis_numba.network.subscriber import Subscriber

    silent: set[str] = set()
    products: tuple[Any, ...] = ("energyscape" if images else "points", "status")
    with Subscriber(address, products=products, sensors=sensors or None, keys=keys, on_note=on_note) as subscriber:
        signals.obey(subscriber.close)
        on_ready()
        unanswered_s = time.monotonic() + _UNANSWERED_S
        while not is_over():
            item = subscriber.receive(_POLL_INTERVAL_S)
            arrival = subscriber.latest
            if item is None or arrival is None:
                if arrival is None and time.monotonic() > unanswered_s:
                    unanswered_s = float("inf")
                    on_note(f"waiting for {address}: no answer; is 'ertis serve' running?")
                continue
            if isinstance(item, Status):
                for name, state in item.sensors.items():
                    if state.passive and name not in silent and (not sensors or name in sensors):
                        silent.add(name)
                        on_note(f"note: sensor {name} has measurements without a call, which yield no images")
                ros.publish_status(item)
                continue
            place = None
            if arrival.translation_m is not None and arrival.rotation_xyzw is not None:
                place = arrival.translation_m, arrival.rotation_xyzw
            ros.publish(item, place)
            on_published()
    if subscriber.latest is None:
        raise NetworkError(
            f"nothing arrived from {address}; start 'ertis serve', and use the address at which it publishes"
        )


def publish_file(
    path: Path,
    ros: "RosPublisher",
    *,
    sensors: Sequence[str],
    device: Any,
    loop: bool,
    sim_time: bool,
    is_over: Callable[[], bool],
    on_passive: Callable[[int], None],
    on_published: Callable[[], None],
    on_ready: Callable[[], None],
    signals: Signals,
) -> None:
    """Publish images of a file at the publisher's speed; on_passive gets the number of those without a call."""
    # With `sim_time`, stamps are those of the file, as on `/clock`; otherwise the present. DataError without a call.
    from dataclasses import replace

    from ertis_cli import options
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording, sensor_names

    with ExitStack() as stack:
        opened: Any = open_energyscapes if file_kind(path) == "energyscape" else open_recording
        readers = {name: stack.enter_context(opened(path, sensor=name)) for name in (sensors or sensor_names(path))}
        for reader in readers.values():
            options.note_missing_points(reader)
        order = _in_order({name: reader.stamps() for name, reader in readers.items()})
        if opened is open_recording:
            order = _with_call(path, readers, order, on_passive)
        pipelines: dict[str, Pipeline] = {}
        signals.obey(lambda: None)
        on_ready()
        clock = _Clock(ros, sim_time=sim_time, is_over=is_over)
        again = True
        while again and not is_over():
            clock.start(order[0][0])
            for time_ns, name, index in order:
                item = readers[name][index]
                if not hasattr(item, "range_m"):
                    if name not in pipelines:
                        pipelines[name] = stack.enter_context(Pipeline(item.settings, device=device, predict=False))
                        clock.start(time_ns)  # Compilation takes seconds, and the file waits for it.
                    item = pipelines[name].process(item)
                if not clock.wait_until(time_ns):
                    return
                stamp_ns = time_ns if sim_time else time.time_ns()
                item = item.replace(stamp=replace(item.stamp, timestamp_ns=stamp_ns))
                reader = readers[name]
                known = reader.translation_m is not None and reader.rotation_xyzw is not None
                ros.publish(item, (reader.translation_m, reader.rotation_xyzw) if known else None)
                on_published()
            again = loop and clock.wait_until(order[-1][0] + round(1e9 * _UNTIMED_S))


def publish_ports(
    ports: tuple[str, ...],
    ros: "RosPublisher",
    *,
    settings: "Settings",
    trigger: str,
    rate_hz: float,
    device: Any,
    quiet: bool,
    is_over: Callable[[], bool],
    on_note: Callable[[str], None],
    on_published: Callable[[], None],
    on_ready: Callable[[], None],
    signals: Signals,
) -> None:
    """Measure with the sensors on some ports, and publish their images, until the program is to end."""
    from ertis_cli import options
    from ertis_numba.devices.capture import CaptureSession
    from ertis_numba.devices.setup import Setup

    with ExitStack() as stack:
        require_one_each(ports, ())
        sonars = named_sensors(ports, (), opened_sensors(ports, signals, stack, listen_only=False))
        sensors = ConfiguredSensors(sonars, Setup.of, check_bits=True, splices=False)
        sensors.configure_all(settings, signals)

        def tick() -> None:
            if is_over():
                session.stop()

        session = CaptureSession(
            sonars,
            settings,
            trigger=trigger,
            rate_hz=rate_hz,
            on_note=lambda sensor, text: on_note(f"{sensor}: {text}"),
            on_tick=tick,
        )
        with options.note_when_slow(options.PREPARING, quiet=quiet):
            sink = _ImageSink(ros, settings, device=device, on_published=on_published, stack=stack)
        signals.obey(session.stop)
        on_ready()
        try:
            session.run(sink)
        finally:
            if sink.superseded:
                count = options.counted(sink.superseded, "measurement")
                on_note(f"{count} not published, because newer ones had arrived; use a lower --trigger-rate")


class _ImageSink:
    """Publisher of each sensor's newest image; superseded counts measurements that newer ones replaced."""

    def __init__(
        self,
        ros: "RosPublisher",
        settings: "Settings",
        *,
        device: Any,
        on_published: Callable[[], None],
        stack: ExitStack,
    ) -> None:
        from ertis_numba.pipeline import Pipeline

        self._ros, self._on_published = ros, on_published
        self.superseded = 0
        self._pipeline: Pipeline = stack.enter_context(Pipeline(settings, device=device, predict=False))

    def add_sensor(self, name: str, settings: "Settings", **_: Any) -> None:
        """Accept a sensor; all have the same settings."""

    def append(self, entries: "Sequence[JournalEntry]") -> None:
        """Publish the image of the newest measurement of each sensor, so that images never lag behind."""
        newest = {entry.measurement.stamp.sensor: entry.measurement for entry in entries}
        self.superseded += len(entries) - len(newest)
        for measurement in newest.values():
            self._ros.publish(self._pipeline.process(measurement))
            self._on_published()

    def note_gap(self, sensor: str, first: int, last: int, reason: str, *, session_id: int) -> None:
        """Ignore missing measurements, which the session reports."""


def _with_call(
    path: Path, readers: Mapping[str, Any], order: list[_Place], on_passive: Callable[[int], None]
) -> list[_Place]:
    """Return the measurements of a recording that have echoes of a call, and report the number of others."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.frames import is_passive

    stamps = {name: reader.stamps() for name, reader in readers.items()}
    kept = [
        (time_ns, name, index)
        for time_ns, name, index in order
        if not is_passive(readers[name].settings, stamps[name][index])
    ]
    if not kept:
        raise DataError(f"{path}: all measurements are passive and have no echoes; choose a recording of emitted calls")
    if len(kept) < len(order):
        on_passive(len(order) - len(kept))
    return kept


def _in_order(stamps: Mapping[str, Sequence[Any]]) -> list[_Place]:
    """Return time, sensor and index of all measurements of a file, in the order of their times."""
    found = []
    for name, each in stamps.items():
        for index, stamp in enumerate(each):
            time_ns = stamp.timestamp_ns if stamp.is_timed else round(1e9 * (1 + index * _UNTIMED_S))
            found.append((time_ns, name, index))
    return sorted(found)


class _Clock:
    """Clock of a file: it waits for the times of measurements, and publishes ``/clock`` meanwhile."""

    def __init__(self, ros: "RosPublisher", *, sim_time: bool, is_over: Callable[[], bool]) -> None:
        self._ros, self._sim_time, self._is_over = ros, sim_time, is_over
        self._file_ns, self._latest_s = 0.0, 0.0

    def start(self, time_ns: int) -> None:
        """Let the time of the file be ``time_ns`` now."""
        self._file_ns, self._latest_s = float(time_ns), time.monotonic()

    def wait_until(self, time_ns: int) -> bool:
        """Wait for a time of the file; return False if the program is to end before."""
        while not self._is_over():
            self._advance()
            if self._sim_time:
                self._ros.publish_clock(min(time_ns, round(self._file_ns)))
            settings = self._ros.settings
            left_s = (time_ns - self._file_ns) / 1e9 / settings.speed
            if left_s <= 0 and not settings.paused:
                return True
            time.sleep(_CLOCK_INTERVAL_S if settings.paused else min(left_s, _CLOCK_INTERVAL_S))
        return False

    def _advance(self) -> None:
        """Let time pass at the present speed, unless it is paused."""
        settings, now_s = self._ros.settings, time.monotonic()
        if not settings.paused:
            self._file_ns += (now_s - self._latest_s) * 1e9 * settings.speed
        self._latest_s = now_s

"""Sensor node without a sensor that writes a diary: ``python -m ertis_bench.network.sender JOB``.

It hands measurements to a `SensorNode` as a capture does. Its diary contains the measurements that it hands over, those
that the node accepts, and the acknowledgements.
"""

import json
import os
import secrets
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_bench.network.diary import Diary, DiaryKey, Row
from ertis_bench.network.processes import JsonLinesProcess
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import JournalEntry
from ertis_numba.network.keys import ClientKeys, KeyPair
from ertis_numba.network.sensor_node import SensorNode
from ertis_numba.settings import Processing, Recording, Settings

__all__ = ["SETTINGS", "SMALL", "Sender", "SenderJob", "words_of"]

SETTINGS: Final = Settings()
SMALL: Final = Settings(
    recording=Recording(n_samples=32_768), processing=Processing(directions="2d:9", range_m=(0.3, 1.0))
)
"""Settings of measurements of 131 kB, from which images are computed quickly."""

_SYNC_OF_FIRST: Final = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class SenderJob:
    """Options of a sender.

    Attributes
    ----------
    address, diary : str
    sensors : tuple of str
    rate_hz : float
        Rate of each sensor. All sensors measure at the same time.
    count : int, optional
        Measurements of each sensor. By default, the sender runs until it is stopped.
    seed : int
        Seed of the words.
    small : bool
        Settings are `SMALL` instead of `SETTINGS`.
    spool : str, optional
    ring_bytes, spool_bytes : int, optional
    keys : (path of a secret, public key of the central node), optional
    patience_s : float
        Time limit for the last acknowledgements.
    words : str, optional
        File with the words of some measurements, which are sent in turn: (measurement, sample), or (sensor,
        measurement, sample) if those of sensors differ. By default, each measurement has new noise.
    mountings : dict of str to (translation_m, rotation_xyzw), optional
        Mountings by sensor.
    first_pulse, begins_ns : int, optional
        SYNC count and timestamp of the first measurement.
    lost_pulse, double_pulse : int, optional
        Pulse that the sensors miss, so that they measure nothing and count one pulse too few from then on; and pulse
        that they count twice, so that a number is left out.
    clock_step : (number, seconds), optional
        Pulse from which the clock is wrong, and its error.
    start_s : float, optional
        Start time on the clock of `time.monotonic`.
    passive : bool
        State that the sensors emit no calls.
    """

    address: str
    diary: str
    sensors: tuple[str, ...] = ("front",)
    rate_hz: float = 50.0
    count: int | None = None
    seed: int = 1
    small: bool = True
    spool: str | None = None
    ring_bytes: int | None = None
    spool_bytes: int | None = None
    keys: tuple[str, str] | None = None
    patience_s: float = 30.0
    words: str | None = None
    mountings: dict[str, tuple[Sequence[float], Sequence[float]]] = field(default_factory=dict)
    first_pulse: int = _SYNC_OF_FIRST
    begins_ns: int | None = None
    lost_pulse: int | None = None
    double_pulse: int | None = None
    clock_step: tuple[int, float] | None = None
    start_s: float | None = None
    passive: bool = False

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return replace(self, **changes)

    def sequence_of(self, pulse: int) -> int:
        """Return the sequence number of a pulse's measurement."""
        missed = self.lost_pulse is not None and pulse > self.lost_pulse
        return pulse - missed + (self.double_pulse is not None and pulse >= self.double_pulse)

    def command(self) -> list[str]:
        """Return the command that runs the sender."""
        return [sys.executable, "-m", "ertis_bench.network.sender", json.dumps(asdict(self))]

    def start(self, command: Sequence[str] | None = None, *, mark: str = "") -> JsonLinesProcess:
        """Start the sender, or a variant of its command. Its stderr goes to a file beside its diary."""
        return JsonLinesProcess(command or self.command(), stated=Path(self.diary).with_suffix(".txt"), mark=mark)


def words_of(base: NDArray[np.uint32], session_id: int, sequence: int) -> NDArray[np.uint32]:
    """Return words that are unique to a measurement."""
    words = base.copy()
    words[:4] = sequence & 0xFFFFFFFF, sequence >> 32, session_id & 0xFFFFFFFF, session_id >> 32
    return words


def _print_event(**event: object) -> None:
    os.write(1, f"{json.dumps(event)}\n".encode())


@dataclass(slots=True)
class Sender:
    """Sensor node that writes a diary."""

    job: SenderJob
    emit: Callable[..., None] = _print_event
    stopped: bool = False
    _settings: Settings = field(init=False)
    _diary: Diary = field(init=False)
    _session_id: int = field(default_factory=lambda: secrets.randbits(62), init=False)
    _reported: Counter[str] = field(default_factory=Counter, init=False)

    def __post_init__(self) -> None:
        self._settings = SMALL if self.job.small else SETTINGS
        self._diary = Diary(Path(self.job.diary))

    def send(self) -> None:
        """Send until the count is reached or `stopped` is set, then wait until all measurements are acknowledged."""
        job = self.job
        options: dict[str, Any] = {
            name: value for name in ("ring_bytes", "spool_bytes") if (value := getattr(job, name)) is not None
        }
        keys = None if job.keys is None else ClientKeys(pair=KeyPair.load(Path(job.keys[0])), server=job.keys[1])
        with SensorNode(
            job.address,
            keys=keys,
            spool=None if job.spool is None else Path(job.spool),
            on_acked=self._acked_through,
            on_note=self._note,
            **options,
        ) as node:
            sent = self._run(node)
            self.emit(event="done", sent=sent)
            flushed = node.flush(job.patience_s)
            self.emit(event="sent", sent=sent, flushed=flushed, dropped=dict(self._reported))

    def _acked_through(self, message: Any) -> None:
        """Record an acknowledgement of the node."""
        now_ns = time.monotonic_ns()
        self._diary.acked_through(message.sensor, message.session_id, message.acked_through, message.status, now_ns)
        for sequence, reason in message.dropped:
            self._diary.dropped(message.sensor, message.session_id, sequence, reason)
            self._reported[reason] += 1

    def _note(self, *texts: str) -> None:
        """Report a message of the node."""
        self.emit(event="note", text=": ".join(texts))

    def _run(self, node: SensorNode) -> int:
        """Send the measurements, and return the number of pulses."""
        job = self.job
        for sensor in job.sensors:
            place = dict(zip(("translation_m", "rotation_xyzw"), job.mountings.get(sensor, ()), strict=False))
            node.add_sensor(sensor, self._settings, firmware="bench", **place)
        self.emit(event="begun", session_id=self._session_id, pid=os.getpid())
        rng = np.random.default_rng(job.seed)
        n_samples = self._settings.recording.n_samples
        given = np.load(job.words) if job.words else None
        bases = {sensor: rng.integers(0, 2**32, n_samples, dtype=np.uint32) for sensor in job.sensors}
        start_s = time.monotonic() if job.start_s is None else job.start_s
        start_ns = time.time_ns() if job.begins_ns is None else job.begins_ns
        pulse = 0
        while not self.stopped and pulse != job.count:
            wait_s = start_s + pulse / job.rate_hz - time.monotonic()
            if wait_s > 0:
                time.sleep(min(wait_s, 0.05))
                continue
            if pulse == job.lost_pulse:
                pulse += 1
                continue
            stamp = self._stamp(pulse, start_ns)
            sequence = stamp.sequence
            measurements = [
                Measurement(
                    words_of(bases[sensor], self._session_id, sequence)
                    if given is None
                    else (given[number] if given.ndim == 3 else given)[sequence % given.shape[-2]],
                    self._settings,
                    replace(stamp, sensor=sensor),
                )
                for number, sensor in enumerate(job.sensors)
            ]
            for entry in node.append(self._entries(measurements)):
                self._diary.kept(_key(entry))
            pulse += 1
        return pulse

    def _stamp(self, pulse: int, start_ns: int) -> Stamp:
        job = self.job
        sequence = job.sequence_of(pulse)
        step_ns = 0
        if job.clock_step is not None and pulse >= job.clock_step[0]:
            step_ns = round(1e9 * job.clock_step[1])
        return Stamp(
            sequence=sequence,
            sync_count=job.first_pulse + sequence,
            session_id=self._session_id,
            timestamp_ns=start_ns + round(1e9 * pulse / job.rate_hz) + step_ns,
            timestamp_uncertainty_ns=100_000,
            behaviour="passive" if job.passive else "unknown",
        )

    def _entries(self, measurements: Sequence[Measurement]) -> list[JournalEntry]:
        """Return journal entries of measurements that arrive now, after the diary has recorded them."""
        rows, now_ns = [Row.of(each) for each in measurements], time.monotonic_ns()
        entries = [JournalEntry(each, monotonic_ns=now_ns) for each in measurements]
        for entry, row in zip(entries, rows, strict=True):
            self._diary.offered(_key(entry), row, now_ns)
        return entries


def _key(entry: JournalEntry) -> DiaryKey:
    stamp = entry.measurement.stamp
    return DiaryKey(stamp.sensor, stamp.session_id, stamp.sequence)


def _stop(sender: Sender, _number: int, _frame: FrameType | None) -> None:
    sender.stopped = True


def main(job: SenderJob) -> None:
    """Send until SIGTERM comes, or until the count is reached."""
    sender = Sender(job)
    signal.signal(signal.SIGTERM, partial(_stop, sender))
    sender.send()


if __name__ == "__main__":
    main(SenderJob(**json.loads(sys.argv[1])))

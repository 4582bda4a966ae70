"""What makes images of measurements and has them published, without ever holding up who takes them in."""

import itertools
import time
import zlib
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.journal import Entry
from ertis_numba.network.log import Log, logger
from ertis_numba.network.messages import Data, Group, Hello
from ertis_numba.network.processing import notes
from ertis_numba.network.processing.groups import Groups
from ertis_numba.network.processing.options import Options
from ertis_numba.network.processing.publisher import Publisher
from ertis_numba.network.processing.quarantine import Quarantine
from ertis_numba.network.processing.queues import SUPERSEDED, Counts, Queues
from ertis_numba.network.processing.runner import Done, Event, Job, Kind, KindFailed, KindReady, Lost, Runner, bytes_of
from ertis_numba.network.processing.sensors import Sensors
from ertis_numba.network.processing.workers import Workers
from ertis_numba.network.status import Latencies, ProcessingStatus, Status
from ertis_numba.settings import Air, Settings

__all__ = ["Processing"]

_RATE_S: Final = 3.0  # over which the load is told
_TRIES: Final = 2
_ENDED: Final = "the central node ended"
_GETTING_READY: Final = "the workers were getting ready"
_FAILED_TWICE: Final = "failed twice"
_PUBLISHER_DIED: Final = "the publisher died"
_REFUSED: Final = "it cannot be processed"
_CHANGED: Final = "the settings of its sensor changed"
_UNUSABLE: Final = "its settings cannot be used"
_UNDESCRIBED: Final = "nothing describes it"
_PAUSED: Final = "too many of its sensor have failed"
_IN_A_ROW: Final = 3  # measurements of a sensor that have failed twice, after which it has to pause …
_PAUSE_S: Final = 10.0  # … for that long, and twice as long each further time
_LONGEST_PAUSE_S: Final = 640.0


@dataclass(slots=True)
class _Failing:
    """A sensor whose measurements workers fail with, which costs the others of their time."""

    in_a_row: int = 0
    pause_s: float = _PAUSE_S
    until_s: float = 0.0


class Processing:
    """Makes images of measurements in worker processes and publishes them.

    It is a part of the loop of who takes measurements in: poll `fds`, call `ready` for each that can be read, and
    `tick` at least ten times a second. These calls wait for no other process and no disk: what they take is the copy
    of a measurement, and where a worker or the publisher is started, the milliseconds that this takes.

    Parameters
    ----------
    options : Options
    log : Log, optional
        Told what goes wrong; the package's own by default.

    Attributes
    ----------
    address : str
        Where applications subscribe.
    """

    def __init__(self, options: Options, log: Log | None = None) -> None:
        self._options = options
        self._log = log = logger("processing") if log is None else log
        self._queues = Queues()
        self._groups = Groups()
        self._publisher = Publisher(options, log)
        self._runner: Runner | None = None
        self._quarantine: Quarantine | None = None
        self._sensors = Sensors(options, log, describe=self._publisher.describe, prepare=self._prepare)
        self._n_jobs = 0
        self._order: dict[str, deque[Job]] = {}  # first tries under way, oldest first: they are published in order
        self._done: set[int] = set()  # those that wait for an older one, or for the publisher
        self._arrivals_s: deque[float] = deque()
        self._begun_s = time.monotonic()
        self._took = Latencies()
        self._retried = self._quarantined = 0
        self._failing: dict[str, _Failing] = {}  # by sensor
        self._final: ProcessingStatus | None = None

    @property
    def address(self) -> str:
        """Where applications subscribe."""
        return self._publisher.address

    @property
    def refused(self) -> dict[str, int]:
        """Messages and keys of applications that were refused, by reason."""
        return self._publisher.refused

    def start(self) -> None:
        """Start the processes; applications can subscribe when this returns.

        Raises
        ------
        NetworkError
            The address cannot be listened at.
        """
        try:
            self._runner = _runner(self._options, self._log)
            self._publisher.start()
            if self._options.expected is not None:
                self._sensors.expect(self._options.expected)
            if self._options.quarantine is not None:
                self._quarantine = Quarantine(self._options.quarantine, self._log)
        except BaseException:
            self.close(0.0)
            raise

    def know(self, hello: Hello, settings: Settings) -> None:
        """Take what a sensor is, before its first measurement, and whenever it has changed."""
        if self._sensors.know(hello, settings):
            self._groups.know(hello.sensor, time.monotonic_ns())

    def offer(self, data: Data, words: NDArray[np.unsignedinteger[Any]], arrived_ns: int) -> None:
        """Take a measurement, which is counted from now on until it is published or dropped.

        Parameters
        ----------
        data : Data
        words : array
            It is not copied, and must not change.
        arrived_ns : int
            By `time.monotonic_ns`.
        """
        now_s = time.monotonic()
        self._arrivals_s.append(now_s)
        kind = self._sensors.kind_of(data)
        self._tell(self._groups.add(data, arrived_ns))
        failing = self._failing.get(data.sensor)
        paused = failing is not None and now_s < failing.until_s
        if kind is None or paused:
            self._queues.take_in(data)
            self._queues.drop(data, _PAUSED if paused else _UNUSABLE)
            return
        self._n_jobs += 1
        reason = SUPERSEDED if self._sensors.is_ready(kind) else _GETTING_READY
        self._queues.add(Job(self._n_jobs, data, words, kind, arrived_ns), reason)
        self._dispatch()

    def fds(self) -> Iterable[int]:
        """Return what is to be polled for reading now; it changes."""
        runner = () if self._runner is None else self._runner.fds()
        return [*runner, *self._publisher.fds()]

    def ready(self, fd: int) -> None:
        """Do what there is to do, as a descriptor can be read."""
        if self._runner is None:
            return
        if fd in self._publisher.fds():
            self._confirm(self._publisher.ready())
        else:
            self._handle(self._runner.ready(fd))
        self._dispatch()

    def tick(self, now_s: float) -> None:
        """Do what time demands; ``now_s`` is that of `time.monotonic`."""
        if self._runner is None:
            return
        self._handle(self._runner.tick(now_s, self._rate_hz(now_s)))
        self._confirm(*self._publisher.tick(now_s))
        self._tell(self._groups.tick(time.monotonic_ns()))
        self._sensors.tick()
        self._tidy(self._runner)
        for sensor in list(self._order):
            self._publish_of(sensor)
        self._dispatch()

    def counts(self, sensor: str) -> Counts:
        """Return what became of a sensor's measurements."""
        return self._queues.counts_of(sensor)

    def drain_dropped(self) -> list[tuple[str, int, int, str]]:
        """Return sensor, epoch, number and reason of what was dropped since, the latest of it if it is a lot."""
        found = list(self._queues.dropped)
        self._queues.dropped.clear()
        return found

    def status(self) -> ProcessingStatus:
        """Return how it goes."""
        runner = self._runner
        if runner is None and self._final is not None:
            return self._final
        return ProcessingStatus(
            address=self.address,
            choice="" if runner is None else runner.choice,
            workers=[] if runner is None else runner.status(),
            respawned=0 if runner is None else runner.respawned,
            retried=self._retried,
            quarantined=self._quarantined,
            publisher_respawned=self._publisher.respawned,
            publisher_pid=self._publisher.pid,
            process_time=self._took.percentiles(),
            subscribers=list(self._publisher.subscribers),
            groups=dict(self._groups.closed),
        )

    def publish_status(self, status: Status) -> None:
        """Have applications told how the central node is."""
        self._publisher.report(status)

    def close(self, timeout_s: float = 0.0) -> None:
        """End all of it; measurements that are under way have that long."""
        end_s = time.monotonic() + timeout_s
        while any(each.in_flight for each in self._queues.counts.values()) and time.monotonic() < end_s:
            for fd in list(self.fds()):
                self.ready(fd)
            self.tick(time.monotonic())
            time.sleep(0.005)
        if self._runner is not None:
            self._final = self.status()
            self._runner.close()
            self._runner = None
        self._publisher.close()
        if self._quarantine is not None:
            self._quarantine.close()
            self._quarantine = None
        for counts in self._queues.counts.values():
            counts.queue = 0
            if counts.in_flight:
                counts.dropped[_ENDED] += counts.in_flight
                counts.in_flight = 0

    def _rate_hz(self, now_s: float) -> float:
        while self._arrivals_s and now_s - self._arrivals_s[0] > _RATE_S:
            self._arrivals_s.popleft()
        return len(self._arrivals_s) / min(_RATE_S, max(now_s - self._begun_s, 0.5))

    def _prepare(self, kind: Kind) -> None:
        if self._runner is not None:
            self._runner.prepare(kind)

    def _tidy(self, runner: Runner) -> None:
        """Let go of kinds that no sensor has any more; of what waits of them, there are no images."""
        for kind in self._sensors.unused(lambda kind: any(job.kind is kind for job in self._under_way())):
            self._queues.drop_kind(kind.number, _CHANGED)
            runner.forget(kind)

    def _under_way(self) -> Iterable[Job]:
        return itertools.chain.from_iterable(self._order.values())

    def _dispatch(self) -> None:
        """Give workers what waits, as long as they take it."""
        runner, found = self._runner, True
        while runner is not None and found:
            found = False
            for job in self._queues.turns():
                if runner.takes(job.kind):
                    self._queues.take(job)
                    job.points = self._publisher.wants_points(job.data.sensor)
                    if not job.tries:
                        self._order.setdefault(job.data.sensor, deque()).append(job)
                    runner.submit(job)
                    found = True
                    break

    def _handle(self, events: Sequence[Event]) -> None:
        for event in events:
            match event:
                case KindReady(prepared=prepared):
                    self._sensors.became_ready(prepared)
                case KindFailed(kind=kind, text=text):
                    self._sensors.failed(kind, text)
                    self._queues.drop_kind(kind, _UNUSABLE)
                case Done(job=job, took_s=took_s):
                    self._took.add(1e3 * took_s)
                    self._done.add(job.number)
                    self._failing.pop(job.data.sensor, None)
                    self._publish_of(job.data.sensor)
                    if job.tries:
                        self._publish(job)
                case Lost():
                    self._lost(event)

    def _lost(self, event: Lost) -> None:
        job = event.job
        about = {"sensor": job.data.sensor, "epoch": job.data.epoch, "sequence": job.data.sequence, "text": event.text}
        job.tries += 1
        self._leave(job)
        if not event.again:
            self._log.warning("dropped", **about)
            self._queues.drop(job.data, _REFUSED)
        elif job.tries < _TRIES:
            self._log.warning("retried", **about)
            self._retried += 1
            self._queues.again(job)
        else:
            self._log.error("failed_twice", **about)
            self._queues.drop(job.data, _FAILED_TWICE)
            self._keep(job)
            self._failed_twice(job.data.sensor)
        self._publish_of(job.data.sensor)

    def _failed_twice(self, sensor: str) -> None:
        """Have a sensor pause after some in a row: each has cost workers two deadlines, and was before all others."""
        failing = self._failing.setdefault(sensor, _Failing())
        failing.in_a_row += 1
        if failing.in_a_row < _IN_A_ROW:
            return
        failing.until_s = time.monotonic() + failing.pause_s
        self._log.error("paused", sensor=sensor, text=f"{_PAUSED}; it is tried again in {failing.pause_s:g} s")
        failing.pause_s = min(2 * failing.pause_s, _LONGEST_PAUSE_S)
        self._queues.drop_sensor(sensor, _PAUSED)

    def _keep(self, job: Job) -> None:
        """Put a measurement where somebody can look at it."""
        self._quarantined += 1
        if self._quarantine is None:
            return
        data, settings = job.data, self._sensors[job.data.sensor].settings
        air = Air(
            temperature_c=data.temperature_c, humidity_percent=data.humidity_percent, pressure_pa=data.pressure_pa
        )
        settings = settings.replace(air=air)
        layout = microphones(settings.array)
        shape = (settings.recording.n_samples, layout.n_words)[: 1 + (layout.n_words > 1)]
        words = np.frombuffer(bytes_of(job.words), f"<u{layout.word_bits // 8}")
        if words.size != int(np.prod(shape)):
            return
        stamp = Stamp(
            sensor=data.sensor,
            sequence=data.sequence,
            sync_count=data.sync_count,
            timestamp_ns=data.timestamp_ns,
            timestamp_uncertainty_ns=data.uncertainty_ns,
            epoch=data.epoch,
        )
        measurement = Measurement(words.reshape(shape).copy(), settings, stamp)
        self._quarantine.put(Entry(measurement, data.monotonic_ns, zlib.crc32(bytes_of(job.words))))

    def _publish_of(self, sensor: str) -> None:
        """Publish what is done of a sensor, in the order in which it came."""
        jobs = self._order.get(sensor, deque())
        while jobs and jobs[0].number in self._done and self._publisher.serves:
            self._publish(jobs.popleft())

    def _publish(self, job: Job) -> None:
        sensor, slot = self._sensors[job.data.sensor], job.slot
        self._done.discard(job.number)
        if slot is None or self._runner is None:
            return
        if not self._publisher.serves or sensor.kind is not job.kind:
            self._runner.give_back(slot)
            reason = _PUBLISHER_DIED if sensor.kind is job.kind else _CHANGED
            self._queues.drop(job.data, reason)
            return
        note = notes.Publish(
            job=job.number,
            slot=slot.number,
            data=job.data,
            received_ns=job.arrived_ns,
            description=sensor.image,
            raw_description=sensor.raw,
            shape=self._sensors.shape_of(job.kind),
            dtype=self._options.dtype,
            n_points=job.n_points if job.points else -1,
            words_bytes=job.words.nbytes,
        )
        if not self._publisher.publish(job, note):
            self._runner.give_back(slot)
            self._queues.drop(job.data, _UNDESCRIBED)

    def _leave(self, job: Job) -> None:
        """Take a job out of the order in which others are published."""
        jobs = self._order.get(job.data.sensor, deque())
        if job in jobs:
            jobs.remove(job)

    def _confirm(self, taken: Sequence[tuple[Job, int]], lost: Sequence[Job] = ()) -> None:
        """Count what was published, or has died with the publisher, and take the slots back."""
        for job, published_ns in taken:
            counts = self._queues.counts_of(job.data.sensor)
            counts.published += 1
            counts.in_flight -= 1
            counts.times.add((published_ns - job.arrived_ns) / 1e6)
        for job in lost:
            self._queues.drop(job.data, _PUBLISHER_DIED)
        for job in (*(job for job, _ in taken), *lost):
            if job.slot is not None and self._runner is not None:
                self._runner.give_back(job.slot)

    def _tell(self, groups: Iterable[Group]) -> None:
        for group in groups:
            self._publisher.group(group)


def _runner(options: Options, log: Log) -> Runner:
    if options.cluster is None:
        return Workers(options, log)
    from ertis_numba.network.processing.cluster import Cluster  # noqa: PLC0415  which needs another package

    return Cluster(options, lambda text: log.warning("cluster", text=text))

"""Processing and publication of images, without ever delaying the intake."""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.memory import require_images
from ertis_numba.network.log import EventLog, logger
from ertis_numba.network.messages import Data, Group, Hello
from ertis_numba.network.processing import pipe_messages
from ertis_numba.network.processing.dead_letter_queue import DeadLetterQueue, entry_of
from ertis_numba.network.processing.groups import Groups
from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.parallelism import Load
from ertis_numba.network.processing.publisher import Publisher
from ertis_numba.network.processing.queues import SUPERSEDED, CircuitBreaker, ProcessingCounts, Queues, ReorderBuffer
from ertis_numba.network.processing.runner import (
    Event,
    FinishedJob,
    Job,
    JobKind,
    KindFailed,
    KindReady,
    Lost,
    Runner,
    bytes_of,
)
from ertis_numba.network.processing.sensors import Sensors
from ertis_numba.network.processing.shared_slots import SlotPool
from ertis_numba.network.processing.worker_pool import new_runner
from ertis_numba.network.status import Latencies, ProcessingStatus, Status
from ertis_numba.network.trace import mark
from ertis_numba.settings import Settings

__all__ = ["ImageProcessing"]

_TRIES: Final = 2
_PASSIVE_SLOTS: Final = range(-16, 0)  # Measurements without an image at the publisher; workers' slots begin at 0.
_ENDED: Final = "the central node ended"
_GETTING_READY: Final = "the workers were getting ready"
_FAILED_TWICE: Final = "failed twice"
_PUBLISHER_DIED: Final = "the publisher died"
_REFUSED: Final = "it cannot be processed"
_CHANGED: Final = "the settings of its sensor changed"
_UNUSABLE: Final = "its settings cannot be used"
_UNDESCRIBED: Final = "no description"
_PAUSED: Final = "sensor suspended after repeated failures"


class ImageProcessing:
    """Processing of measurements in worker processes, and publication of the images.

    It runs in the event loop of the intake: poll `fds`, call `ready` for each readable one, and `tick` at least ten
    times a second. These calls wait for no other process and no disk.
    """

    def __init__(self, options: ProcessingOptions, log: EventLog | None = None) -> None:
        self._options = options
        self._log = log = logger("processing") if log is None else log
        self._queues = Queues()
        self._groups = Groups()
        self._publisher = Publisher(options, log)
        self._runner: Runner | None = None
        self._dead_letter_queue: DeadLetterQueue | None = None
        self._sensors = Sensors(options, log, describe=self._publisher.describe, prepare=self._prepare)
        self._n_jobs = 0
        self._images: dict[tuple[str, int], int] = {}  # Number of images, by sensor and number of the latest kind.
        self._order = ReorderBuffer()
        self._passive_slots = SlotPool(_PASSIVE_SLOTS)
        self._passive: set[str] = set()  # Sensors that have sent measurements without a call.
        self._load = Load()
        self._took = Latencies()
        self._retried = self._quarantined = 0
        self._circuit_breaker = CircuitBreaker()
        self._final: ProcessingStatus | None = None

    @property
    def address(self) -> str:
        """Address for applications."""
        return self._publisher.address

    @property
    def refused(self) -> dict[str, int]:
        """Refused messages and keys of applications, by reason."""
        return self._publisher.refused

    def start(self, stopping: Callable[[], bool] = lambda: False) -> None:
        """Start the processes, until applications can subscribe or ``stopping``, polled each 0.2 s, is True."""
        try:
            self._runner = new_runner(self._options, self._log)
            self._publisher.start(stopping)
            if self._options.expected is not None:
                self._sensors.expect(self._options.expected)
            if self._options.quarantine is not None:
                self._dead_letter_queue = DeadLetterQueue(self._options.quarantine, self._log)
        except BaseException:
            self.close(0.0)
            raise

    def require_usable(self, settings: Settings) -> None:
        """Refuse settings without a possible image, or with too large a one; any thread may call this."""
        applied = self._options.applied(settings)
        if applied.processing.mode != "passive":
            require_images(applied)

    def register(self, hello: Hello, settings: Settings) -> None:
        """Register a sensor before its first measurement, and after each change."""
        if self._sensors.register(hello, settings):
            self._groups.register(hello.sensor, time.monotonic_ns())

    def offer(self, data: Data, words: NDArray[np.unsignedinteger[Any]], arrived_ns: int) -> None:
        """Accept a measurement; words are not copied and must not change; arrived_ns by time.monotonic_ns."""
        kind = self._sensors.kind_of(data)
        self._emit_event(self._groups.add(data, arrived_ns))
        if kind is not None and not kind.settings:
            self._offer(data, words, arrived_ns, kind, SUPERSEDED)
            self._note_passive(data.sensor)
            return
        now_s = time.monotonic()
        self._load.add(now_s)
        paused = self._circuit_breaker.holds(data.sensor, now_s)
        if kind is None or paused:
            self._queues.take_in(data)
            self._queues.drop(data, _PAUSED if paused else _UNUSABLE)
            return
        self._offer(data, words, arrived_ns, kind, SUPERSEDED if self._sensors.is_ready(kind) else _GETTING_READY)

    def _offer(
        self, data: Data, words: NDArray[np.unsignedinteger[Any]], arrived_ns: int, kind: JobKind, reason: str
    ) -> None:
        """Queue a measurement; ``reason`` is that of an older one that it replaces."""
        self._n_jobs += 1
        self._queues.add(Job(self._n_jobs, data, words, kind, arrived_ns), reason)
        self._dispatch()

    def _note_passive(self, sensor: str) -> None:
        if sensor not in self._passive:
            self._passive.add(sensor)
            text = "the sensor emits no call; applications receive its measurements, but no images"
            self._log.info("passive", sensor=sensor, text=text)

    def fds(self) -> Iterable[int]:
        """Return the descriptors to poll for reading at present."""
        runner = () if self._runner is None else self._runner.fds()
        return [*runner, *self._publisher.fds()]

    def ready(self, fd: int) -> None:
        """Process the event of a readable descriptor."""
        if self._runner is None:
            return
        if fd in self._publisher.fds():
            self._confirm(self._publisher.ready())
        else:
            self._handle(self._runner.ready(fd))
        self._dispatch()

    def tick(self, now_s: float) -> None:
        """Do periodic work; ``now_s`` is a time of `time.monotonic`."""
        if self._runner is None:
            return
        self._handle(self._runner.tick(now_s, self._load))
        self._confirm(*self._publisher.tick(now_s))
        self._emit_event(self._groups.tick(time.monotonic_ns()))
        self._sensors.tick()
        self._tidy(self._runner)
        for sensor in self._order.sensors:
            self._publish_of(sensor)
        self._dispatch()

    def counts(self, sensor: str) -> ProcessingCounts:
        """Return the counts of a sensor's measurements."""
        return self._queues.counts_of(sensor)

    def drain_dropped(self) -> list[tuple[str, int, int, str]]:
        """Return sensor, session_id, number and reason of new drops; only the latest of very many."""
        found = list(self._queues.dropped)
        self._queues.dropped.clear()
        return found

    def status(self) -> ProcessingStatus:
        """Return the status."""
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
        """Send the status of the central node to applications."""
        self._publisher.report(status)

    def close(self, timeout_s: float = 0.0) -> None:
        """Close everything; measurements under way get a limited time."""
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
        self._passive_slots.close()
        if self._dead_letter_queue is not None:
            self._dead_letter_queue.close()
            self._dead_letter_queue = None
        for counts in self._queues.counts.values():
            counts.queue = 0
            if counts.in_flight:
                counts.dropped[_ENDED] += counts.in_flight
                counts.in_flight = 0

    def _prepare(self, kind: JobKind) -> None:
        if self._runner is not None:
            self._runner.prepare(kind)

    def _tidy(self, runner: Runner) -> None:
        """Release kinds without a sensor, and drop their waiting measurements."""
        for kind in self._sensors.unused(lambda kind: any(job.kind is kind for job in self._order.jobs)):
            self._queues.drop_kind(kind.number, _CHANGED)
            runner.forget(kind)

    def _dispatch(self) -> None:
        """Give waiting measurements to workers, as far as they accept them."""
        runner, found = self._runner, True
        while runner is not None and found and not self._queues.is_empty:
            found = any(self._start(job, runner) for job in self._queues.turns())

    def _start(self, job: Job, runner: Runner) -> bool:
        """Give a waiting measurement to a worker, or without a call to the publisher; return False if it must wait."""
        if not job.kind.settings:
            return self._forward(job)
        if not runner.takes(job.kind):
            return False
        self._queues.take(job)
        job.points = self._publisher.wants_points(job.data.sensor)
        self._choose_checks(job)
        self._order.add(job)
        runner.submit(job)
        return True

    def _choose_checks(self, job: Job) -> None:
        """Check the sound of images 1, 2, 4, 8 and so on of a sensor's settings, and the error of the first one."""
        sensor, kind = job.data.sensor, job.kind.number
        count = self._images.get((sensor, kind), 0) + 1
        if count == 1:
            self._images = {key: number for key, number in self._images.items() if key[0] != sensor}
        self._images[sensor, kind] = count
        job.predict, job.check_sound = count == 1, count & (count - 1) == 0

    def _forward(self, job: Job) -> bool:
        """Pass a measurement without a call to the publisher, after the images before it; return False if full."""
        slot = self._passive_slots.take(job.words.nbytes, 0) if self._publisher.serves else None
        if slot is None:
            return False
        slot.view.words(job.words.nbytes)[:] = bytes_of(job.words)
        job.slot = slot
        self._queues.take(job)
        self._order.add(job)
        self._order.done(job)
        self._publish_of(job.data.sensor)
        return True

    def _release(self, job: Job) -> None:
        """Release the slot of a job that was published or dropped."""
        if job.slot is not None and not job.kind.settings:
            self._passive_slots.release(job.slot)
        elif job.slot is not None and self._runner is not None:
            self._runner.release(job.slot)

    def _handle(self, events: Sequence[Event]) -> None:
        for event in events:
            match event:
                case KindReady(prepared=prepared):
                    self._sensors.became_ready(prepared)
                case KindFailed(kind=kind, text=text):
                    self._sensors.failed(kind, text)
                    self._queues.drop_kind(kind, _UNUSABLE)
                case FinishedJob(job=job, took_s=took_s):
                    mark("image known", job.data.sensor, job.data.sequence)
                    self._took.add(1e3 * took_s)
                    self._order.done(job)
                    self._circuit_breaker.succeeded(job.data.sensor)
                    self._publish_of(job.data.sensor)
                    if job.tries:
                        self._publish(job)
                case Lost():
                    self._lost(event)

    def _lost(self, event: Lost) -> None:
        job = event.job
        about = {
            "sensor": job.data.sensor,
            "session_id": job.data.session_id,
            "sequence": job.data.sequence,
            "text": event.text,
        }
        job.tries += 1
        self._order.leave(job)
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
        """Suspend a sensor after successive failures: each has cost workers two deadlines, ahead of all other jobs."""
        pause_s = self._circuit_breaker.failed(sensor)
        if pause_s:
            self._log.error("paused", sensor=sensor, text=f"{_PAUSED}; it is tried again in {pause_s:g} s")
            self._queues.drop_sensor(sensor, _PAUSED)

    def _keep(self, job: Job) -> None:
        """Put a measurement into the dead-letter queue."""
        self._quarantined += 1
        if self._dead_letter_queue is None:
            return
        entry = entry_of(job, self._sensors[job.data.sensor].settings)
        if entry is not None:
            self._dead_letter_queue.put(entry)

    def _publish_of(self, sensor: str) -> None:
        """Publish a sensor's finished images in the order of its measurements."""
        while self._publisher.serves and (job := self._order.take(sensor)) is not None:
            self._publish(job)

    def _publish(self, job: Job) -> None:
        sensor, slot = self._sensors[job.data.sensor], job.slot
        if slot is None or self._runner is None:
            return
        is_current = job.kind is sensor.kind or job.kind is sensor.passive
        if not self._publisher.serves or not is_current:
            self._release(job)
            self._queues.drop(job.data, _PUBLISHER_DIED if is_current else _CHANGED)
            return
        is_image = job.kind is not sensor.passive
        note = pipe_messages.Publish(
            job=job.number,
            slot=slot.number,
            data=job.data,
            received_ns=job.arrived_ns,
            description=sensor.image if is_image else None,
            raw_description=sensor.raw,
            shape=self._sensors.shape_of(job.kind) if is_image else (0, 0),
            dtype=self._options.dtype,
            levels=job.levels,
            n_points=job.n_points if job.points else -1,
            words_bytes=job.words.nbytes,
        )
        if not self._publisher.publish(job, note):
            self._release(job)
            self._queues.drop(job.data, _UNDESCRIBED)

    def _confirm(self, taken: Sequence[tuple[Job, int]], lost: Sequence[Job] = ()) -> None:
        """Count published images and those lost with the publisher, and release their slots."""
        for job, published_ns in taken:
            counts = self._queues.counts_of(job.data.sensor)
            counts.published += 1
            counts.in_flight -= 1
            if job.kind.settings:
                counts.times.add((published_ns - job.arrived_ns) / 1e6)
            else:
                counts.passive += 1
        for job in lost:
            self._queues.drop(job.data, _PUBLISHER_DIED)
        for job in (*(job for job, _ in taken), *lost):
            self._release(job)

    def _emit_event(self, groups: Iterable[Group]) -> None:
        for group in groups:
            self._publisher.group(group)

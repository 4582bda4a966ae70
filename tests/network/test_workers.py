"""Worker processes that are killed, hang, or raise."""

import os
import signal
import subprocess
import sys
import threading
import time
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.journal import Journal, JournalEntry
from ertis_numba.network.processing import ProcessingOptions
from ertis_numba.network.processing.dead_letter_queue import DeadLetterQueue
from ertis_numba.network.processing.parallelism import Choice, Load, Mode
from ertis_numba.network.processing.pipe_messages import Release
from ertis_numba.network.processing.runner import JobKind, Lost
from ertis_numba.network.processing.sensors import Sensors
from tests.driven import ANY, MEASUREMENT, SHORT, Lines, data, driven, hello

TIMEOUT_S = 60.0


def stop_and_offer(loop, sensor):
    """Stop a worker within its measurement; return its process."""
    loop.until(lambda: loop.workers("idle"))
    (worker,) = loop.workers("idle")
    os.kill(worker.pid, signal.SIGSTOP)
    loop.offer(sensor)
    loop.until(lambda: loop.workers("busy"))
    return worker.pid


def is_gone(pid):
    """Return True if a process has ended, even if it was not waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_measurement_of_a_killed_worker_is_retried(loop):
    loop.processing.register(hello("retried"), SHORT)
    before = loop.processing.status()
    pid = stop_and_offer(loop, "retried")
    os.kill(pid, signal.SIGKILL)
    loop.settle()
    counts, status = loop.processing.counts("retried"), loop.processing.status()
    assert (counts.received, counts.published, counts.dropped) == (1, 1, {})
    assert (status.respawned, status.retried) == (before.respawned + 1, before.retried + 1)
    assert status.quarantined == before.quarantined
    assert status.workers[0].pid != pid
    ((_, about),) = [line for line in loop.lines if line[0] == "retried"]
    assert (about["sensor"], about["session_id"], about["sequence"]) == ("retried", 7, 0)


def test_idle_worker_killed_loses_nothing(loop):
    loop.processing.register(hello("idle"), SHORT)
    for _ in range(2):
        loop.until(lambda: loop.workers("idle"))
        loop.offer("idle")
        loop.settle()
        os.kill(loop.workers("idle")[0].pid, signal.SIGKILL)
        respawned = loop.processing.status().respawned
        loop.until(lambda before=respawned: loop.processing.status().respawned > before)
    counts = loop.processing.counts("idle")
    assert (counts.received, counts.published) == (2, 2)


def test_measurement_that_hangs_two_workers_is_quarantined(tmp_path, monkeypatch):
    with driven(deadline_s=0.2, workers=2, quarantine=tmp_path) as loop:
        loop.processing.register(hello(), SHORT)
        loop.until(lambda: len(loop.workers("idle")) == 2)
        for worker in loop.workers("idle"):
            os.kill(worker.pid, signal.SIGSTOP)
        loop.offer()
        loop.settle()
        counts, status = loop.processing.counts("front"), loop.processing.status()
        assert (counts.published, counts.dropped) == (0, {"failed twice": 1})
        assert (status.respawned, status.retried, status.quarantined) == (2, 1, 1)
        runner = loop.processing._runner  # noqa: SLF001  a busy machine may need longer than 0.2 s
        monkeypatch.setattr(runner, "_options", replace(runner._options, deadline_s=TIMEOUT_S))  # noqa: SLF001
        loop.offer()  # the sensor goes on
        loop.settle()
        assert counts.published == 1
    (path,) = tmp_path.glob("quarantine_*.h5.journal")
    with Journal.open(path) as journal:
        (entry,) = journal.entries()
    assert np.array_equal(entry.measurement.data, MEASUREMENT.data)
    assert entry.measurement.stamp.sequence == 0


def test_failing_sensor_is_suspended_and_others_continue(loop, monkeypatch):
    monkeypatch.setattr("ertis_numba.network.processing.queues._PAUSE_S", 1000.0)
    for sensor in ("bad", "good"):
        loop.processing.register(hello(sensor), SHORT)
    loop.until(lambda: loop.workers("idle"))
    loop.processing.drain_dropped()
    runner = loop.processing._runner  # noqa: SLF001  to have measurements fail
    with monkeypatch.context() as patch:
        patch.setattr(runner, "submit", lambda job: failed.append(Lost(job, "it hangs", again=True)))
        failed = []
        for _ in range(3):
            loop.offer("bad")
            loop.step()
            for _ in range(2):
                loop.processing._handle([failed.pop()])  # noqa: SLF001
                loop.processing._dispatch()  # noqa: SLF001
    counts = loop.processing.counts("bad")
    assert counts.dropped == {"failed twice": 3}
    loop.offer("bad")
    assert counts.dropped["sensor suspended after repeated failures"] == 1
    reported = loop.processing.drain_dropped()
    assert reported == [("bad", 7, number, "failed twice") for number in range(3)] + [
        ("bad", 7, 3, "sensor suspended after repeated failures")
    ]
    assert loop.processing.drain_dropped() == []
    loop.offer("good")
    loop.settle()
    assert loop.processing.counts("good").published == 1
    failing = loop.processing._circuit_breaker._failing["bad"]  # noqa: SLF001
    assert failing.until_s - time.monotonic() == pytest.approx(1000.0, abs=TIMEOUT_S)
    failing.until_s -= 1000.0  # as if its pause were over
    loop.until(lambda: loop.offer("bad") or counts.published)


def test_quarantine_is_bounded(tmp_path):
    log = Lines("processing")
    quarantine = DeadLetterQueue(tmp_path, log)
    for number in range(110):
        stamp = replace(MEASUREMENT.stamp, sequence=number)
        quarantine.put(JournalEntry(replace(MEASUREMENT, stamp=stamp), 0, zlib.crc32(MEASUREMENT.data.tobytes())))
        while quarantine._waiting.qsize() > 8:  # noqa: SLF001
            os.sched_yield()
    quarantine.close()
    (path,) = tmp_path.glob("quarantine_*.h5.journal")
    with Journal.open(path) as journal:
        assert len(list(journal.entries())) == 100
    assert (
        sum("100 measurements are kept already" in fields["text"] for event, fields in log.lines if event == "not_kept")
        == 10
    )


def test_quarantine_closes_without_its_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("ertis_numba.network.processing.dead_letter_queue._CLOSED_S", 0.05)
    answers = threading.Event()
    monkeypatch.setattr(DeadLetterQueue, "_write", lambda *_: answers.wait(TIMEOUT_S))
    quarantine = DeadLetterQueue(tmp_path, Lines("processing"))
    for _ in range(20):  # more than may wait
        quarantine.put(JournalEntry(MEASUREMENT, 0, 0))
    quarantine.close()
    assert quarantine._thread.is_alive()  # noqa: SLF001
    answers.set()


def test_released_kind_is_released_in_a_preparing_worker(loop, monkeypatch):
    loop.processing.register(hello(), SHORT)
    loop.until(lambda: loop.workers("idle"))
    runner = loop.processing._runner  # noqa: SLF001
    (worker,) = runner._workers  # noqa: SLF001
    sent = []
    pipe, send = worker.child.pipe, worker.child.pipe.send
    monkeypatch.setattr(pipe, "send", lambda note, **files: (sent.append(note), send(note, **files)))
    kind = JobKind(99, SHORT.replace(air=SHORT.air.replace(temperature_c=3.0)).to_toml(), MEASUREMENT.data.nbytes)
    runner.prepare(kind)
    runner.forget(kind)
    loop.until(lambda: loop.workers("idle"))
    of_kind = [type(note).__name__ for note in sent if note.kind == kind.number]  # others may still get images
    assert of_kind == ["Prepare", "Release"]
    assert 99 not in worker.kinds


def test_slowly_dying_worker_delays_nothing(loop, monkeypatch):
    loop.processing.register(hello("slowly"), SHORT)
    loop.until(lambda: loop.workers("idle"))
    (worker,) = loop.processing._runner._workers  # noqa: SLF001  to have it seem to end slowly
    child = worker.child
    monkeypatch.setattr(type(child), "ended", property(lambda _: False))
    monkeypatch.setattr(child, "close", lambda *_: pytest.fail("it is waited for"))
    os.kill(child.pid, signal.SIGKILL)
    loop.until(lambda: worker.state == "starting")
    assert child.pipe.fileno() not in loop.processing.fds()
    loop.offer("slowly")
    monkeypatch.undo()
    loop.settle()
    assert loop.processing.counts("slowly").published == 1


class TestSensors:
    def sensors(self, **options):
        described, kinds, log = [], [], Lines("processing")
        notify = lambda *about: described.append(about)  # noqa: E731
        made = Sensors(ProcessingOptions(publish=ANY, **options), log, describe=notify, prepare=kinds.append)
        return made, kinds, log

    def test_slow_changes_of_air_keep_the_pipeline(self):
        sensors, kinds, _ = self.sensors()
        sensors.register(hello(), SHORT)
        first = SHORT.air.temperature_c
        for number in range(1000):
            sensors.kind_of(data(temperature_c=first + number / 500))
            assert abs(sensors["front"].settings.air.temperature_c - first - number / 500) <= 0.5
        assert len(kinds) <= 5
        sensors.register(hello(), SHORT)  # it connects again
        sensors.kind_of(data(temperature_c=first + 2))
        assert len(kinds) <= 5
        assert sensors.kind_of(data(humidity_percent=float("nan"))) is None

    def test_oversized_images_are_refused_in_advance(self):
        sensors, kinds, log = self.sensors()
        wide = SHORT.processing.replace(directions="3d:1000000", range_m=(0.4, 1.4))
        sensors.register(hello(), SHORT.replace(processing=wide))
        assert sensors.kind_of(data()) is None
        assert kinds == []
        ((event, fields),) = log.lines
        assert (event, "the limit is 256 MB" in fields["text"]) == ("unusable", True)
        sensors.register(hello("good"), SHORT.replace(processing=SHORT.processing.replace(directions="3000")))
        assert len(kinds) == 1

    def test_failed_pipeline_is_retried_later(self, monkeypatch):
        sensors, kinds, _ = self.sensors()
        now_s = time.monotonic()
        sensors.register(hello(), SHORT)
        kind = sensors.kind_of(data())
        for after_s in (70.0, 140.0):
            sensors.failed(kind.number, "no memory")
            sensors.tick()
            assert sensors.kind_of(data()) is None
            monkeypatch.setattr(time, "monotonic", lambda after_s=after_s: now_s + after_s)
            sensors.tick()
            assert sensors.kind_of(data()) is kind
        sensors.failed(kind.number, "no memory")
        sensors.register(hello(), SHORT)
        assert sensors.kind_of(data()) is None
        monkeypatch.setattr(time, "monotonic", lambda: now_s + 151.0)
        sensors.register(hello(), SHORT)
        assert kinds == [kind] * 4


def test_measurement_of_the_wrong_size_is_dropped(loop):
    loop.processing.register(hello("wrong"), SHORT)
    before = loop.processing.status()
    loop.offer("wrong", words=MEASUREMENT.data[:-1])
    loop.offer("wrong")
    loop.settle()
    counts, status = loop.processing.counts("wrong"), loop.processing.status()
    assert (counts.published, counts.dropped) == (1, {"it cannot be processed": 1})
    assert (status.respawned, status.retried) == (before.respawned, before.retried)


def test_failing_measurement_is_tried_twice(loop):
    settings = SHORT.replace(processing=SHORT.processing.replace(directions="2d:3"))  # a kind of its own
    loop.processing.register(hello("mistaken", settings), settings)
    loop.until(lambda: loop.workers("idle"))
    before, runner = loop.processing.status(), loop.processing._runner  # noqa: SLF001  to have a worker make a mistake
    kind = loop.processing._sensors["mistaken"].kind.number  # noqa: SLF001
    runner._workers[0].child.pipe.send(Release(kind=kind))  # noqa: SLF001  it has no pipeline: KeyError
    loop.offer("mistaken")
    loop.settle()
    counts, status = loop.processing.counts("mistaken"), loop.processing.status()
    assert counts.dropped == {"failed twice": 1}
    assert (status.respawned, status.retried) == (before.respawned, before.retried + 1)
    assert [fields["text"] for event, fields in loop.lines if event == "failed_twice"] == [f"KeyError: {kind}"]


def test_unusable_settings_drop_only_their_sensor(loop):
    unusable = SHORT.replace(processing=SHORT.processing.replace(range_m=(9.0, 9.5)))  # beyond the record
    loop.processing.register(hello("unusable", unusable), unusable)
    loop.processing.register(hello("usable"), SHORT)
    for _ in range(2):
        loop.offer("unusable")
        loop.offer("usable")
    loop.settle()
    loop.offer("unusable")
    assert loop.processing.counts("unusable").dropped == {"its settings cannot be used": 3}
    assert loop.processing.counts("usable").published == 2


PARENT = """
import sys
sys.path[:0] = {path!r}
from tests.driven import driven, hello, SHORT
with driven(workers=2) as loop:
    loop.processing.register(hello(), SHORT)
    loop.until(lambda: len(loop.workers("idle")) == 2)
    status = loop.processing.status()
    print(*(worker.pid for worker in status.workers), status.publisher_pid, flush=True)
    while True:
        loop.offer()
        loop.step()
"""


def test_killed_central_node_leaves_no_process():
    program = PARENT.format(path=[str(Path.cwd())])
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        pids = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(pids) == 3
        maps = [Path(f"/proc/{pid}/maps").read_text() for pid in (parent.pid, *pids)]
        os.kill(pids[0], signal.SIGSTOP)  # even one that hangs is gone when it goes on
        parent.kill()
    os.kill(pids[0], signal.SIGCONT)
    end_s = time.monotonic() + TIMEOUT_S
    while not all(map(is_gone, pids)):
        assert time.monotonic() < end_s, pids
        os.sched_yield()
    # What they shared has no name in /dev/shm, by which it could be left there.
    assert "/memfd:ertis" in maps[0]
    assert not any("/dev/shm" in text for text in maps)


def test_processing_options_are_checked(tmp_path):
    with pytest.raises(ArgumentError, match=r"quarantine folder .* does not exist"):
        ProcessingOptions(publish=ANY, quarantine=tmp_path / "missing")
    with pytest.raises(ArgumentError, match="dtype 'float64' is unknown"):
        ProcessingOptions(dtype="float64")
    with pytest.raises(ArgumentError, match=r"processing\.range_m"):
        ProcessingOptions(processing={"range_m": (2.0, 1.0)})


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this system has no timer signals")
@pytest.mark.parametrize(
    "inherited",
    ["", "signal.signal(signal.SIGALRM, signal.SIG_IGN)", "signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])"],
)
def test_hanging_worker_without_parent_ends_with_a_traceback(inherited, tmp_path):
    program = f"""
import os, signal, sys

if len(sys.argv) == 1:
    {inherited or "pass"}
    os.execv(sys.executable, [sys.executable, sys.argv[0], "child"])

from ertis_numba.network.processing.worker_process import end_after

def hang():
    while True:
        pass

end_after(60.0)
end_after(0)
end_after(0.2)
hang()
"""
    path = tmp_path / "hangs.py"
    path.write_text(program)
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == -signal.SIGALRM
    assert "in hang" in done.stderr


def arriving(choice, *, period_s, n_periods, burst=1, begin_s=0.0):
    """Let bursts arrive periodically, half a millisecond apart within each; return the number of changes."""
    load, changes = Load(), 0
    for period in range(n_periods):
        now_s = begin_s + period * period_s
        for number in range(burst):
            load.add(now_s + 0.0005 * number)
        changes += choice.update(now_s + 0.2 * period_s, load)
    return changes


class TestChoice:
    def choice(self, cores, wide_s, many_s):
        choice = Choice(cores, cores)
        choice.seed(wide_s, many_s)
        return choice

    def test_idle_machine_uses_all_cores_per_measurement(self):
        choice = self.choice(2, 0.010, 0.016)
        assert not choice.update(0.0, Load())
        assert "no load measured yet" in choice.why
        assert arriving(choice, period_s=0.02, n_periods=300, begin_s=3.0) == 0
        assert choice.mode == Mode(1, 2)
        assert "50%" in choice.why

    def test_loaded_machine_processes_several_at_once(self):
        choice = self.choice(2, 0.010, 0.016)
        assert arriving(choice, period_s=1 / 90, n_periods=2000) == 1
        assert choice.mode == Mode(2, 1)
        assert arriving(choice, period_s=0.1, n_periods=10, begin_s=22.3) == 0  # It is too early to choose again.
        assert arriving(choice, period_s=0.1, n_periods=300, begin_s=30.0) == 1
        assert choice.mode == Mode(1, 2)

    def test_all_cores_per_measurement_if_parallel_jobs_are_slower(self):
        choice = self.choice(2, 0.010, 0.030)
        assert arriving(choice, period_s=0.005, n_periods=4000) == 0
        assert choice.mode == Mode(1, 2)

    def test_recent_job_times_weigh_more(self):
        choice = self.choice(2, 0.010, 0.016)
        for _ in range(8):
            choice.took(Mode(1, 2), 0.020)
        choice.took(Mode(7, 7), 0.001)  # A job that began before the number of workers changed.
        assert arriving(choice, period_s=1 / 45, n_periods=200)

    @pytest.mark.parametrize(
        ("cores", "wide_s", "many_s", "burst", "expected"),
        [
            (2, 0.010, 0.016, 1, Mode(1, 2)),
            (2, 0.010, 0.016, 2, Mode(2, 1)),
            (2, 0.010, 0.016, 4, Mode(2, 1)),
            (4, 0.010, 0.030, 2, Mode(2, 2)),
            (4, 0.010, 0.030, 4, Mode(4, 1)),
            (8, 0.010, 0.060, 2, Mode(1, 8)),
            (8, 0.010, 0.060, 4, Mode(4, 2)),
            (8, 0.010, 0.060, 16, Mode(8, 1)),
            (16, 0.006, 0.060, 2, Mode(2, 8)),
            (16, 0.006, 0.060, 4, Mode(4, 4)),
            (16, 0.006, 0.060, 8, Mode(8, 2)),
        ],
    )
    def test_simultaneous_measurements_share_the_cores_if_the_last_image_comes_sooner(
        self, cores, wide_s, many_s, burst, expected
    ):
        choice = self.choice(cores, wide_s, many_s)
        changes = arriving(choice, period_s=0.5, n_periods=100, burst=burst)
        assert (choice.mode, changes) == (expected, int(expected.at_once > 1))
        rounds = -(-burst // choice.mode.at_once)
        share = (1 / choice.mode.threads - 1 / cores) / (1 - 1 / cores)
        assert rounds * (wide_s + share * (many_s - wide_s)) <= burst * wide_s  # Never slower than one at a time.
        assert choice.why.startswith(f"{choice.mode}: ")
        arriving(choice, period_s=0.5, n_periods=200, begin_s=60.0)
        assert choice.mode == Mode(1, cores)  # The bursts have ended.

    @pytest.mark.parametrize("busy", [0.2, 0.45, 0.5, 0.55, 0.6, 0.75, 0.9])
    @pytest.mark.parametrize(("cores", "many_s"), [(2, 0.016), (4, 0.030), (8, 0.060), (16, 0.100)])
    def test_independent_sensors_change_the_mode_rarely(self, cores, many_s, busy):
        rng, load, choice = np.random.default_rng(3), Load(), self.choice(cores, 0.010, many_s)
        changes, now_s = 0, 0.0
        while now_s < 600.0:
            now_s += rng.exponential(0.010 / busy)
            load.add(now_s)
            changes += choice.update(now_s, load)
        assert changes <= 3

    def test_jobs_that_take_longer_than_predicted_end_a_mode(self):
        choice = self.choice(4, 0.010, 0.030)
        assert arriving(choice, period_s=0.5, n_periods=20, burst=2) == 1
        assert choice.mode == Mode(2, 2)
        choice.took(Mode(2, 2), 0.030)
        assert arriving(choice, period_s=0.5, n_periods=200, burst=2, begin_s=20.0) == 1
        assert choice.mode == Mode(1, 4)

    def test_load_forgets_arrivals_that_nobody_reads(self):
        load = Load()
        for number in range(10_000):
            load.add(0.01 * number)
        rate_hz, arrivals_s = load.recent(100.0)
        assert rate_hz == pytest.approx(100.0, abs=1.0)
        assert len(load._arrivals_s) == len(arrivals_s) <= 301  # noqa: SLF001

    def test_number_of_workers_bounds_the_measurements_at_once(self):
        assert [mode.at_once for mode in Choice(6, 12).modes] == [1, 2, 4, 6]
        assert [mode.threads for mode in Choice(6, 12).modes] == [12, 6, 3, 2]

    def test_single_worker_uses_all_cores(self):
        choice = Choice(1, 4)
        choice.seed(0.010, 0.010)
        assert arriving(choice, period_s=0.001, n_periods=5000) == 0
        assert choice.mode == Mode(1, 4)
        assert "the only mode" in choice.why

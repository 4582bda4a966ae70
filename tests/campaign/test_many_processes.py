"""Local worker processes: identical output, single failures, and their end with the campaign."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from ertis_numba.base.errors import DeviceError
from ertis_numba.campaign import Campaign, CampaignOptions, RecordingProgress, find_recordings, process_pool
from ertis_numba.campaign.process_pool import ProcessPool
from ertis_numba.campaign.tasks import Task
from ertis_numba.storage import open_energyscapes, write_recording
from tests.campaigns import ended, names_in, outcomes, run_here, write_recordings
from tests.files import line, noise

PATIENCE_S = 60.0
LONG = 60  # measurements; without compiled kernels, a recording of so many takes a while to process
FEW_MICS = line(8, 8)


def narrow(settings):
    return settings.replace(processing=settings.processing.replace(range_m=(0.5, 0.8), directions="2d:300"))


SLOW = CampaignOptions(settings=narrow, batch=1, device="numpy")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return a folder of recordings, which tests only read; processing of b takes a while."""
    folder = tmp_path_factory.mktemp("recorded") / "runs"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        write_recordings(folder, settings=FEW_MICS)
        write_recording(folder / "b.h5", noise(FEW_MICS, count=LONG, seed=1), overwrite=True)
        yield folder


@pytest.fixture(scope="module")
def made_here(runs, tmp_path_factory):
    """Return the contents of output files by name, written without worker processes."""
    out = tmp_path_factory.mktemp("made_here")
    with pytest.MonkeyPatch.context() as patch:
        run_here(patch, [runs], out, SLOW)
    return contents(out)


@pytest.fixture(scope="module")
def pools():
    """Return the process pools that tests of this module share, as workers start slowly; the last may be open."""
    started = []
    yield started
    for each in started:
        each.close()


@pytest.fixture
def pool(pools, monkeypatch):
    """Let campaigns use one process pool of two workers, which stays open at their end."""
    if not pools or not pools[-1].current_paths:
        pools.append(ProcessPool(2))
    kept = pools[-1]
    with monkeypatch.context() as patch:
        patch.setattr(kept, "close", lambda: None)
        patch.setattr(Campaign, "_pool", lambda _: kept)
        yield kept


def contents(folder):
    return {item.name: item.read_bytes() for item in folder.iterdir()}


def gone(pid):
    """Wait for a process to end, and return ``True`` once it has; zombies count as ended."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.02)
    return False


@pytest.mark.usefixtures("pool")
def test_bits_are_independent_of_the_workers(runs, tmp_path, monkeypatch):
    wanted = CampaignOptions(settings=narrow, batch=2)
    run_here(monkeypatch, [runs], tmp_path / "here", wanted)
    found = ended(Campaign(find_recordings([runs]), tmp_path / "out", wanted).run())
    assert outcomes(found) == dict.fromkeys(["a.h5", "b.h5", "c.h5", "d.h5"], "made")
    assert contents(tmp_path / "out") == contents(tmp_path / "here")


def test_dying_worker_fails_one_recording(runs, made_here, tmp_path, pool):
    out, killed, found = tmp_path / "out", [], {}
    for event in Campaign(find_recordings([runs]), out, SLOW).run():
        if isinstance(event, RecordingProgress) and event.recording.name == "b.h5" and not killed:
            (pid,) = [pid for pid, path in pool.current_paths.items() if path.endswith("b.h5")]
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)
        found |= ended([event])
    assert killed
    assert outcomes(found) == {"a.h5": "made", "b.h5": "failed", "c.h5": "made", "d.h5": "made"}
    assert f"{runs / 'b.h5'}: its worker process was ended by SIGKILL" in found["b.h5"].error
    assert contents(out) == {name: content for name, content in made_here.items() if name != "b.energy.h5"}


def test_close_ends_all_work_at_once(runs, tmp_path, pool, monkeypatch):
    """Close must not wait for the current tasks: stopped processes never complete theirs."""
    monkeypatch.setattr(pool, "close", partial(ProcessPool.close, pool))
    events = Campaign(find_recordings([runs]), tmp_path / "out", SLOW).run()
    next(event for event in events if isinstance(event, RecordingProgress))
    pids = list(pool.current_paths)
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    events.close()
    assert len(pids) == 2
    assert all(gone(pid) for pid in pids)
    assert not [name for name in names_in(tmp_path / "out") if name.endswith(".part")]


def test_idle_worker_that_dies_is_replaced():
    pool = ProcessPool(1)
    try:
        (pid,) = pool.current_paths
        os.kill(pid, signal.SIGKILL)
        assert gone(pid)
        pool.submit(Task(7, "look", {"path": "none.h5", "named": True, "sensor": None}))
        news = []
        while not (news and news[-1].result):
            news += pool.wait(PATIENCE_S)
        assert "none.h5: No such file" in news[-1].result["error"]
    finally:
        pool.close()


def test_number_of_workers_can_be_reduced():
    """The numbers of tasks in progress and of processes only fall, until both reach the new size."""
    pool, numbers, in_hand, seen = ProcessPool(4), iter(range(12)), set(), []
    try:

        def feed():
            while pool.free > 0 and (number := next(numbers, None)) is not None:
                pool.submit(Task(number, "look", {"path": "none.h5", "named": True, "sensor": None}))
                in_hand.add(number)
            return len(in_hand)

        assert feed() == 4
        pool.limit(2)  # all workers are busy
        assert pool.free == 0
        while feed():
            seen.append((len(in_hand), len(pool.current_paths)))
            in_hand -= {news.number for news in pool.wait(PATIENCE_S) if news.result is not None}
        assert next(numbers, None) is None
        assert seen == sorted(seen, reverse=True)
        assert seen[0] == (4, 4)
        assert (2, 2) in seen
        assert max(processes for given, processes in seen if given <= 2) == 2
        pids = list(pool.current_paths)
        assert len(pids) == 2
        pool.limit(1)  # all workers are idle
        assert (pool.size, pool.free, list(pool.current_paths)) == (1, 1, pids[:1])
        assert gone(pids[1])
    finally:
        pool.close()


def test_workers_that_cannot_start_are_reported(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(process_pool, "_MODULE", "ertis_numba.no_such_module")
    with pytest.raises(
        DeviceError,
        match=r"worker processes end at once: the last one ended with 1, printing '.*no_such_module",
    ):
        list(Campaign(find_recordings([runs]), tmp_path / "out", workers=1).run())


def command(runs, out):
    return [
        *(sys.executable, "-m", "ertis_cli", "process", str(runs / "*.h5"), "-o", str(out), "--workers", "2"),
        *("--range", "0.5:0.8", "--directions", "2d:300", "--device", "numpy"),
    ]


def started(runs, out):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen(
        command(runs, out), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def children_of(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def until_a_part_grows(out):
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        if out.is_dir() and any(item.suffix == ".part" and item.stat().st_size > 50_000 for item in out.iterdir()):
            return
        time.sleep(0.02)
    pytest.fail("nothing was begun")


def test_kill_leaves_no_partial_file_and_the_next_run_completes(runs, made_here, tmp_path, monkeypatch):
    wanted, out = made_here, tmp_path / "out"
    with started(runs, out) as process:
        until_a_part_grows(out)
        workers = children_of(process.pid)
        process.kill()
    assert len(workers) == 2
    assert all(gone(pid) for pid in workers)
    left = contents(out)
    assert {name: content for name, content in left.items() if wanted.get(name) != content} == {}
    assert set(left) < set(wanted)
    found, _ = run_here(monkeypatch, [runs], out, SLOW)
    assert contents(out) == wanted
    assert sorted(outcomes(found).values()) == sorted(["kept"] * len(left) + ["made"] * (4 - len(left)))


def test_ctrl_c_ends_all_workers(runs, tmp_path):
    out = tmp_path / "out"
    with started(runs, out) as process:
        until_a_part_grows(out)
        workers = children_of(process.pid)
        for pid in workers:  # stopped workers never complete their tasks
            os.kill(pid, signal.SIGSTOP)
        process.send_signal(signal.SIGINT)
        _, stated = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert stated.splitlines()[-1] == "ertis: error: interrupted"
    assert len(workers) == 2
    assert all(gone(pid) for pid in workers)
    for name in names_in(out):
        with open_energyscapes(out / name) as images:
            assert len(images) in {3, LONG}

"""Campaigns on a local dask cluster write the same files as without one."""

import logging
import os
import re
import signal
import time

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import NetworkError
from ertis_numba.campaign import (
    Campaign,
    CampaignOptions,
    RecordingProgress,
    RecordingStarted,
    dask_workers,
    find_recordings,
)
from ertis_numba.campaign.tasks import Task
from ertis_numba.processes import cluster
from ertis_numba.storage import open_energyscapes, write_recording
from tests.analysis.test_call_match import CALL, REVERSED, heard
from tests.campaigns import ended, names_in, outcomes, run_here, write_recordings
from tests.dask_clusters import client_of, cluster_of_threads
from tests.files import line, noise
from tests.pages import path_of

FEW_MICS = line(8, 8)
LONG = 10  # measurements; without compiled kernels, such a recording takes a while to process
PATIENCE_S = 60.0


def narrow(settings):
    return settings.replace(processing=settings.processing.replace(range_m=(0.5, 0.8), directions="2d:300"))


WANTED = CampaignOptions(settings=narrow, batch=1)
SLOW = CampaignOptions(settings=narrow, batch=1, device="numpy")


@pytest.fixture(scope="module", autouse=True)
def _same_date():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        yield


@pytest.fixture(scope="module")
def scheduler(_same_date):
    """Return the address of a scheduler of two workers in this process."""
    with cluster_of_threads(2) as address:
        yield address


@pytest.fixture(scope="module")
def process_scheduler(_same_date):
    """Return the address of a scheduler of one worker in its own process, which is slow to start."""
    with cluster.local_cluster(1) as address:
        yield address


@pytest.fixture
def runs(tmp_path):
    write_recordings(tmp_path / "runs", ("a", "b", "c"), count=2, settings=FEW_MICS)  # b in other air
    return tmp_path / "runs"


@pytest.fixture
def long_runs(runs):
    write_recording(runs / "b.h5", noise(FEW_MICS, count=LONG, seed=1), overwrite=True)
    return runs


def test_cluster_files_equal_local_files(process_scheduler, scheduler, runs, tmp_path, monkeypatch):
    run_here(monkeypatch, [runs], tmp_path / "here", SLOW)
    (runs / "broken.h5").write_bytes(b"broken")
    monkeypatch.chdir(tmp_path)  # the worker has another current folder
    events = list(Campaign(find_recordings(["runs"]), "out", SLOW, workers=process_scheduler).run())
    found = ended(events)
    assert outcomes(found) == {**dict.fromkeys(["a.h5", "b.h5", "c.h5"], "made"), "broken.h5": "failed"}
    assert "broken.h5 is not an HDF5 file" in found["broken.h5"].error
    assert names_in(tmp_path / "out") == names_in(tmp_path / "here")
    here, there = ({item.name: item.read_bytes() for item in (tmp_path / name).iterdir()} for name in ("here", "out"))
    assert [name for name in here if here[name] != there[name]] == []
    again = ended(Campaign(find_recordings(["runs"]), "out", SLOW, workers=process_scheduler).run())
    assert set(outcomes(again).values()) == {"kept", "failed"}
    ended(Campaign(find_recordings(["runs"]), "both", SLOW, workers=scheduler).run())
    assert [name for name in here if here[name] != (tmp_path / "both" / name).read_bytes()] == []


def test_cluster_workers_report_recordings_with_another_call(scheduler, tmp_path):
    (tmp_path / "runs").mkdir()
    for name, call in {"same": CALL, "other": REVERSED}.items():
        write_recording(tmp_path / "runs" / f"{name}.h5", [heard(call)])
    found = ended(list(Campaign(find_recordings([tmp_path / "runs"]), tmp_path / "out", workers=scheduler).run()))
    with open_energyscapes(tmp_path / "out" / "other.energy.h5") as images:
        assert images.call_warning
        assert sum(images.call_warning in each for each in found["other.h5"].made["warnings"]) == 1
    assert not any("call" in each for each in found["same.h5"].made["warnings"])


def test_progress_is_reported_and_close_ends_the_work(scheduler, long_runs, tmp_path, monkeypatch):
    monkeypatch.setattr(dask_workers, "_REPORT_INTERVAL_S", 0.0)
    out = tmp_path / "out"
    events = Campaign(find_recordings([long_runs / "b.h5"]), out, SLOW, workers=scheduler).run()
    kinds = []
    for event in events:
        kinds.append(type(event))
        if isinstance(event, RecordingProgress):
            break
    events.close()
    assert kinds[0] is RecordingStarted
    assert kinds[-1] is RecordingProgress
    with client_of(scheduler) as client:
        end_s = time.monotonic() + PATIENCE_S
        while any(client.call_stack().values()) and time.monotonic() < end_s:
            time.sleep(0.05)
    assert names_in(out) == []


def test_killed_dask_workers_lose_nothing(process_scheduler, long_runs, tmp_path):
    scheduler, out = process_scheduler, tmp_path / "out"
    found = {}
    with client_of(scheduler) as client:
        pids = client.run(os.getpid)
        for event in Campaign(find_recordings([long_runs]), out, SLOW, workers=scheduler).run():
            if isinstance(event, RecordingStarted) and event.measurements == LONG:
                for pid in pids.values():
                    os.kill(pid, signal.SIGKILL)
            found |= ended([event])
    assert set(outcomes(found).values()) == {"made"}
    assert names_in(out) == [f"{name}.energy.h5" for name in "abc"]


@pytest.mark.usefixtures("runs")
def test_cluster_command_of_the_page_runs(scheduler, tmp_path, monkeypatch):
    page = path_of("many").read_text("utf-8")
    (line,) = re.findall(r"\$ ertis (.* --workers tcp.*)", page)
    monkeypatch.chdir(tmp_path)
    words = line.replace("'", "").replace("tcp://127.0.0.1:8786", scheduler).split()
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 0, done.output
    assert names_in(tmp_path / "images") == [f"{name}.energy.h5" for name in "abc"]


def test_other_versions_of_workers_are_reported(monkeypatch):
    class Elsewhere:
        address = "tcp://far:1"

    monkeypatch.setattr(cluster, "current_worker", Elsewhere)
    reported = dask_workers.run_on_dask_worker("look", {"versions": {"numpy": "0.1"}}, "topic", 1)
    assert "worker tcp://far:1 has numpy " in reported["error"]
    assert "not 0.1; install the same version everywhere" in reported["error"]


class Dwindling:
    """Client of a cluster that loses a worker at each count and never completes a task."""

    status = "running"

    def __init__(self):
        self.workers = 4

    def nthreads(self):
        self.workers -= 1
        return dict.fromkeys(range(self.workers), 1)

    def subscribe_topic(self, *_):
        pass

    def submit(self, *_, **__):
        return self

    def add_done_callback(self, _):
        pass

    def cancel(self, *_, **__):
        pass

    def close(self, **_):
        pass


def test_lost_worker_does_not_count_as_free(monkeypatch):
    monkeypatch.setattr(cluster, "connect", lambda *_, **__: Dwindling())
    monkeypatch.setattr(cluster, "require_workers", lambda *_, **__: None)
    monkeypatch.setattr(dask_workers, "_POLL_INTERVAL_S", 0.0)
    pool = dask_workers.DaskWorkerPool("tcp://far:1")
    for number in range(pool.free):
        pool.submit(Task(number, "look", {}))
    assert (pool.size, pool.free) == (3, 0)
    pool.wait(0.0)
    assert (pool.size, pool.free) == (2, 0)


def test_dask_is_silent_while_a_campaign_runs(monkeypatch):
    monkeypatch.setattr(cluster, "connect", lambda *_, **__: Dwindling())
    monkeypatch.setattr(cluster, "require_workers", lambda *_, **__: None)
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client", "distributed.core")]
    pool = dask_workers.DaskWorkerPool("tcp://far:1")
    assert not any(logger.isEnabledFor(logging.CRITICAL) for logger in loggers)
    pool.close()
    assert all(logger.isEnabledFor(logging.CRITICAL) for logger in loggers)


def test_missing_scheduler_is_reported(monkeypatch, runs, tmp_path):
    monkeypatch.setattr(dask_workers, "_CONNECT_S", 0.5)
    with pytest.raises(NetworkError, match=r"no dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(Campaign(find_recordings([runs]), tmp_path / "out", workers="tcp://127.0.0.1:9").run())


def test_missing_workers_are_reported(monkeypatch, runs, tmp_path):
    require = cluster.require_workers
    monkeypatch.setattr(cluster, "require_workers", lambda *given, **_: require(*given, timeout_s=0.1))
    with (
        cluster_of_threads(0) as address,
        pytest.raises(NetworkError, match=r"has no workers; start some with 'dask worker tcp://"),
    ):
        list(Campaign(find_recordings([runs]), tmp_path / "out", workers=address).run())


def test_lost_scheduler_is_reported(runs, tmp_path):
    with cluster_of_threads(1) as address:
        events = Campaign(find_recordings([runs]), tmp_path / "out", WANTED, workers=address).run()
        next(events)  # From here on, the campaign submits no task until the next event is requested.
    with pytest.raises(NetworkError, match=r"is gone; finished output stays"):
        list(events)

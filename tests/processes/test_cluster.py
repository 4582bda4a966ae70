"""Jobs on a real dask cluster on this machine, through the interface that local workers share."""

import gc
import os
import select
import signal
import socket
import time
from pathlib import Path

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.network.messages import Data
from ertis_numba.network.processing.cluster import Cluster
from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.parallelism import Load
from ertis_numba.network.processing.runner import FinishedJob, Job, JobKind, KindFailed, KindReady, Lost
from ertis_numba.processes.cluster import connect, local_cluster
from tests.dask_clusters import cluster_of_threads
from tests.driven import MEASUREMENT

RECORDING = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
LONG_S = 200.0


@pytest.fixture(scope="module")
def measurement():
    with ertis.open_recording(RECORDING) as recording:
        yield recording[0]


@pytest.fixture(scope="module")
def scheduler():
    with cluster_of_threads(2) as address:
        yield address


@pytest.fixture
def cluster(scheduler):
    runner = Cluster(ProcessingOptions(workers=scheduler, deadline_s=LONG_S), lambda _: None)
    yield runner
    runner.close()


def events_of(runner, count=1):
    found, end_s = [], time.monotonic() + LONG_S
    while len(found) < count and time.monotonic() < end_s:
        for fd in select.select(list(runner.fds()), [], [], 0.1)[0]:
            found += runner.ready(fd)
        found += runner.tick(time.monotonic(), Load())
    assert len(found) >= count, "the cluster took longer than 200 s"
    return found


def submit_when_possible(runner, job):
    """Submit a job as soon as a worker can accept it."""
    end_s = time.monotonic() + LONG_S
    while not runner.takes(job.kind) and time.monotonic() < end_s:
        assert not runner.tick(time.monotonic(), Load())
        time.sleep(0.01)
    runner.submit(job)


def get_all_ready(runner, n_workers, kind):
    """Wait until a kind is ready on some workers, because a cluster accepts jobs as soon as one worker is ready."""
    end_s = time.monotonic() + LONG_S
    members = runner._members  # noqa: SLF001
    while sum(kind.number in each.ready for each in members.values()) < n_workers:
        assert time.monotonic() < end_s, "workers took longer than 200 s"
        assert not runner.tick(time.monotonic(), Load())
        time.sleep(0.01)


def kind_of(measurement, number=0, settings=None):
    return JobKind(number, (settings or measurement.settings).to_toml(), measurement.data.nbytes)


def job_of(measurement, number, kind, *, points=False):
    data = Data(
        sensor="front", session_id=1, sequence=number, sync_count=0, timestamp_ns=0, uncertainty_ns=0, monotonic_ns=0,
        temperature_c=20.0, humidity_percent=50.0, pressure_pa=101325.0, crc32=0,
    )  # fmt: skip
    return Job(number, data, measurement.data, kind, 0, points=points)


def test_cluster_images_equal_those_of_a_local_pipeline(cluster, measurement):
    kind = kind_of(measurement)
    cluster.prepare(kind)
    assert not cluster.takes(kind)
    assert isinstance(events_of(cluster)[0], KindReady)
    assert cluster.takes(kind)
    with ertis.Pipeline(measurement.settings) as pipeline:
        wanted = pipeline.process(measurement).amplitude
    jobs = [job_of(measurement, number, kind, points=number == 1) for number in range(2)]
    get_all_ready(cluster, 2, kind)
    for job in jobs:
        cluster.submit(job)
    done = events_of(cluster, 2)
    assert all(isinstance(event, FinishedJob) for event in done)
    for event in done:
        assert np.array_equal(event.job.slot.view.image_as(wanted.shape, np.float32), wanted)
        assert (event.job.n_points > 0) == event.job.points
        cluster.release(event.job.slot)
    assert sum(worker.done for worker in cluster.status()) == 2
    assert "2 workers" in cluster.choice


def test_cluster_rounds_images_to_levels(scheduler, measurement):
    runner = Cluster(ProcessingOptions(workers=scheduler, deadline_s=LONG_S, dtype="uint8"), lambda _: None)
    kind = kind_of(measurement)
    runner.prepare(kind)
    events_of(runner)
    runner.submit(job_of(measurement, 0, kind))
    (done,) = events_of(runner)
    with ertis.Pipeline(measurement.settings) as pipeline:
        wanted = pipeline.process(measurement).amplitude
    codes = done.job.slot.view.image_as(wanted.shape, np.uint8)
    assert np.array_equal(codes, done.job.levels.encode(wanted))
    runner.close()


def test_cluster_accepts_one_job_per_thread(cluster, measurement):
    kind = kind_of(measurement)
    cluster.prepare(kind)
    events_of(cluster)
    get_all_ready(cluster, 2, kind)
    for number in range(2):
        assert cluster.takes(kind)
        cluster.submit(job_of(measurement, number, kind))
    assert not cluster.takes(kind)
    with pytest.raises(AssertionError, match=r"a job was submitted that no worker can accept; call takes\(\) first"):
        cluster.submit(job_of(measurement, 2, kind))
    for event in events_of(cluster, 2):
        cluster.release(event.job.slot)
    assert cluster.takes(kind)


def test_cluster_reports_settings_a_pipeline_rejects(cluster, measurement):
    processing = measurement.settings.processing.replace(directions="no/such/grid.csv")
    cluster.prepare(kind_of(measurement, 1, measurement.settings.replace(processing=processing)))
    (event, *_) = events_of(cluster)
    assert isinstance(event, KindFailed)
    assert "grid.csv" in event.text


def test_cluster_reports_samples_of_wrong_length(cluster, measurement):
    kind = kind_of(measurement)
    cluster.prepare(kind)
    events_of(cluster)
    cluster.submit(Job(7, job_of(measurement, 7, kind).data, measurement.data[:-1], kind, 0))
    (event, *_) = events_of(cluster)
    assert isinstance(event, Lost)
    assert not event.again
    assert "bytes" in event.text


@pytest.fixture
def cluster_to_kill():
    with local_cluster(2) as address:
        runner = Cluster(ProcessingOptions(workers=address, device="numpy", deadline_s=LONG_S), lambda _: None)
        yield runner
        runner.close()


def test_cluster_recovers_jobs_of_a_killed_worker(cluster_to_kill):
    cluster, measurement = cluster_to_kill, MEASUREMENT
    kind = kind_of(measurement)
    cluster.prepare(kind)
    events_of(cluster)
    get_all_ready(cluster, 2, kind)
    for number in range(2):  # one job for each worker
        cluster.submit(job_of(measurement, number, kind))
    victim = cluster.status()[0].pid
    os.kill(victim, signal.SIGKILL)
    waiting, made = [job_of(measurement, number, kind) for number in range(2, 4)], set()
    end_s = time.monotonic() + LONG_S
    while len(made) < 4:
        assert time.monotonic() < end_s, "it took longer than 200 s"
        while waiting and cluster.takes(kind):
            cluster.submit(waiting.pop(0))
        for event in cluster.tick(time.monotonic(), Load()):
            if isinstance(event, Lost):  # as with a local worker, the caller retries
                assert event.again
                waiting.insert(0, event.job)
            else:
                made.add(event.job.number)
                cluster.release(event.job.slot)
        time.sleep(0.01)
    assert victim not in {worker.pid for worker in cluster.status()}
    assert cluster.respawned == 1
    get_all_ready(cluster, 2, kind)  # dask has started a new worker, which the cluster uses


def test_cluster_abandons_jobs_after_their_deadline(scheduler, measurement):
    stated = []
    runner = Cluster(ProcessingOptions(workers=scheduler, deadline_s=1e-6), stated.append)
    kind = kind_of(measurement)
    runner.prepare(kind)
    events_of(runner)
    submit_when_possible(runner, job_of(measurement, 0, kind))
    (event,) = events_of(runner)
    assert isinstance(event, Lost)
    assert event.again
    assert "deadline" in event.text
    assert any("gets no more jobs: it missed the deadline" in text for text in stated)
    submit_when_possible(runner, job_of(measurement, 1, kind))  # the worker is reachable again, or another accepts
    runner.close()


def test_cluster_worker_survives_an_exception_in_a_job(cluster, measurement, monkeypatch):
    kind = kind_of(measurement)
    cluster.prepare(kind)
    events_of(cluster)
    monkeypatch.setattr("ertis_numba.network.processing._cluster_worker.process", int)
    cluster.submit(job_of(measurement, 0, kind))
    (event,) = events_of(cluster)
    assert isinstance(event, Lost)
    assert event.again
    assert "TypeError" in event.text
    assert cluster.respawned == 0


def test_forgotten_job_kind_can_be_prepared_again(cluster, measurement):
    kind = kind_of(measurement)
    cluster.prepare(kind)
    cluster.forget(kind)
    cluster.prepare(kind)
    assert [type(event) for event in events_of(cluster)] == [KindReady]
    cluster.forget(kind)
    assert not cluster.takes(kind)


def test_cluster_reports_a_missing_scheduler(monkeypatch):
    monkeypatch.setattr("ertis_numba.network.processing.cluster._CONNECT_S", 0.5)
    with pytest.raises(ertis.NetworkError, match=r"no dask scheduler answers at tcp://127\.0\.0\.1:9"):
        Cluster(ProcessingOptions(workers="tcp://127.0.0.1:9"), lambda _: None)


@pytest.mark.parametrize("address", ["foo", "http://127.0.0.1:9", "silent"])
def test_connect_rejects_other_servers_and_closes_its_client(address):
    """An unclosed client would wait for an answer until the process ends, and then print an error."""
    from distributed import Client  # noqa: PLC0415 - a slow import that few tests need

    def unclosed():
        clients = {each for each in gc.get_objects() if issubclass(type(each), Client)}
        return {client for client in clients if client.status != "closed"}

    before = unclosed()
    with socket.create_server(("127.0.0.1", 0)) as silent:  # accepts connections and never answers
        name = address.replace("silent", "tcp://{}:{}".format(*silent.getsockname()))
        with pytest.raises(ertis.NetworkError, match=f"no dask scheduler answers at {name} "):
            connect(name, timeout_s=0.1)
        assert unclosed() <= before

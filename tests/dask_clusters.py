"""Dask clusters on this machine for tests."""

from contextlib import contextmanager

__all__ = ["client_of", "cluster_of_threads"]


@contextmanager
def cluster_of_threads(n_workers):
    """Yield the address of a scheduler; it and its workers run in this process.

    Workers in processes, as of `ertis_numba.processes.cluster.local_cluster`, need seconds of processor time to
    start. Use them only where the process matters, such as for tests that kill it.
    """
    from distributed import LocalCluster  # noqa: PLC0415 - a slow import that few tests need

    ways = {"dashboard_address": ":0", "worker_dashboard_address": ":0", "silence_logs": 50}
    with LocalCluster(n_workers=n_workers, threads_per_worker=1, processes=False, protocol="tcp://", **ways) as cluster:
        yield cluster.scheduler_address


def client_of(scheduler):
    """Return a client of a scheduler, which is not the client of other tests."""
    from distributed import Client  # noqa: PLC0415 - a slow import that few tests need

    return Client(scheduler, set_as_default=False)

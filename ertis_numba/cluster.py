"""A dask cluster: the only door to dask."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ertis_numba.errors import DeviceError, NetworkError

__all__ = ["Client", "Future", "connect", "local", "require_workers", "worker"]

# Its own annotations are partial.
Client = Any
Future = Any


def connect(address: str, *, timeout_s: float) -> Client:
    """Return a client of a scheduler.

    Raises
    ------
    DeviceError
        dask.distributed is not installed.
    NetworkError
        No scheduler answers.
    """
    try:
        import distributed  # noqa: PLC0415  another package, and not always there
    except ImportError as error:
        raise DeviceError(
            "a scheduler is given, and dask.distributed is not installed; run 'pip install ertis-numba[cluster]'"
        ) from error
    try:
        make: Any = distributed.Client
        return make(address, timeout=timeout_s, set_as_default=False, name="ertis")
    except (OSError, ValueError, TimeoutError) as error:
        told = " ".join(str(error).split())[:200]
        raise NetworkError(
            f"no dask scheduler answers at {address} ({told}); give the address that 'dask scheduler' has printed"
        ) from error


def require_workers(client: Client, address: str, *, timeout_s: float) -> None:
    """Wait until a scheduler has a worker.

    Raises
    ------
    NetworkError
        It has none.
    """
    try:
        client.wait_for_workers(1, timeout=timeout_s)
    except TimeoutError as error:
        raise NetworkError(
            f"the dask scheduler at {address} has no workers; start some with 'dask worker {address}'"
        ) from error


def worker() -> Any:
    """Return the worker that runs this task."""
    from distributed import get_worker  # noqa: PLC0415  there is one where this runs

    return get_worker()


@contextmanager
def local(n_workers: int, *, n_threads: int = 1) -> Iterator[str]:
    """Yield the address of a scheduler with workers on this machine, which end with the block.

    Raises
    ------
    DeviceError
        dask.distributed is not installed.
    """
    try:
        from distributed import LocalCluster  # noqa: PLC0415  as above
    except ImportError as error:
        raise DeviceError(
            "dask.distributed is not installed; run 'pip install ertis-numba[cluster]', or do without"
        ) from error
    ports = {"dashboard_address": ":0", "worker_dashboard_address": ":0"}
    make: Any = LocalCluster
    with make(n_workers=n_workers, threads_per_worker=n_threads, silence_logs=50, **ports) as cluster:
        yield str(cluster.scheduler_address)

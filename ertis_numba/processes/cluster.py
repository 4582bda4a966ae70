"""Clients and workers of a dask cluster; the only module that imports dask."""

import asyncio
import logging
import os
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final

from ertis_numba.base.errors import DeviceError, NetworkError
from ertis_numba.base.extras import extra

__all__ = [
    "Client",
    "Future",
    "RemoteError",
    "WorkerActor",
    "WorkerActors",
    "connect",
    "current_worker",
    "local_cluster",
    "require_workers",
    "silence_loggers",
]

_TIMEOUT_MARGIN_S: Final = 0.5  # after the timeout of dask, whose error names the cause
_RESTARTED_S: Final = 600.0
"""Time after which dask gives up on a lost worker; its default of 15 s is too short for a start on a busy machine."""

# The annotations of dask are partial.
Client = Any
Future = Any


@dataclass(frozen=True, slots=True)
class RemoteError:
    """Error of a function that a `WorkerActor` called, as text on one line."""

    text: str


class WorkerActor:
    """Actor in a dask worker, which its client calls directly, without the scheduler."""

    # An ordinary task needs a decision of the scheduler and two of its batches each way.

    async def call(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call a function in its own thread and return its result, or `RemoteError` if it fails."""
        try:
            return await asyncio.to_thread(function, *arguments, **options)
        except Exception as error:  # noqa: BLE001  an exception of the actor would count as a failure of the connection
            return RemoteError(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")


def connect(address: str, *, timeout_s: float) -> Client:
    """Return a client of a scheduler; raise DeviceError without dask.distributed, NetworkError without an answer."""
    with extra("cluster", "a scheduler needs dask.distributed", DeviceError):
        import distributed  # noqa: PLC0415  another package, and not always there

    class Client(distributed.Client):  # a scheduler shows this name
        """Client that respects its timeout even if the port belongs to another service, which never answers."""

        async def _start(self, *arguments: Any, **options: Any) -> Any:
            start: Any = super()._start
            try:
                return await asyncio.wait_for(start(*arguments, **options), timeout_s + _TIMEOUT_MARGIN_S)
            except BaseException:
                await self._close()  # It would wait until the process ends, and then log an error.
                raise

    try:
        make: Any = Client
        return make(address, timeout=timeout_s, set_as_default=False, name="ertis")
    except (OSError, ValueError, TimeoutError) as error:
        reported = " ".join(str(error).split())[:200] or f"no answer within {timeout_s:g} s"
        raise NetworkError(
            f"no dask scheduler answers at {address} ({reported}); choose the address that 'dask scheduler' prints"
        ) from error


@contextmanager
def silence_loggers() -> Iterator[None]:
    """Silence the loggers of dask within the block; its errors are reported otherwise."""
    import distributed  # noqa: PLC0415, F401  importing it creates its loggers and sets their levels

    names = [name for name in list(logging.root.manager.loggerDict) if name.startswith("distributed.")]
    loggers = [logger for logger in map(logging.getLogger, names) if logger.level != logging.NOTSET]
    levels = {logger: logger.level for logger in (logging.getLogger("distributed"), *loggers)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def require_workers(client: Client, address: str, *, timeout_s: float) -> None:
    """Wait until a scheduler has a worker; raise NetworkError after the timeout."""
    try:
        client.wait_for_workers(1, timeout=timeout_s)
    except TimeoutError as error:
        raise NetworkError(
            f"the dask scheduler at {address} has no workers; start some with 'dask worker {address}'"
        ) from error


class WorkerActors:
    """Actors in the workers of a scheduler, which ``client`` now calls directly; each ends with it or its reference."""

    def __init__(self, client: Client) -> None:
        client.direct_to_workers = True
        self._client = client
        self._pending: dict[str, tuple[Future, Future]] = {}

    def connected(self, addresses: Collection[str], *, timeout_s: float) -> dict[str, tuple[Any, int]]:
        """Return a new `WorkerActor` in each worker that answers within the timeout, and the number of its process."""
        # A later call waits for the others, so that a dead worker delays them by no more than the timeout.
        import distributed  # noqa: PLC0415  it is installed, since a client exists

        wait: Any = distributed.wait
        with self._client.as_current():  # which owns them
            self._pending = {address: self._pending.get(address) or self._submit(address) for address in addresses}
            with suppress(TimeoutError):
                wait([future for futures in self._pending.values() for future in futures], timeout=timeout_s)
            ended = {address: self._pending.pop(address) for address in addresses if self._has_ended(address)}
            good = {address: futures for address, futures in ended.items() if _all_finished(futures)}
            return {name: (line.result(timeout_s), int(pid.result(timeout_s))) for name, (line, pid) in good.items()}

    def _submit(self, address: str) -> tuple[Future, Future]:
        there: dict[str, Any] = {"workers": [address], "allow_other_workers": False, "pure": False}
        return self._client.submit(WorkerActor, actor=True, **there), self._client.submit(os.getpid, **there)

    def _has_ended(self, address: str) -> bool:
        return all(future.done() for future in self._pending[address])


def _all_finished(futures: tuple[Future, ...]) -> bool:
    return all(future.status == "finished" for future in futures)


def current_worker() -> Any:
    """Return the worker that runs this task."""
    from distributed import get_worker  # noqa: PLC0415  this runs in a worker

    return get_worker()


@contextmanager
def local_cluster(n_workers: int, *, n_threads: int = 1) -> Iterator[str]:
    """Yield the address of a scheduler with workers on this machine; all end with the block."""
    with extra("cluster", "a cluster on this machine needs dask.distributed", DeviceError):
        import dask  # noqa: PLC0415  as above
        from distributed import LocalCluster  # noqa: PLC0415
    ports = {"dashboard_address": ":0", "worker_dashboard_address": ":0"}
    make: Any = LocalCluster
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": _RESTARTED_S}),
        make(n_workers=n_workers, threads_per_worker=n_threads, silence_logs=50, **ports) as cluster,
    ):
        yield str(cluster.scheduler_address)

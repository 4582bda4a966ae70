"""A dask cluster: the only door to dask."""

import asyncio
import logging
import os
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final

from ertis_numba.errors import DeviceError, NetworkError
from ertis_numba.extras import extra

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

_TIMEOUT_MARGIN_S: Final = 0.5  # than dask itself gives up, which then knows why

# Its own annotations are partial.
Client = Any
Future = Any


@dataclass(frozen=True, slots=True)
class RemoteError:
    """What a function that was called at the other end of a `WorkerActor` has raised, in a line."""

    text: str


class WorkerActor:
    """The end of a line that is in a worker: an actor of dask, called by its owner without the scheduler in between.

    A task costs a scheduler's decision and two of its batches each way, and its arguments are serialised twice more.
    """

    async def call(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Return what a function returns, which is called in a thread of its own, or what it has `RemoteError`."""
        try:
            return await asyncio.to_thread(function, *arguments, **options)
        except Exception as error:  # noqa: BLE001  what is raised here is then trouble of the line itself
            return RemoteError(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")


def connect(address: str, *, timeout_s: float) -> Client:
    """Return a client of a scheduler.

    Raises
    ------
    DeviceError
        dask.distributed is not installed.
    NetworkError
        No scheduler answers.
    """
    with extra("cluster", "a scheduler needs dask.distributed", DeviceError):
        import distributed  # noqa: PLC0415  another package, and not always there

    class Client(distributed.Client):  # a scheduler shows this name
        """One that waits no longer than it may, even for a port that is no scheduler's and never answers."""

        async def _start(self, *arguments: Any, **options: Any) -> Any:
            start: Any = super()._start
            try:
                return await asyncio.wait_for(start(*arguments, **options), timeout_s + _TIMEOUT_MARGIN_S)
            except BaseException:
                await self._close()  # it would wait for an answer until the process ends, and complain
                raise

    try:
        make: Any = Client
        return make(address, timeout=timeout_s, set_as_default=False, name="ertis")
    except (OSError, ValueError, TimeoutError) as error:
        reported = " ".join(str(error).split())[:200] or f"what is there says nothing in {timeout_s:g} s"
        raise NetworkError(
            f"no dask scheduler answers at {address} ({reported}); give the address that 'dask scheduler' has printed"
        ) from error


@contextmanager
def silence_loggers() -> Iterator[None]:
    """Keep dask from printing, on its own account, what is told otherwise, until the block ends."""
    import distributed  # noqa: PLC0415, F401  its loggers are made, each with a level, when it is loaded

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


class WorkerActors:
    """Lines to the workers of a scheduler; each ends with the client, or when it is let go of.

    Parameters
    ----------
    client : Client
        Its calls go to workers directly from now on, rather than through the scheduler.
    """

    def __init__(self, client: Client) -> None:
        client.direct_to_workers = True
        self._client = client
        self._pending: dict[str, tuple[Future, Future]] = {}

    def connected(self, addresses: Collection[str], *, timeout_s: float) -> dict[str, tuple[Any, int]]:
        """Return a new `WorkerActor` to each worker that is reached by now, and the number of its process.

        Of the others those that are asked for the next time, too, go on being waited for: one that is dead, which the
        scheduler may not know yet, holds up the rest for no longer than the timeout.
        """
        import distributed  # noqa: PLC0415  it is there, as there is a client

        wait: Any = distributed.wait
        with self._client.as_current():  # whose they are
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
    from distributed import get_worker  # noqa: PLC0415  there is one where this runs

    return get_worker()


@contextmanager
def local_cluster(n_workers: int, *, n_threads: int = 1) -> Iterator[str]:
    """Yield the address of a scheduler with workers on this machine, which end with the block.

    Raises
    ------
    DeviceError
        dask.distributed is not installed.
    """
    with extra("cluster", "a cluster on this machine needs dask.distributed", DeviceError):
        from distributed import LocalCluster  # noqa: PLC0415  as above
    ports = {"dashboard_address": ":0", "worker_dashboard_address": ":0"}
    make: Any = LocalCluster
    with make(n_workers=n_workers, threads_per_worker=n_threads, silence_logs=50, **ports) as cluster:
        yield str(cluster.scheduler_address)

"""Functions that run on workers of a cluster; pipelines stay in their processes between measurements."""

import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DataError, DeviceError
from ertis_numba.frames.level_codes import LevelCodes, as_dtype
from ertis_numba.network.processing.shared_slots import POINTS_BYTES
from ertis_numba.processes.cluster import current_worker

if TYPE_CHECKING:
    from ertis_numba.chain.costs import PlanCosts
    from ertis_numba.network.processing.pipe_messages import Prepared
    from ertis_numba.network.processing.shared_pipeline import SharedPipeline

__all__ = ["ClusterResult", "prepare", "process"]

_KEPT: Final = 8  # Limit on the pipelines of a worker; the least recently used one is discarded.
_WORDS = np.dtype("<f4")

_turn = threading.Lock()
_chains: "OrderedDict[tuple[str, str, str], SharedPipeline]" = OrderedDict()


@dataclass(frozen=True, slots=True, eq=False)
class ClusterResult:
    """Result of processing a measurement."""

    image: NDArray[Any]  # (direction, range), of the dtype
    points: NDArray[np.float32]  # (point, 4), empty unless requested
    took_s: float
    worker: str  # address
    levels: LevelCodes | None = None  # of uint8


def prepare(kind: int, settings: str, device: str, plan: "PlanCosts" = "nominal") -> "Prepared | str":
    """Create the pipeline of a kind of measurements, unless it exists; return its description, or an error text."""
    try:
        chain = _chain(settings, device, plan)
        threads = _threads(device)
        took_s, _ = chain.times_s(threads, 1)
    except (ArgumentError, DataError, DeviceError, MemoryError) as error:
        return str(error) or type(error).__name__
    return chain.prepared(kind, took_s, took_s)


def process(
    settings: str,
    device: str,
    dtype: str,
    words: "bytes | memoryview",
    *,
    points: bool,
    plan: "PlanCosts" = "nominal",
) -> "ClusterResult | str":
    """Return the products of a measurement, or an error text."""
    begun_s = time.perf_counter()
    try:
        chain = _chain(settings, device, plan)
        image = chain.image(words, threads=_threads(device))
    except DataError as error:
        return str(error)
    found = chain.points(image, POINTS_BYTES // 16) if points else np.empty((0, 4), _WORDS)
    amplitude, levels = as_dtype(image.amplitude, dtype)
    return ClusterResult(amplitude, found, time.perf_counter() - begun_s, _address(), levels)


def _chain(settings: str, device: str, plan: "PlanCosts") -> "SharedPipeline":
    from ertis_numba.network.processing.shared_pipeline import SharedPipeline  # noqa: PLC0415  in processes of the cluster alone

    key = (settings, device, plan)
    with _turn:
        if key not in _chains:
            _chains[key] = SharedPipeline(settings, device, plan)
        _chains.move_to_end(key)
        while len(_chains) > _KEPT:  # A call that uses the pipeline keeps it until it ends.
            _chains.popitem(last=False)
        return _chains[key]


def _threads(device: str) -> int:
    """Return the number of threads per measurement on a worker with several at once."""
    from ertis_numba import kernels  # noqa: PLC0415

    at_once = int(current_worker().state.nthreads)
    return max(1, kernels.load(device).max_threads // max(1, at_once))


def _address() -> str:
    return str(current_worker().address)

"""Errors and times of the same image by this package and by other libraries."""

import functools
import importlib
import importlib.metadata
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench import accuracy, checks, input_measurements, machine, timing
from ertis_bench.peers import _acoular, _jax, _numpy, _ours, _torch
from ertis_bench.peers.problem import Implementation, Problem
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import Settings

__all__ = ["DIRECTIONS", "OURS", "PAPER", "PEERS", "Peer", "run"]

DIRECTIONS = (90, 1850, 3000)
OURS: Final = "ertis-numba"
PAPER: Final = "SciPy, the paper's algorithm"


@dataclass(frozen=True, slots=True)
class Peer:
    """Implementation to compare."""

    package: str
    make: Callable[[Settings], Implementation]
    max_error_db: float = checks.MAX_ERROR_DB
    is_slow: bool = False


def _textbook(make: Callable[[Problem], Implementation]) -> Callable[[Settings], Implementation]:
    return lambda settings: make(Problem.of(settings))


PEERS: dict[str, Peer] = {
    PAPER: Peer("scipy", _ours.paper, max_error_db=-15.0, is_slow=True),
    "NumPy": Peer("numpy", _textbook(_numpy.make)),
    "Acoular": Peer("acoular", _textbook(_acoular.make), is_slow=True),
    "PyTorch": Peer("torch", _textbook(_torch.make)),
    "JAX": Peer("jax", _textbook(_jax.make)),
    OURS: Peer("ertis_numba", _ours.this_package),
}
"""Implementations by name. The paper's whole-sample delays have an error of about -19 dB."""


def run(*, count: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure all installed implementations, and return a report with machine, rows and conditions."""
    measurement, source = input_measurements.measurement()
    installed = {name: peer for name, peer in PEERS.items() if importlib.util.find_spec(peer.package) is not None}
    rows: list[dict[str, Any]] = []
    with one_thread():  # as in the other comparisons with NumPy
        for n_directions in DIRECTIONS:
            settings = accuracy.comparable(measurement.settings, str(n_directions))
            rows += _measured(installed, measurement, settings, count, say)
    return {
        "machine": machine.describe(),
        "rows": rows,
        "versions": {
            name: importlib.metadata.version(peer.package) if name in installed else None
            for name, peer in PEERS.items()
        },
        "count": count,
        "slow": [name for name, peer in PEERS.items() if peer.is_slow],
        "source": source,
        "range_m": list(accuracy.RANGE_M),
        "words": measurement.settings.recording.n_samples,
    }


def _measured(
    peers: dict[str, Peer], measurement: Measurement, settings: Settings, count: int, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Return the rows of one number of directions."""
    n_directions, words = settings.processing.directions, measurement.data
    rows: list[dict[str, Any]] = []
    images: dict[str, NDArray[np.float32]] = {}
    whole: dict[str, Callable[[], NDArray[np.float32]]] = {}
    alone: dict[str, Callable[[], NDArray[np.float32]]] = {}
    for name, peer in peers.items():
        say(f"{n_directions} directions: first image of {name}")
        importlib.import_module(peer.package)  # not part of the time
        start_s = time.perf_counter()
        implementation = peer.make(settings)
        images[name] = implementation.process(words).copy()
        first_s = time.perf_counter() - start_s
        whole[name] = functools.partial(implementation.process, words)
        if implementation.prepared is not None and n_directions == str(DIRECTIONS[-1]):
            alone[name] = implementation.prepared(words)
        rows.append({"name": name, "threads": implementation.threads, "first_s": round(first_s, 3)})
    say(f"{n_directions} directions: checking the images")
    with Pipeline(settings, device="cpu", predict=False) as pipeline:
        exact = verification.exact_image(pipeline.process(measurement), measurement)
    for row in rows:
        name, max_error_db = row["name"], peers[row["name"]].max_error_db
        row["directions"] = len(images[name])
        row["error_db"] = round(_checked(name, images[name], exact, max_error_db), 1)
        if name in alone:
            _checked(name, alone[name](), exact, max_error_db)
    say(f"{n_directions} directions: timing {count} of each")
    whole_ms, alone_ms = _times(peers, whole, count), _times(peers, alone, count)
    for row in rows:
        row.update(timing.summary(whole_ms[row["name"]]))
        row["points_per_s"] = None
        if row["name"] in alone_ms:
            row["points_per_s"] = round(1e3 * exact.amplitude.size / float(np.median(alone_ms[row["name"]])))
    return rows


def _times(
    peers: dict[str, Peer], calls: dict[str, Callable[[], NDArray[np.float32]]], count: int
) -> dict[str, NDArray[np.float64]]:
    """Return the times of all calls in milliseconds."""
    found: dict[str, NDArray[np.float64]] = {}
    for is_slow, n in ((False, count), (True, max(1, count // 10))):
        some = {name: call for name, call in calls.items() if peers[name].is_slow == is_slow}
        found |= timing.round_robin(some, count=n, burst=accuracy.TURN)
    return found


def _checked(name: str, amplitude: NDArray[np.float32], exact: Energyscape, max_error_db: float) -> float:
    """Return the error of an image in dB, and refuse a wrong image."""
    error_db = verification.error_db(amplitude, exact.amplitude)
    checks.require_error(error_db, f"image of {name} in {len(amplitude)} directions", max_error_db=max_error_db)
    checks.require_same_reflector(exact.replace(amplitude=np.ascontiguousarray(amplitude)), exact)
    return error_db

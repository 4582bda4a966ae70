"""Times of the paper's three configurations, from bits to energyscape."""

import functools
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from ertis_bench import checks, input_measurements, instruction_sets, machine, timing
from ertis_numba.base.errors import DataError
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.pipeline import Pipeline

__all__ = ["BACKENDS", "DIRECTIONS", "FASTEST", "PUBLISHED_MS", "RESTRICTED", "run"]

DIRECTIONS = (90, 1850, 3000)
RANGE_M = (0.5, 5.0)

BACKENDS = {
    "scipy": {"method": "paper", "device": "numpy"},
    "paper": {"method": "paper", "device": "cpu"},
    "numpy": {"method": "fast", "device": "numpy"},
    "cpu": {"method": "fast", "device": "cpu"},
}
"""Backends by name, each with its method and device."""

RESTRICTED = ("AVX2",)
"""Older instruction sets on which the backend ``cpu`` is measured as well, if this machine has a newer one."""

FASTEST = "GPU GTX 1080 Ti"
"""Fastest machine of the paper."""

PUBLISHED_MS = {
    "CPU i7-7567U": ((132.53, 4.89), (976.33, 14.54), (1541.41, 20.30)),
    "CPU i9-7960X": ((167.13, 16.88), (1087.04, 109.72), (1653.45, 167.03)),
    "GPU Jetson TX2": ((68.40, 13.40), (585.24, 61.02), (911.47, 91.97)),
    "GPU GTX 1050": ((23.03, 2.38), (202.37, 20.85), (323.83, 33.18)),
    FASTEST: ((5.93, 0.66), (51.58, 6.38), (77.02, 7.81)),
}
"""Mean and standard deviation of 100 measurements in ms, at 90, 1850 and 3000 directions (Jansen et al., 2019)."""


def run(*, count: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure all backends, and return a report with machine, rows and conditions."""
    measurement, source = input_measurements.measurement()
    with one_thread():
        rows, errors_db = _measure(measurement, count, say)
    return {
        "machine": machine.describe(),
        "instruction_set": instruction_sets.here(),
        "rows": rows,
        "count": count,
        "source": source,
        "words": measurement.settings.recording.n_samples,
        "range_m": list(RANGE_M),
        "error_db": errors_db,
    }


def _measure(
    measurement: Measurement, count: int, say: Callable[[str], None]
) -> tuple[list[dict[str, Any]], dict[str, dict[str, float]]]:
    """Return the rows, and the errors of backends that approximate the exact image by number of directions."""
    rows: list[dict[str, Any]] = []
    errors_db: dict[str, dict[str, float]] = {}
    with ExitStack() as stack:
        names = [name for name in RESTRICTED if name in instruction_sets.lesser()]
        others = {name: stack.enter_context(_restricted(name, count)) for name in names}
        for n_directions in DIRECTIONS:
            rows += _of_directions(measurement, n_directions, count, say, errors_db)
            for name, child in others.items():
                say(f"{n_directions} directions: timing {count} with {name} only")
                row, error_db = _ask(child, n_directions)
                rows.append({"backend": f"cpu, {name}", "directions": n_directions, **row})
                errors_db[str(n_directions)][f"cpu, {name}"] = error_db
    return rows, errors_db


@contextmanager
def _restricted(name: str, count: int) -> Iterator[subprocess.Popen[str]]:
    """Run `_serve` in a process with an older instruction set."""
    with instruction_sets.start(name, ["-m", "ertis_bench.paper", str(count)]) as child:
        try:
            yield child
        finally:
            child.kill()


def _ask(child: subprocess.Popen[str], n_directions: int) -> tuple[dict[str, float], float]:
    """Return the times and the error of a process for one number of directions."""
    assert child.stdin is not None  # noqa: S101 - for the type checker
    assert child.stdout is not None  # noqa: S101
    child.stdin.write(f"{n_directions}\n")
    child.stdin.flush()
    line = child.stdout.readline()
    if not line:
        raise DataError("the process with older instructions has failed; its errors are above")
    row, error_db = json.loads(line)
    return row, error_db


def _serve(count: int) -> None:
    """Time the backend ``cpu`` for each number of directions on standard input, and print times and error."""
    measurement, _ = input_measurements.measurement()
    with one_thread():
        for line in sys.stdin:
            pipeline = _pipeline(measurement, int(line), **BACKENDS["cpu"])
            error_db = round(checks.require_exact(pipeline.process(measurement), measurement), 1)
            subjects = {"cpu": _into_one_array(pipeline, measurement)}
            row = timing.summary(timing.round_robin(subjects, count=count)["cpu"])
            sys.stdout.write(json.dumps([row, error_db]) + "\n")
            sys.stdout.flush()


def _of_directions(
    measurement: Measurement,
    n_directions: int,
    count: int,
    say: Callable[[str], None],
    errors_db: dict[str, dict[str, float]],
) -> list[dict[str, Any]]:
    """Return the rows of one number of directions, and add the errors to ``errors_db``."""
    rows = []
    say(f"{n_directions} directions: checking results")
    pipelines = {name: _pipeline(measurement, n_directions, **which) for name, which in BACKENDS.items()}
    errors_db[str(n_directions)] = _check(pipelines, measurement)
    say(f"{n_directions} directions: timing {count} of each on {', '.join(pipelines)}")
    subjects = {name: _into_one_array(pipeline, measurement) for name, pipeline in pipelines.items()}
    for name, times_ms in timing.round_robin(subjects, count=count).items():
        rows.append({"backend": name, "directions": n_directions, **timing.summary(times_ms)})
    return rows


def _pipeline(measurement: Measurement, n_directions: int, *, method: str, device: str) -> Pipeline:
    settings = measurement.settings
    processing = settings.processing.replace(
        directions=str(n_directions), range_m=RANGE_M, method=method, wavefront="plane"
    )
    return Pipeline(settings.replace(processing=processing), device=device, predict=False)


def _check(pipelines: dict[str, Pipeline], measurement: Measurement) -> dict[str, float]:
    """Check all images, and return the errors of backends that approximate the exact image."""
    images = {name: pipeline.process(measurement) for name, pipeline in pipelines.items()}
    for name in ("scipy", "paper"):
        checks.require_same_reflector(images[name], images["cpu"])
    return {name: round(checks.require_exact(images[name], measurement), 1) for name in ("numpy", "cpu")}


def _into_one_array(pipeline: Pipeline, measurement: Measurement) -> Callable[[], Energyscape]:
    out = np.empty((len(pipeline.grid), len(pipeline.range_m)), dtype=np.float32)
    return functools.partial(pipeline.process, measurement, out=out)


if __name__ == "__main__":
    _serve(int(sys.argv[1]))

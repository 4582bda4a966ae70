"""Times of the paper's three configurations, from bits to energyscape."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ertis_bench import checks, input_measurements, machine, timing
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.pipeline import Pipeline
from ertis_numba.stages.fitting import one_thread

__all__ = ["BACKENDS", "DIRECTIONS", "PUBLISHED_MS", "run"]

DIRECTIONS = (90, 1850, 3000)
RANGE_M = (0.5, 5.0)

BACKENDS = {
    "scipy": {"method": "paper", "device": "numpy"},
    "paper": {"method": "paper", "device": "cpu"},
    "numpy": {"method": "fast", "device": "numpy"},
    "cpu": {"method": "fast", "device": "cpu"},
}
"""Backends by name, each with its method and device."""

PUBLISHED_MS = {
    "CPU i7-7567U": ((132.53, 4.89), (976.33, 14.54), (1541.41, 20.30)),
    "CPU i9-7960X": ((167.13, 16.88), (1087.04, 109.72), (1653.45, 167.03)),
    "GPU Jetson TX2": ((68.40, 13.40), (585.24, 61.02), (911.47, 91.97)),
    "GPU GTX 1050": ((23.03, 2.38), (202.37, 20.85), (323.83, 33.18)),
    "GPU GTX 1080 Ti": ((5.93, 0.66), (51.58, 6.38), (77.02, 7.81)),
}
"""Mean and standard deviation of 100 measurements in ms, at 90, 1850 and 3000 directions (Jansen et al., 2019)."""


def run(*, count: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure all backends, and return a report with machine, rows and conditions.

    Parameters
    ----------
    count : int
        Measurements per backend and number of directions.
    say : callable
        Called with a line of progress.

    Raises
    ------
    DataError
        A result is wrong and therefore not timed.
    """
    measurement, source = input_measurements.measurement()
    with one_thread():
        rows, errors_db = _measure(measurement, count, say)
    return {
        "machine": machine.describe(),
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
    rows, errors_db = [], {}
    for n_directions in DIRECTIONS:
        say(f"{n_directions} directions: checking results")
        pipelines = {name: _pipeline(measurement, n_directions, **which) for name, which in BACKENDS.items()}
        errors_db[str(n_directions)] = _check(pipelines, measurement)
        say(f"{n_directions} directions: timing {count} of each on {', '.join(pipelines)}")
        subjects = {name: _into_one_array(pipeline, measurement) for name, pipeline in pipelines.items()}
        for name, times_ms in timing.round_robin(subjects, count=count).items():
            rows.append({"backend": name, "directions": n_directions, **timing.summary(times_ms)})
    return rows, errors_db


def _pipeline(measurement: Measurement, n_directions: int, *, method: str, device: str) -> Pipeline:
    settings = measurement.settings
    processing = settings.processing.replace(directions=str(n_directions), range_m=RANGE_M, method=method)
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

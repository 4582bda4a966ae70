"""Error versus time of many plans, with the plans on the Pareto front."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ertis_bench import input_measurements, machine, timing
from ertis_bench.plans import in_words, plans
from ertis_numba import kernels
from ertis_numba.analysis.detect import find_peaks
from ertis_numba.chain.planner import Planner
from ertis_numba.chain.signal_model import signal_model_of
from ertis_numba.frames import Measurement
from ertis_numba.kernels import KernelSet
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import ERROR_PRESETS_DB, Settings

__all__ = ["DIRECTIONS", "PAPER", "RANGE_M", "TURN", "beats", "comparable", "plot", "run"]

DIRECTIONS = "3000"
PAPER = "the paper's method"
RANGE_M = (0.5, 5.0)
TURN = 5
"""Consecutive calls per plan. The number is small because a turn of all plans takes seconds, and the speed of a machine
drifts meanwhile.
"""


def run(*, count: int, say: Callable[[str], None], directions: str = DIRECTIONS) -> dict[str, Any]:
    """Measure error and time of all plans on each subject, and return the report."""
    kernel_set = kernels.load("cpu")
    found, left_out = _subjects(say)
    rows, sources = [], []
    for name, (measurement, source) in found.items():
        settings = comparable(measurement.settings, directions)
        scene = _Subject(name, measurement, settings, kernel_set, say)
        sources.append({"subject": name, "source": source})
        rows += scene.rows(count)
    return {
        "machine": machine.describe(),
        "rows": rows,
        "count": count,
        "directions": directions,
        "range_m": list(RANGE_M),
        "subjects": sources,
        "left_out": left_out,
    }


def plot(report: dict[str, Any], path: Path) -> None:
    """Draw error and time of all plans. Labels name the presets of the first subject."""
    from ertis_numba import figures  # noqa: PLC0415 - Matplotlib is slow to import, and tables need no figure

    points = []
    for row in report["rows"]:
        label = PAPER if row["plan"] == PAPER else row["plan"].partition(":")[0] if ":" in row["plan"] else ""
        points.append(
            figures.Rated(
                series=row["subject"],
                error_db=row["error_db"],
                time_ms=row["time_ms"],
                on_front=row["on_front"],
                label=label if row["subject"] == report["rows"][0]["subject"] else "",
            )
        )
    title = f"Accuracy versus processing time · {report['directions']} directions"
    figures.front(points, title=title, note=report["machine"]["cpu"]).savefig(path)


def _subjects(say: Callable[[str], None]) -> tuple[dict[str, tuple[Measurement, str]], list[str]]:
    """Return the available subjects, and the names of unavailable ones."""
    found, left_out = {}, []
    room = input_measurements.real()
    if room is None:
        left_out.append("real measurement")
        say("real measurement: skipped, because its package rtisdev is not installed")
    else:
        found["real"] = room
    found["synthetic"] = input_measurements.measurement()
    return found, left_out


def comparable(settings: Settings, directions: str) -> Settings:
    """Return settings with the range axis of the paper's method, so that all images have the same axis."""
    processing = settings.processing.replace(directions=directions, range_m=RANGE_M, wavefront="plane")
    range_m = Pipeline(settings.replace(processing=processing.replace(method="paper"))).range_m
    half_m = float(range_m[1] - range_m[0]) / 2
    window_m = (float(range_m[0]), float(range_m[-1]) + half_m)
    return settings.replace(processing=processing.replace(method="fast", range_m=window_m))


class _Subject:
    """Measurement with its exact image and its signal model."""

    def __init__(
        self,
        name: str,
        measurement: Measurement,
        settings: Settings,
        kernel_set: KernelSet,
        say: Callable[[str], None],
    ) -> None:
        self._name, self._measurement, self._settings = name, measurement, settings
        self._kernels, self._threads, self._say = kernel_set, kernel_set.max_threads, say
        say(f"{name}: computing the exact image")
        exact = verification.exact_image(Pipeline(settings, predict=False).process(measurement), measurement)
        self._exact = exact.amplitude
        self._signal_model = signal_model_of(measurement, settings, kernel_set, threads=self._threads)

    def rows(self, count: int) -> list[dict[str, Any]]:
        """Return one row per plan, in descending order of the error."""
        self._say(f"{self._name}: making plans")
        pipelines = dict(self._pipelines())
        self._say(f"{self._name}: errors of {len(pipelines)} plans")
        rows = [self._row(name, pipeline) for name, pipeline in pipelines.items()]
        self._say(f"{self._name}: timing {count} of each")
        out = np.empty_like(self._exact)
        calls = {
            name: functools.partial(pipeline.process, self._measurement, out=out)
            for name, pipeline in pipelines.items()
        }
        times_ms = timing.round_robin(calls, count=count, burst=TURN)
        for row in rows:
            row["time_ms"] = timing.summary(times_ms[row["plan"]])["median_ms"]
        for row in rows:
            row["on_front"] = not any(beats(other, row) for other in rows)
        return sorted(rows, key=lambda row: -row["error_db"])

    def _pipelines(self) -> Iterator[tuple[str, Pipeline]]:
        settings = self._settings
        processing = settings.processing.replace(method="paper")
        yield PAPER, Pipeline(settings.replace(processing=processing), "numpy", predict=False)
        chosen = {}
        for preset, max_error_db in ERROR_PRESETS_DB.items():
            pipeline = Pipeline(settings, max_error_db=max_error_db, predict=False)
            chosen[in_words(pipeline.settings.accuracy)] = preset, pipeline
        for plan in plans():
            if in_words(plan) not in chosen:
                yield in_words(plan), Pipeline(settings.replace(accuracy=plan.replace(max_error_db=0.0)), predict=False)
        for words, (preset, pipeline) in chosen.items():
            yield f"{preset}: {words}", pipeline

    def _row(self, name: str, pipeline: Pipeline) -> dict[str, Any]:
        image = pipeline.process(self._measurement)
        # The fits of peaks use the settings of an image, so both images have the same.
        wanted = find_peaks(image.replace(amplitude=self._exact), top=verification.PEAKS, false_alarm=None)
        peaks = verification.peak_errors(image, wanted)
        return {
            "subject": self._name,
            "plan": name,
            "error_db": round(verification.error_db(image.amplitude, self._exact), 1),
            "predicted_db": None if name == PAPER else round(self._predicted_db(pipeline.settings), 1),
            "time_ms": 0.0,
            "on_front": False,
            "peak_level_db": _rounded(peaks.level_db),
            "peak_range_mm": _rounded(peaks.range_mm),
            "peak_angle_deg": _rounded(peaks.angle_deg),
            "peaks_lost": peaks.lost,
        }

    def _predicted_db(self, settings: Settings) -> float:
        planner = Planner(settings, self._kernels, threads=self._threads, signal_model=self._signal_model)
        return planner.chosen(settings.accuracy).error_db


def beats(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return True if ``one`` has no larger error and no longer time than ``other``, and is better in at least one."""
    pairs = [(one[key], other[key]) for key in ("error_db", "time_ms")]
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)

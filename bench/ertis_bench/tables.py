"""Reports as Markdown, and their places in files."""

from collections.abc import Callable, Iterable
from typing import Any

from ertis_bench import timing
from ertis_bench.accuracy import PAPER, TURN
from ertis_bench.machine import sentence
from ertis_bench.markdown import or_dash, table
from ertis_bench.paper import DIRECTIONS, FASTEST, PUBLISHED_MS, RESTRICTED
from ertis_numba.base.units import counted
from ertis_numba.pipeline.verification import PEAKS

__all__ = ["FORMS", "accuracy", "accuracy_front", "paper", "paper_short"]

_MEANING = {
    "scipy": "`scipy`: the paper's algorithm, NumPy and SciPy",
    "paper": "`paper`: the paper's method, Numba",
    "numpy": "`numpy`: this package's algorithm, NumPy and SciPy",
    "cpu": "`cpu`: this package's algorithm, Numba",
}


def paper(report: dict[str, Any]) -> str:
    """Return the times, the ratios and the paper's own times, with their conditions."""
    found = {(row["backend"], row["directions"]): row for row in report["rows"]}
    backends = list(dict.fromkeys(row["backend"] for row in report["rows"]))
    meaning = _MEANING | {
        "cpu": f"{_MEANING['cpu']}, {report['instruction_set']}",
        **{f"cpu, {name}": f"the same, {name} only" for name in RESTRICTED},
    }
    measured = [[meaning[backend], *(timing.in_words(**found[backend, n]) for n in DIRECTIONS)] for backend in backends]
    ratios = [
        [
            f"`{backend}`",
            *(f"{found['scipy', n]['median_ms'] / found[backend, n]['median_ms']:.1f}×" for n in DIRECTIONS),
        ]
        for backend in backends
        if backend != "scipy"
    ]
    published = [[name, *(f"{mean:.2f} ± {std:.2f}" for mean, std in times)] for name, times in PUBLISHED_MS.items()]
    columns = [f"{n} directions" for n in DIRECTIONS]
    return "\n\n".join(
        [
            table(["ms, mean ± std (median)", *columns], measured),
            table(["median time of `scipy` / median time", *columns], ratios),
            table(["published in the paper, ms, mean ± std", *columns], published),
            f"Measured on {sentence(report['machine'])}",
            _conditions(report),
            _checked(report),
        ]
    )


def paper_short(report: dict[str, Any]) -> str:
    """Return the median times of this package and of the paper's algorithm, and the times that the paper published."""
    found = {(row["backend"], row["directions"]): row["median_ms"] for row in report["rows"]}
    named = {"scipy": "the paper's algorithm in SciPy", "cpu": f"this package, {report['instruction_set']}"}
    rows = [[name, *(f"{found[backend, n]:.1f}" for n in DIRECTIONS)] for backend, name in named.items()]
    rows.append([f"published in the paper, {FASTEST}", *(f"{mean:.1f}" for mean, _ in PUBLISHED_MS[FASTEST])])
    times = table(["ms", *(f"{n} directions" for n in DIRECTIONS)], rows)
    return f"{times}\n\nMedians on {report['machine']['cpu']}, {counted(report['machine']['cores'], 'core')}."


def _checked(report: dict[str, Any]) -> str:
    worst_db = max(error_db for errors_db in report["error_db"].values() for error_db in errors_db.values())
    return (
        "Results were checked before they were timed: `numpy` and `cpu` differ from the exact image (float64, "
        f"fractional delays) by at most {worst_db:.1f} dB, and `scipy` and `paper` show the strongest reflector at the "
        "same place."
    )


def _conditions(report: dict[str, Any]) -> str:
    first_m, last_m = report["range_m"]
    return (
        f"The same measurement was processed {report['count']} times in one process, in turns of {timing.BURST} per "
        f"backend: {report['words']:,} words of 32 microphones ({report['source']}) to an energyscape of "
        f"{first_m:g}–{last_m:g} m. Times include everything from the words in memory to the image in memory. They "
        "exclude reading the file, creating the pipeline, compilation, and warm-up calls of a fifth of a second (at "
        "least three) before each turn. Images are written to one array. "
        "`scipy` runs on one thread, like its filters and sums, and processes the whole record, as the paper does. "
        "`paper` takes the same steps with compiled kernels on all cores, and sums only the samples in the window. "
        "`numpy` and `cpu` process the part of the record that the image needs, `cpu` on all cores, `numpy` on one. "
        "Rows limited to an instruction set were measured on the same machine, in turns with the others. ARM has no "
        "row, because no such machine was available. The paper does not state the length of its records."
    )


def accuracy(report: dict[str, Any]) -> str:
    """Return all plans of each subject, and the conditions of the measurement."""
    head = [
        "error, dB",
        "predicted, dB",
        "ms (median)",
        "time of paper / time",
        "level, dB",
        "range, mm",
        "angle, °",
        "missed",
    ]
    parts = []
    for name, rows, paper_ms in _subjects(report):
        cells = [
            [
                f"**{row['plan']}**" if row["on_front"] else row["plan"],
                f"{row['error_db']:.1f}",
                or_dash(row["predicted_db"], 1),
                f"{row['time_ms']:.2f}",
                f"{paper_ms / row['time_ms']:.1f}×",
                *(or_dash(row[key], 3) for key in ("peak_level_db", "peak_range_mm", "peak_angle_deg")),
                f"{row['peaks_lost']}",
            ]
            for row in rows
        ]
        parts.append(table([name, *head], cells))
    return "\n\n".join([*parts, f"Measured on {sentence(report['machine'])}", _accuracy_conditions(report)])


def accuracy_front(report: dict[str, Any]) -> str:
    """Return the plans on the Pareto front, and the paper's method."""
    parts = []
    for name, rows, paper_ms in _subjects(report):
        cells = [
            [row["plan"], f"{row['error_db']:.1f}", f"{row['time_ms']:.2f}", f"{paper_ms / row['time_ms']:.1f}×"]
            for row in rows
            if row["on_front"] or row["plan"] == PAPER
        ]
        parts.append(table([name, "error, dB", "ms (median)", "time of paper / time"], cells))
    conditions = (
        f"Medians of {report['count']} measurements, {report['directions']} directions. The table contains the plans "
        "that no other plan beats in both error and time, and the paper's method. docs/reference/benchmarks.md has all "
        "plans and the conditions of the measurement."
    )
    return "\n\n".join([*parts, f"Measured on {sentence(report['machine'])}", conditions])


def _subjects(report: dict[str, Any]) -> Iterable[tuple[str, list[dict[str, Any]], float]]:
    """Yield the name of each subject, its rows, and the time of the paper's method."""
    for entry in report["subjects"]:
        rows = [row for row in report["rows"] if row["subject"] == entry["subject"]]
        paper_ms = next(row["time_ms"] for row in rows if row["plan"] == PAPER)
        yield f"{entry['subject']} ({entry['source']})", rows, paper_ms


def _accuracy_conditions(report: dict[str, Any]) -> str:
    first_m, last_m = report["range_m"]
    left_out = "".join(f" Not installed here: {name}." for name in report["left_out"])
    return (
        f"{report['directions']} directions, {first_m:g}–{last_m:g} m, device `cpu`, all threads, but one for the "
        f"paper's method. Times are medians of {report['count']} measurements in turns of {TURN}, without warm-up "
        "calls of a fifth of a second. Bold: no other plan is both faster and more accurate. The name of a plan states "
        "in this order: precision; samples per interpolation and samples kept per range; beam grid, if any, as grid "
        "points per axis × density; stopband attenuation. The planner chose the plans draft, standard, fine and exact. "
        "Error: norm of the difference relative to the norm of the exact image, in float64 over all "
        "directions and ranges. Predicted: by the error model with the signal model of the measurement, before the "
        "image is computed. Level, range, angle: "
        f"largest errors among the strongest {PEAKS} reflectors, with levels relative to the strongest. Missed: "
        f"reflectors without a peak from `find_peaks` within 5° and 2 cm.{left_out}"
    )


FORMS: dict[str, dict[str, Callable[[dict[str, Any]], str]]] = {
    "paper": {"paper": paper, "paper short": paper_short},
    "accuracy": {"accuracy": accuracy, "accuracy front": accuracy_front},
}
"""Forms of the table of each command in the wheel, by the name in its markers. A file's markers select the form."""

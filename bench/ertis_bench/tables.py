"""Reports as Markdown, and their places in files."""

from collections.abc import Callable, Iterable
from typing import Any

from ertis_bench import timing
from ertis_bench.accuracy import PAPER, TURN
from ertis_bench.beamformers import form as beamformers
from ertis_bench.budgets import form as budgets
from ertis_bench.calibration import form as calibration
from ertis_bench.campaign_scaling import many
from ertis_bench.delay_interpolation import form as interpolation
from ertis_bench.gpu_tables import gpu, gpu_short
from ertis_bench.machine import sentence
from ertis_bench.markdown import table as _table
from ertis_bench.network.latency import latency
from ertis_bench.network.table import network
from ertis_bench.paper import DIRECTIONS, PUBLISHED_MS, RESTRICTED
from ertis_bench.point_errors import form as points
from ertis_bench.ptx_tables import ptx
from ertis_bench.verify_trials import form as verification
from ertis_numba.verification import PEAKS

__all__ = [
    "FORMS",
    "accuracy",
    "accuracy_front",
    "calibration",
    "factorisation",
    "gpu",
    "gpu_short",
    "latency",
    "many",
    "network",
    "paper",
    "points",
    "ptx",
    "scaling",
    "simulation",
]

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
    measured = [[meaning[backend], *(_statistics(**found[backend, n]) for n in DIRECTIONS)] for backend in backends]
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
            _table(["ms, mean ± std (median)", *columns], measured),
            _table(["median time of `scipy` / median time", *columns], ratios),
            _table(["published in the paper, ms, mean ± std", *columns], published),
            f"Measured on {sentence(report['machine'])}",
            _conditions(report),
            _checked(report),
        ]
    )


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
                _or_dash(row["predicted_db"], 1),
                f"{row['time_ms']:.2f}",
                f"{paper_ms / row['time_ms']:.1f}×",
                *(_or_dash(row[key], 3) for key in ("peak_level_db", "peak_range_mm", "peak_angle_deg")),
                f"{row['peaks_lost']}",
            ]
            for row in rows
        ]
        parts.append(_table([name, *head], cells))
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
        parts.append(_table([name, "error, dB", "ms (median)", "time of paper / time"], cells))
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


def scaling(report: dict[str, Any]) -> str:
    """Return one table per series, the limits, and the reached shares."""
    series: dict[str, list[list[str]]] = {}
    for row in report["rows"]:
        sums = "" if row["plan"] == "default" else f", no beam grid, {row['plan']}"
        name = row["series"].replace("_m", ", m").replace("_", " ") + sums
        series.setdefault(name, []).append([f"{row['value']:g}", _statistics(**row), f"{row['n_ranges']}"])
    parts = [_table([name, "ms, mean ± std (median)", "ranges"], rows) for name, rows in series.items()]
    columns = {
        "threads": "threads",
        "copy_gb_s": "copy, GB/s",
        "triad_gb_s": "triad, GB/s",
        "float32_gop_s": "float32 multiply-add, Gop/s",
        "int16_gop_s": "16-bit dot product, Gop/s",
    }
    measured = [key for key in columns if key in report["ceilings"][0]]
    rows = [[f"{row[key]:g}" for key in measured] for row in report["ceilings"]]
    parts.append(_table([columns[key] for key in measured], rows))
    parts += [_reached(**reached) for reached in report["delay_and_sum"]]
    parts.append(f"Measured on {sentence(report['machine'])}")
    parts.append(
        f"{report['count']} measurements per line, device `cpu`, white noise, the lines of a table in turns of "
        f"{timing.BURST}. Other values are 1850 directions, 0.5–5 m, 32 microphones and all threads. Each line has "
        "the default plan for its settings. If a precision is named, every direction is summed without a beam grid, "
        "with one sample per microphone. A batch contains several measurements, and the time is that of one of them. "
        "Every image was compared with the exact one before it was timed; "
        "warm-up calls of a fifth of a second are excluded. "
        "Limits are the best of as many runs, over arrays of 64 MiB and in "
        "registers; a multiplication and an addition are two operations."
    )
    return "\n\n".join(parts)


def simulation(report: dict[str, Any]) -> str:
    """Return the times of a measurement with the relevant effects and with all effects, and the cost of each effect."""
    needed, everything = report["rows"]
    rows = [
        [row["effects"], f"{len(row['on'])}", _statistics(**row), f"{1e3 / row['median_ms']:.1f}"]
        for row in (needed, everything)
    ]
    costs = [
        [f"`{name}`", f"{needed['cost_ms'].get(name, 0.0):.1f}" if name in needed["on"] else "off", f"{cost_ms:.1f}"]
        for name, cost_ms in sorted(everything["cost_ms"].items(), key=lambda item: -item[1])
    ]
    return "\n\n".join(
        [
            _table(["simulated", "effects", "ms, mean ± std (median)", "measurements per second"], rows),
            f"Time with all effects / time with the relevant effects: {report['times_faster']:.1f}.",
            _table(["ms per measurement", "relevant effects", "all effects"], costs),
            f"Measured on {sentence(report['machine'])}",
            _scene_conditions(report),
        ]
    )


def factorisation(report: dict[str, Any]) -> str:
    """Return products per bin for direct sums, a beam grid of the whole array, and beam grids of its parts."""
    parts = list(report["rows"][0]["parts"])
    head = ["microphones", "directions", "no beam grid", "beam grid of the whole array"]
    head += [f"of {n} sub-arrays" for n in parts[1:]]
    rows = [
        [str(row["microphones"]), str(row["directions"]), str(row["direct"])]
        + [_or_dash(row["parts"][n], 0) for n in parts]
        for row in report["rows"]
    ]
    return _table(head, rows)


def _scene_conditions(report: dict[str, Any]) -> str:
    return (
        f"{report['count']} measurements each, in turns of {timing.BURST}: {report['words']:,} words of 32 "
        "microphones, ten points in free field, and in the same scene a second sensor, walls, a sphere, a disc, "
        "motion, tones, noise, another sonar and unequal microphones, all too weak to matter. Times include everything "
        "from the scene to the words in memory. They exclude the choice of the effects, compilation, and warm-up "
        f"calls. The images of both differ by at most {report['change_db']:.2g} dB. `propagation` counts "
        "the transforms that all echoes share."
    )


def _reached(
    *,
    precision: str,
    us_per_direction: float,
    rest_of_chain_ms: float,
    gop_s: float,
    of_arithmetic: float,
    written_gb_s: float,
    of_copy: float,
) -> str:
    return (
        f"Delay-and-sum with envelope in {precision} takes {us_per_direction:.2f} µs per direction (the slope over "
        f"directions; the rest of the chain takes {rest_of_chain_ms:.2f} ms). That is {gop_s:.0f} Gop/s, "
        f"{100 * of_arithmetic:.0f} % of the rate of the arithmetic alone. Its images are written at "
        f"{written_gb_s:.2f} GB/s, {100 * of_copy:.0f} % of the rate of a copy."
    )


def _statistics(*, mean_ms: float, std_ms: float, median_ms: float, **_: object) -> str:
    return f"{mean_ms:.2f} ± {std_ms:.2f} ({median_ms:.2f})"


def _or_dash(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


FORMS: dict[str, dict[str, Callable[[dict[str, Any]], str]]] = {
    "paper": {"paper": paper},
    "scaling": {"scaling": scaling},
    "simulation": {"simulation": simulation},
    "many": {"many": many},
    "factorisation": {"factorisation": factorisation},
    "interpolation": {"interpolation": interpolation},
    "ptx": {"ptx": ptx},
    "latency": {"latency": latency},
    "network": {"network": network},
    "gpu": {"gpu": gpu, "gpu short": gpu_short},
    "accuracy": {"accuracy": accuracy, "accuracy front": accuracy_front},
    "beamformers": {"beamformers": beamformers},
    "verification": {"verification": verification},
    "budgets": {"budgets": budgets},
    "points": {"points": points},
    "calibration": {"calibration": calibration},
}
"""Forms of the table of each command, by the name in the markers. The markers of a file select the form."""

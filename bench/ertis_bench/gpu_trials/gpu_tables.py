"""Markdown report of `gpu`."""

from collections.abc import Iterator
from typing import Any

from ertis_bench.gpu_trials import rival_mach
from ertis_bench.markdown import table
from ertis_bench.paper import DIRECTIONS, FASTEST, PUBLISHED_MS

__all__ = ["gpu"]

_UNMEASURED = "not measured"
_WITHOUT = ", without CUDA graphs"
_SINGLE = {"one at a time, words to image": "graphs", f"one at a time, words to image{_WITHOUT}": "plain"}
_STREAMS = {
    f"streamed, images {where}{without}": f"{where}, {how}"
    for where in ("to the host", "stay on the GPU")
    for without, how in (("", "graphs"), (_WITHOUT, "plain"))
}
_BATCH = f"theirs_per_frame_of_{rival_mach.FRAMES}_ms"
_PAPER = f"the paper's {FASTEST.removeprefix('GPU ')}"


def gpu(report: dict[str, Any]) -> str:
    """Return all measurements on a GPU, or a note that there are none if the report is empty."""
    if not report:
        return f"{_times(_lines({}))}\n\n{_NO_RESULTS}"
    parts = [_stages(report), _maps(report), _rivals(report), _reached(report), _verdicts(report), _machine(report)]
    return "\n\n".join([_times(_lines(report)), *(part for part in parts if part), _CONDITIONS.format(**report)])


def _rows(report: dict[str, Any], part: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = report.get("parts", {}).get(part, {}).get("rows", [])
    return found


def _lines(report: dict[str, Any]) -> dict[str, list[str]]:
    """Return the times per measurement by direction grid. Grids without a measurement are marked."""
    rows = {row["directions"]: row for row in _rows(report, "paper")}
    lines: dict[str, list[str]] = {
        **{name: [] for name in _SINGLE},
        "on the GPU alone, without transfers": [],
        **{name: [] for name in _STREAMS},
        _PAPER: [],
        "paper's time / shortest single time": [],
    }
    for directions, published in zip(DIRECTIONS, PUBLISHED_MS[FASTEST], strict=True):
        row = rows.get(str(directions))
        cells = [_UNMEASURED] * 7 if row is None else list(_cells(row))
        faster = "–" if row is None else f"{row['times_faster_than_published']:.0f}×"
        for line, cell in zip(lines.values(), [*cells, f"{published[0]:.2f}", faster], strict=True):
            line.append(cell)
    return lines


def _times(lines: dict[str, list[str]]) -> str:
    head = ["ms per measurement, median", *(f"{n} directions" for n in DIRECTIONS)]
    return table(head, [[name, *cells] for name, cells in lines.items()])


def _cells(row: dict[str, Any]) -> Iterator[str]:
    for name in _SINGLE.values():
        yield f"{row['one_at_a_time'][name]['median_ms']:.3f}"
    yield f"{row['without_transfers_ms']:.3f}"
    for name in _STREAMS.values():
        yield f"{row['streamed_ms'][name]:.3f}"


def _stages(report: dict[str, Any]) -> str:
    rows = _rows(report, "paper")
    if not rows:
        return ""
    lines = [[name, *(f"{row['stages_ms'][name]:.4f}" for row in rows)] for name in rows[0]["stages_ms"]]
    lines.append(["sum", *(f"{row['sum_ms']:.4f}" for row in rows)])
    lines.append(["sum without transfers", *(f"{row['without_transfers_ms']:.4f}" for row in rows)])
    plans = "; ".join(
        f"{row['directions']} directions, {row['ranges']} ranges: {row['plan']}, error {row['error_db']:.1f} dB "
        f"relative to the exact image and {row['off_cpu_db']:.1f} dB relative to `cpu`"
        + ("" if row["queued"] else ", with gaps in which the GPU waited for launches")
        for row in rows
    )
    head = ["ms on the GPU's clock", *(f"{row['directions']} directions" for row in rows)]
    return f"{table(head, lines)}\n\n{plans}."


def _maps(report: dict[str, Any]) -> str:
    rows = _rows(report, "acoustic maps")
    if not rows:
        return ""
    cells = [
        [f"`{row['method']}`", f"{row['ours_ms']:.1f}", f"{row['cpu_ms']:.1f}", f"{row['off_cpu_db']:.0f}"]
        for row in rows
    ]
    text = table(["acoustic map", "GPU, ms", "`cpu`, ms", "largest difference, dB relative to the loudest"], cells)
    return (
        f"{text}\n\nMaps of {rows[0]['directions']} directions and {rows[0]['bands']} bands, of {rows[0]['bins']} "
        "frequencies, from the signals of one measurement to the map on the host."
    )


def _rivals(report: dict[str, Any]) -> str:
    rows = _rows(report, "side by side")
    if not rows:
        return ""
    cells = [
        [
            f"{row['library']}: {row.get('status') or row['what']}",
            row["directions"],
            row.get("plan", "–"),
            *(f"{row[key]:.3f}" if key in row else "–" for key in ("theirs_ms", _BATCH, "ours_ms")),
            f"{row['times_faster']:.1f}×" if "times_faster" in row else "–",
            f"{row[_BATCH] / row['ours_ms']:.2f}×" if _BATCH in row else "–",
            f"{row['off_db']:.0f}" if "off_db" in row else "–",
        ]
        for row in rows
    ]
    batch = f"batch of {rival_mach.FRAMES}, ms per frame"
    head = ["library", "directions", "plan of this package", "library, ms", f"library, {batch}", "this package, ms"]
    ratios = ["library / this package", "batch / this package", "difference, dB"]
    return f"{table([*head, *ratios], cells)}\n\n{_BATCHES.format(frames=rival_mach.FRAMES)}"


def _reached(report: dict[str, Any]) -> str:
    rows = _rows(report, "ceilings")
    if not rows:
        return ""
    found, reached = rows[0]["ceilings"], {} if len(rows) == 1 else rows[1]
    names = {
        "copy_gb_s": "copy in device memory, read and written, GB/s",
        "float32_gop_s": "float32 multiply-add, Gop/s",
        "load_gb_s": "loads from the first-level cache, GB/s",
        "load_unaligned_gb_s": "the same, one sample after the start of a cache line, GB/s",
    }
    shares = reached.get("shares", {})
    cells = [
        [text, f"{found[name]:,.0f}", f"{100 * shares[name]:.0f} %" if name in shares else "–"]
        for name, text in names.items()
    ]
    text = table(["limit", "measured", "share that delay-and-sum reaches"], cells)
    if not reached:
        return text
    return (
        f"{text}\n\nDelay-and-sum with envelope of {reached['directions']} directions, {reached['ranges']} ranges and "
        f"{reached['terms']} terms takes {reached['delay_and_sum_ms']:.3f} ms ({reached['plan']})."
    )


def _verdicts(report: dict[str, Any]) -> str:
    """Return the result of each part, including failures."""
    lines = []
    for name, part in report["parts"].items():
        reported = [part["status"]]
        if name == "tests" and "passed" in part:
            reported.append(
                f"{part['passed']} passed, {part['passed_on_gpu']} of them on the GPU; {part['failed']} failed, "
                f"{part['skipped']} skipped"
            )
        if "errors" in part:
            reported.append(f"{part['errors']} errors in {part['tests_passed']} tests")
        lines.append(f"- {name}: {'; '.join(reported)} ({part['wall_s']:.0f} s)")
    return "\n".join(lines)


def _machine(report: dict[str, Any]) -> str:
    card, host = report["gpu"], report["machine"]
    known = {
        "driver": card.get("driver_version"),
        "CUDA of the driver": card["cuda_driver"],
        "of the runtime": card["cuda_runtime"],
        "memory": card.get("memory.total"),
        "highest clock": card.get("clocks.max.sm"),
        "power limit": card.get("power.limit"),
    }
    under_load = next((row["clocks.sm"] for row in _rows(report, "ceilings") if "clocks.sm" in row), None)
    reported = [f"{name} {value}" for name, value in {**known, "clock right after load": under_load}.items() if value]
    packages = ", ".join(f"{name} {value}" for name, value in card["packages"].items())
    return (
        f"Measured on {card['name']} ({card['multiprocessors']} multiprocessors, compute capability "
        f"{card['compute_capability']}; {', '.join(reported)}) beside {host['cpu']}, {host['cores']} cores; {packages}"
        f", numba {host['numba']}, python {host['python']}."
    )


_NO_RESULTS = """\
No GPU has run these kernels yet. `make gpu` fills this table, which will confirm or refute the predictions below."""
_BATCHES = """\
mach can also beamform several frames per call, here {frames}. This package processes one frame per call. If a ratio is
below 1, the library is faster."""
_CONDITIONS = """\
{date}, revision {revision}; the measurement is {source}, 0.5–5 m, with the default plan for this GPU. Images are
checked before they are timed. They are compared with the exact image, with the CPU's image of the same plan, and
with the images of other libraries. One at a time: from the words in memory to the image in pinned memory, with
separate launches and with a CUDA graph, in turns. On the GPU alone: with the GPU's own clock, while all launches
wait behind a kernel that keeps the GPU busy. Streamed: 64 measurements in three lanes. The same measurement is
processed repeatedly, so that the GPU's caches may hold more of the tables than they would beside other work. Other
libraries run the same algorithm with the same tables and without a beam grid, in turns with this package. This package
replays a CUDA graph in these comparisons, and the other libraries launch their kernels. mach computes its delays
itself."""

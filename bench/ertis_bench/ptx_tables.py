"""Markdown report of `ptx`."""

from typing import Any

from ertis_bench.markdown import table

__all__ = ["ptx"]

_LOOP = ("loads", "multiply-adds", "integer", "others")
_PARTS = ("instructions", "first cache", "second cache", "memory", "waiting")
_ASSUMED = """\
Counted in code for compute capability 9.0 ({made}). Times are arithmetic:

- H200 SXM: {multiprocessors:g} multiprocessors, each with {schedulers:g} instructions of a warp per clock, at
  {clock_ghz:g} GHz, its highest clock.
- Instructions are those of a warp's way through the kernel, its main loop as often as it runs, on the multiprocessor
  that has the most blocks.
- First cache: {cache_line_bytes:g} bytes per clock. A warp's load of 256 bytes takes two lines, three if it does not
  begin at one: samples do not, nodes do. A load of one number for all threads takes one.
- Second cache: {second_cache_gb_s:,.0f} GB/s, a guess from tests of an H100, and each block fetches each of its lines
  itself. That is the worst case: where it decides, the prediction is a range whose lower end leaves it out. Totals
  take the upper end.
- Memory: {memory_gb_s:,.0f} GB/s, and each array is moved once, though most stay in the second cache.
- Waiting: {cache_latency_clocks:g} clocks per load that the next one depends on (Luo et al., 2024, on an H100), once
  for each round of resident blocks.
- A launch takes the longest of these.
- Transforms: {transform_kernels:g} kernels each, which move their arrays once and take {transform_kernel_us:g} µs or
  more. Kernels follow each other after {between_kernels_us:g} µs.
- PCIe 5 x16 and pinned memory: {pcie_gb_s:g} GB/s each way. Words are copied to pinned memory at {copy_gb_s:g} GB/s.
- The processor takes {graph_us:g} µs to start a graph and {host_us:g} µs for all else. Without a graph it takes
  {launch_us:g} µs per launch and {launch_array_us:g} µs per array (numba-cuda, pull request 288), and
  {transform_launch_us:g} µs per transform.
- Measurements in a row: words up, kernels, images down and the processor run beside each other; the slowest decides."""


def ptx(report: dict[str, Any]) -> str:
    """Return the launches of each plan, the loops, the totals, and the assumptions."""
    parts = ["### Launches"]
    for plan in report["plans"]:
        parts += [_title(plan), _launches(plan)]
    parts += ["### Main loops", _loops(report["loops"]), "### Totals", _totals(report), "### Assumed", _assumed(report)]
    return "\n\n".join(parts)


def _title(plan: dict[str, Any]) -> str:
    accuracy = plan["accuracy"]
    beams = (
        f"beams of nodes, {accuracy['beam_taps']} taps per axis, {accuracy['beam_density']:g} nodes per beam width"
        if accuracy["beam_taps"]
        else "every direction's own beam"
    )
    name = "the default plan" if plan["plan"] == "default" else "direct sums"
    return (
        f"**{plan['directions']} directions, {name}**: {accuracy['oversampling']} phases, {accuracy['delay_taps']} "
        f"delay taps, {beams}."
    )


def _launches(plan: dict[str, Any]) -> str:
    head = ["kernel", "grid × block", "registers", "resident warps", *(f"{name}, µs" for name in _PARTS)]
    rows = [
        [
            f"`{row['kernel']}`",
            f"{_by(row['grid'])} × {_by(row['block'])}",
            str(row["registers"]),
            str(row["resident_warps"]),
            *(f"{row['parts_us'][name]:.1f}" for name in _PARTS),
            _range(row["least_us"], row["us"]),
        ]
        for row in plan["launches"]
    ]
    empty = ["–"] * (len(head) - 1)
    rows += [[row["name"], *empty, f"{row['us']:.1f}"] for row in plan["transforms"]]
    return table([*head, "predicted, µs"], rows)


def _by(sizes: list[int]) -> str:
    return "(" + ", ".join(map(str, sizes)) + ")"


def _range(smallest: float, largest: float) -> str:
    return f"{largest:.1f}" if f"{smallest:.1f}" == f"{largest:.1f}" else f"{smallest:.1f}–{largest:.1f}"


def _loops(loops: list[dict[str, Any]]) -> str:
    head = ["kernel", "a pass is for a", "passes at once", *_LOOP, "all", "all, per point", "cache lines"]
    rows = [
        [
            f"`{row['kernel']}`",
            row["of"],
            str(row["at_once"]),
            *(f"{row[name]:g}" for name in _LOOP),
            f"{row['all']:g}",
            f"{row['all'] / row['points']:g}",
            str(row["lines"]),
        ]
        for row in loops
    ]
    return table(head, rows)


def _totals(report: dict[str, Any]) -> str:
    plans, goals = report["plans"], report["goals"]
    head = ["predicted", *(f"{plan['directions']}, {plan['plan']}" for plan in plans), "goal"]
    rows = [[f"{name}, µs", *(f"{plan['times_us'][name]:.1f}" for plan in plans), ""] for name in plans[0]["times_us"]]
    one = [f"{plan['one_ms']:.2f}" for plan in plans]
    rows.append(["one measurement, words to image, ms", *one, f"≤ {goals['one_ms']:g}"])
    for name in plans[0]["per_second"]:
        goal = f"≥ {goals['streamed_per_s']:,.0f}" if name == "images left on the GPU" else ""
        rates = [f"{plan['per_second'][name]:,}" for plan in plans]
        rows.append([f"measurements per second, {name}", *rates, goal])
    return f"{table(head, rows)}\n\n{_ceiling(report['ceiling'], goals['of_ceiling'])}"


def _ceiling(ceiling: dict[str, Any], goal: float) -> str:
    limits = " and ".join(f"{time_us:g} µs of {name}" for name, time_us in ceiling["ceilings_us"].items())
    smallest, largest = ceiling["of_ceiling"]
    return (
        f"`delay_and_sum_envelope` of 3000 direct beams, {ceiling['points'] / 1e6:.0f} million points: ceilings are "
        f"{limits} (a sample of 8 bytes, four multiply-adds). Predicted: {_range(ceiling['least_us'], ceiling['us'])} "
        f"µs, {100 * largest:.0f} % of the tighter one if blocks find in the first cache what others have fetched, and "
        f"{100 * smallest:.0f} % if none does; wanted are {100 * goal:.0f} %."
    )


def _assumed(report: dict[str, Any]) -> str:
    made = ", ".join(f"{name} {number}" for name, number in report["compiled"].items())
    figures = {**report["gpu"], **report["assumed"]}
    large = {"hz": ("ghz", 1e9), "bytes_s": ("gb_s", 1e9)}
    for name in [name for name in figures if name.endswith(tuple(large))]:
        unit = next(unit for unit in large if name.endswith(unit))
        figures[name.removesuffix(unit) + large[unit][0]] = figures[name] / large[unit][1]
    return _ASSUMED.format(made=made, **figures)

"""Markdown report of `predictions`."""

from typing import Any

from ertis_bench.markdown import table

__all__ = ["ptx"]

_LOOP = ("loads", "multiply-adds", "integer", "others")
_PARTS = {
    "instructions": "instructions",
    "first cache": "first-level cache",
    "second cache": "second-level cache",
    "memory": "memory",
    "waiting": "waiting",
}
"""Parts of the GPU in a report, with their headings."""
_ASSUMED = """\
Counts are from code for compute capability 9.0 ({made}). Times are arithmetic with these assumptions:

- H200 SXM: {multiprocessors:g} multiprocessors, each with {schedulers:g} instructions of a warp per clock, at
  its highest clock of {clock_ghz:g} GHz.
- Instructions are those of a warp's path through the kernel, with all passes of its main loop, on the multiprocessor
  with the most blocks.
- First-level cache: {cache_line_bytes:g} bytes per clock. A warp's load of 256 bytes reads two lines, or three if it
  does not start at a line. Loads of samples do not, but loads of grid points do. A load of one number for all threads
  reads one line.
- Second-level cache: {second_cache_gb_s:,.0f} GB/s, an estimate from tests of an H100. Each block fetches each of its
  lines itself, which is the worst case. Where this cache decides, the prediction is a range whose lower end excludes
  it. Totals use the upper end.
- Memory: {memory_gb_s:,.0f} GB/s. Each array is moved once, though most stay in the second-level cache.
- Waiting: {cache_latency_clocks:g} clocks per load on which the next load depends (Luo et al., 2024, on an H100), once
  for each round of resident blocks.
- The longest of these times is the time of a launch.
- Transforms: {transform_kernels:g} kernels each. They move their arrays once, and take at least
  {transform_kernel_us:g} µs. The gap between kernels is {between_kernels_us:g} µs.
- PCIe 5 x16 with pinned memory: {pcie_gb_s:g} GB/s each way. Words are copied to pinned memory at {copy_gb_s:g} GB/s.
- The processor needs {graph_us:g} µs to start a graph, and {host_us:g} µs for all other work. Without a graph it needs
  {launch_us:g} µs per launch and {launch_array_us:g} µs per array (numba-cuda, pull request 288), and
  {transform_launch_us:g} µs per transform.
- Consecutive measurements: uploads, kernels, downloads and the processor overlap, so that the slowest determines the
  rate."""


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
        f"beam grid with {accuracy['beam_taps']} taps per axis and {accuracy['beam_density']:g} points per beam width"
        if accuracy["beam_taps"]
        else "no beam grid"
    )
    name = "the default plan" if plan["plan"] == "default" else "direct sums"
    return (
        f"**{plan['directions']} directions, {name}**: {accuracy['oversampling']} phases, {accuracy['delay_taps']} "
        f"delay taps, {beams}."
    )


def _launches(plan: dict[str, Any]) -> str:
    head = ["kernel", "grid × block", "registers", "resident warps", *(f"{heading}, µs" for heading in _PARTS.values())]
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
    head = ["kernel", "unit of a pass", "merged passes", *_LOOP, "all", "all, per point", "cache lines"]
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
    limits = " and ".join(
        f"{time_us:g} µs of {_PARTS.get(name, name)}" for name, time_us in ceiling["ceilings_us"].items()
    )
    smallest, largest = ceiling["of_ceiling"]
    return (
        "`delay_and_sum_envelope` of 3000 directions without a beam grid has "
        f"{ceiling['points'] / 1e6:.0f} million points. Its ceilings are {limits} (8 bytes and four multiply-adds per "
        f"point). The prediction is {_range(ceiling['least_us'], ceiling['us'])} µs. This is {100 * largest:.0f} % of "
        "the tighter ceiling if blocks find samples in the first-level cache that other blocks have fetched, and "
        f"{100 * smallest:.0f} % otherwise. The goal is {100 * goal:.0f} %."
    )


def _assumed(report: dict[str, Any]) -> str:
    made = ", ".join(f"{name} {number}" for name, number in report["compiled"].items())
    figures = {**report["gpu"], **report["assumed"]}
    large = {"hz": ("ghz", 1e9), "bytes_s": ("gb_s", 1e9)}
    for name in [name for name in figures if name.endswith(tuple(large))]:
        unit = next(unit for unit in large if name.endswith(unit))
        figures[name.removesuffix(unit) + large[unit][0]] = figures[name] / large[unit][1]
    return _ASSUMED.format(made=made, **figures)

"""Machine code of the default plan's kernels, and their estimated time on an H200. No GPU is needed.

This module counts registers and instructions, and derives times from them (`h200`). It measures nothing.
"""

from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from ertis_bench import input_measurements
from ertis_bench.paper import DIRECTIONS, RANGE_M
from ertis_bench.ptx import h200
from ertis_bench.ptx.instructions import kinds, parse
from ertis_numba.kernels import KernelSet
from ertis_numba.kernels._cuda import offline_compilation
from ertis_numba.settings import Settings
from ertis_numba.stages import planner
from ertis_numba.stages.fast_chain import FastChain

__all__ = ["GOALS", "run"]

GOALS = {"one_ms": 1.0, "streamed_per_s": 5000.0, "of_ceiling": 0.5}
"""Goals for three figures.

They are the time of a measurement from host to host, measurements per second with images left on the GPU, and the share
of its ceiling that delay-and-sum reaches.
"""

_PLANS: dict[str, dict[str, Any]] = {"default": {}, "own beams": {"beam_taps": 0, "delay_taps": 1}}


def run(*, say: Callable[[str], None]) -> dict[str, Any]:
    """Return a report of the launches of each plan with registers and predicted times, the loops, and the totals.

    Raises
    ------
    DeviceError
        numba-cuda or one of NVIDIA's programs is missing, or the kernels are simulated in this process.
    """
    offline_compilation.require_compilers()
    plans = []
    for plan, directions in [*(("default", n) for n in DIRECTIONS), ("own beams", DIRECTIONS[-1])]:
        say(f"{directions} directions, {plan}")
        plans.append({"plan": plan, "directions": directions, **_plan(_settings(directions, _PLANS[plan]))})
    return {
        "compiled": _versions(),
        "gpu": dict(h200.GPU),
        "assumed": dict(h200.ASSUMED),
        "range_m": list(RANGE_M),
        "loops": _loops(plans),
        "plans": [{**plan, "launches": [_without_loop(row) for row in plan["launches"]]} for plan in plans],
        "ceiling": _ceiling(plans[-1]),
        "goals": dict(GOALS),
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in ("numba", "numba-cuda", "nvidia-cuda-nvcc-cu12"):
        with suppress(PackageNotFoundError):  # ptxas may come from an installed toolkit instead of the package.
            found[name] = version(name)
    return found


def _settings(directions: int, accuracy: dict[str, Any]) -> Settings:
    settings = input_measurements.measurement()[0].settings
    processing = settings.processing.replace(directions=str(directions), range_m=RANGE_M)
    return settings.replace(processing=processing, accuracy=settings.accuracy.replace(precision="float32", **accuracy))


def _plan(settings: Settings) -> dict[str, Any]:
    """Return the launches of a chain, and the times of its parts."""
    sizes: dict[str, Any] = {}

    def steps(kernels: KernelSet) -> None:
        complete = planner.complete(settings, kernels, threads=1)
        chain = FastChain(complete, kernels, threads=1)
        words, image = input_measurements.measurement()[0].data, chain.new_image()
        sizes.update(
            accuracy={
                name: getattr(complete.accuracy, name)
                for name in ("oversampling", "delay_taps", "beam_taps", "beam_density", "stopband_attenuation_db")
            },
            words_bytes=words.nbytes,
            image_bytes=image.nbytes,
            points=image.size,
        )
        chain.process(words.reshape(len(words), -1), image)

    launches = offline_compilation.recorded(steps)
    rows = [_row(launch) for launch in launches]
    fold = next(launch for launch in launches if launch.file == "multiply_and_fold").arguments
    signals = next(launch for launch in launches if launch.file == "demodulate_words").arguments["out"]
    transforms = [
        {"name": "forward transform", "us": _transform_us(signals.nbytes + fold["spectra"].nbytes)},
        {"name": "inverse transform", "us": _transform_us(2 * fold["out"].nbytes)},
    ]
    return {**sizes, "launches": rows, "transforms": transforms, **_totals(launches, rows, transforms, sizes)}


def _row(launch: offline_compilation.Launch) -> dict[str, Any]:
    code = offline_compilation.code_of(launch, h200.CC)
    instructions = parse(offline_compilation.disassembled(code))
    warps_per_block = -(-int(np.prod(launch.block)) // 32)
    parts_us = h200.predicted_us(
        launch.name,
        instructions,
        registers=code.registers,
        grid=launch.grid,
        block=launch.block,
        arguments=launch.arguments,
    )
    loop = h200.main_loop(instructions) if launch.name in h200.LOOPS else []
    return {
        "kernel": launch.name,
        "grid": list(launch.grid),
        "block": list(launch.block),
        "registers": code.registers,
        "resident_warps": h200.resident_warps(code.registers, warps_per_block),
        "parts_us": {name: round(time_us, 2) for name, time_us in parts_us.items()},
        "least_us": round(max(time_us for name, time_us in parts_us.items() if name != "second cache"), 2),
        "us": round(max(parts_us.values()), 2),
        "loop": kinds(loop),
    }


def _without_loop(row: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name != "loop"}


def _transform_us(n_bytes: float) -> float:
    """Return the time of a transform whose passes each move ``n_bytes``, in microseconds."""
    assumed = h200.ASSUMED
    pass_us = max(1e6 * float(n_bytes) / h200.GPU["memory_bytes_s"], assumed["transform_kernel_us"])
    return round(assumed["transform_kernels"] * pass_us, 2)


def _loops(plans: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the instructions of each main loop, relative to the work of one pass."""
    rows = {row["kernel"]: row for plan in plans for row in plan["launches"] if row["kernel"] in h200.LOOPS}
    return [{"kernel": kernel, **_loop(h200.LOOPS[kernel], row["loop"])} for kernel, row in sorted(rows.items())]


def _loop(loop: h200.Loop, counts: dict[str, int]) -> dict[str, Any]:
    at_once = counts["loads"] // loop.loads
    return {
        "of": loop.of,
        "at_once": at_once,
        "points": loop.points,
        **{kind: count / at_once for kind, count in counts.items()},
        "all": sum(counts.values()) / at_once,
        "lines": loop.lines,
    }


def _totals(
    launches: list[offline_compilation.Launch],
    rows: list[dict[str, Any]],
    transforms: list[dict[str, Any]],
    sizes: dict[str, Any],
) -> dict[str, Any]:
    """Return the times of a single measurement, and the rates of many consecutive ones."""
    assumed = h200.ASSUMED
    up_us, down_us = (1e6 * sizes[name] / assumed["pcie_bytes_s"] for name in ("words_bytes", "image_bytes"))
    stage_us = 1e6 * sizes["words_bytes"] / assumed["copy_bytes_s"]
    n_kernels = len(rows) + len(transforms) * assumed["transform_kernels"]
    kernels_us = sum(row["us"] for row in rows) + sum(row["us"] for row in transforms)
    gpu_us = kernels_us + n_kernels * assumed["between_kernels_us"]
    with_graph_us = stage_us + assumed["graph_us"] + assumed["host_us"]
    launching_us = sum(_launching_us(launch) for launch in launches)
    launching_us += len(transforms) * assumed["transform_launch_us"]
    without_graph_us = stage_us + launching_us + assumed["host_us"]
    times_us = {
        "words to pinned memory": stage_us,
        "words up": up_us,
        "kernels": kernels_us,
        "between kernels": gpu_us - kernels_us,
        "image down": down_us,
        "processor": assumed["graph_us"] + assumed["host_us"],
    }
    return {
        "times_us": {name: round(time_us, 1) for name, time_us in times_us.items()},
        "one_ms": round(sum(times_us.values()) / 1e3, 3),
        "per_second": {
            "images left on the GPU": round(1e6 / max(with_graph_us, up_us, gpu_us)),
            "the same without a graph": round(1e6 / max(without_graph_us, up_us, gpu_us)),
            "images brought back": round(1e6 / max(with_graph_us, up_us, gpu_us, down_us)),
        },
    }


def _launching_us(launch: offline_compilation.Launch) -> float:
    n_arrays = sum(isinstance(each, np.ndarray) for each in launch.arguments.values())
    return h200.ASSUMED["launch_us"] + n_arrays * h200.ASSUMED["launch_array_us"]


def _ceiling(plan: dict[str, Any]) -> dict[str, Any]:
    """Return the share of its tighter ceiling that delay-and-sum would reach.

    The ceilings are the rate of samples from the first-level cache, and the rate of multiply-adds.
    """
    row = next(row for row in plan["launches"] if row["kernel"] == "delay_and_sum_envelope.fill")
    gpu = h200.GPU
    lanes = 32 * gpu["schedulers"]
    # per point: 8 bytes and 4 products
    clocks = {"first cache": 8 / gpu["cache_line_bytes"], "multiply-adds": 4 / lanes}
    n_terms = 32 * plan["accuracy"]["delay_taps"]
    points = plan["points"] * n_terms
    times_us = {name: 1e6 * points * clock / gpu["multiprocessors"] / gpu["clock_hz"] for name, clock in clocks.items()}
    return {
        "points": points,
        "ceilings_us": {name: round(time_us, 1) for name, time_us in times_us.items()},
        "least_us": row["least_us"],
        "us": row["us"],
        "of_ceiling": [round(max(times_us.values()) / row[name], 2) for name in ("us", "least_us")],
    }

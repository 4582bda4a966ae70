"""Dependence of occupied cells on the place of cell edges, in the example of a platform in a room."""

import importlib.resources
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

import ertis_numba as ertis
from ertis_bench import machine
from ertis_bench.markdown import table
from ertis_numba.frames import Energyscape, Trajectory
from ertis_numba.fusion import Fused
from ertis_numba.simulation import Scene, load_scene

__all__ = ["compared", "form", "run"]

Floats = NDArray[np.float64]

_N_PULSES: Final = 6, 11
_N_SHIFTS: Final = 16
_CELL_M: Final = 0.05
_NEAR_M: Final = 1.5 * _CELL_M + 1e-6


def run(*, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Map the example with all poses moved by a part of a cell."""
    scene = _example()
    mountings = {each.name: (each.position_m or (), each.quaternion().tolist()) for each in scene.sensors}
    shifts_m = np.random.default_rng(seed).uniform(0, _CELL_M, (_N_SHIFTS, 2))
    rows = []
    for count in _N_PULSES:
        pulses, path = _pulses(scene, mountings, count)
        places = [_occupied_m(pulses, path, mountings, shift_m) for shift_m in shifts_m]
        rows.append({"pulses": count, **compared(places)})
        say(f"{rows[-1]}")
    return {"machine": machine.describe(), "shifts": {"seed": seed, "rows": rows}}


def _example() -> Scene:
    file = importlib.resources.files("ertis_examples.synthetic") / "scenes" / "moving_platform.toml"
    with importlib.resources.as_file(file) as path:
        return load_scene(path)


def _pulses(
    scene: Scene, mountings: Mapping[str, Any], count: int
) -> tuple[list[tuple[list[Energyscape], Fused]], Trajectory]:
    """Return images and fused images of a number of pulses along the path of the scene, and the poses."""
    platform = scene.platform
    assert platform is not None  # noqa: S101  the example has one
    scene = scene.replace(rate_hz=scene.rate_hz * (count - 1) / (scene.count - 1), count=count)
    fuser, pulses = ertis.Fuser(mountings), []
    simulators = [(ertis.Simulator(scene, sensor=each.name), each.settings()) for each in scene.sensors]
    pipelines = [ertis.Pipeline(settings, predict=False) for _, settings in simulators]
    for number in range(count):
        images = [
            pipeline.process(simulator.render(number))
            for (simulator, _), pipeline in zip(simulators, pipelines, strict=True)
        ]
        pulses.append((images, fuser(images)))
    path = platform.trajectory(np.arange(count) / scene.rate_hz)
    times_ns = np.array([images[0].stamp.timestamp_ns for images, _ in pulses])
    return pulses, Trajectory(times_ns, path.position_m, path.rotation_xyzw)


def _occupied_m(
    pulses: list[tuple[list[Energyscape], Fused]], path: Trajectory, mountings: Mapping[str, Any], shift_m: Floats
) -> Floats:
    """Return the occupied places of a map from shifted poses, without the shift: (cell, axis) float64."""
    mapper = ertis.Mapper(mountings, cell_m=_CELL_M)
    shifted = path.replace(position_m=path.position_m + np.append(shift_m, 0.0))
    for images, fused in pulses:
        mapper.add(images, shifted, fused=fused)
    return np.asarray(mapper.map.occupied_m - shift_m)


def compared(places_m: list[Floats]) -> dict[str, Any]:
    """Return numbers of occupied cells, and shares that are also occupied, within 1.5 cells, in another map."""
    counts = [len(each) for each in places_m]
    shares = [
        float(np.mean(KDTree(other).query(one)[0] < _NEAR_M))
        for one in places_m
        for other in places_m
        if one is not other
    ]
    return {
        "mean": float(np.mean(counts)),
        "least": min(counts),
        "most": max(counts),
        "shared": float(np.mean(shares)),
        "least_shared": min(shares),
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = ["pulses", "occupied cells (least–most)", "also occupied in another map (least)"]
    rows = [
        [
            str(row["pulses"]),
            f"{row['mean']:.0f} ({row['least']}–{row['most']})",
            f"{row['shared']:.1%} ({row['least_shared']:.1%})",
        ]
        for row in report["shifts"]["rows"]
    ]
    return (
        f"{table(head, rows)}\n\nThe example `moving_platform`, with pulses along the same path, in {_N_SHIFTS} maps "
        f"with cells of {100 * _CELL_M:g} cm whose poses are all moved by a random part of a cell. The last column is "
        "the share of occupied cells of one map with the centre of an occupied cell of another map within 7.5 cm."
    )

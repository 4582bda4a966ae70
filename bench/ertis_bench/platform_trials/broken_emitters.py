"""Emitters that are broken or stated wrongly, on random platforms."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from ertis_bench.markdown import table
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M, platform_scene, random_reflectors
from ertis_numba.frames import Energyscape
from ertis_numba.fusion import Fuser
from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import Scene
from ertis_numba.simulation.render import Simulator

__all__ = ["form", "run"]

_N_PULSES: Final = 3  # within which a broken emitter is to be named


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Fuse platforms whose emitters all work, and with a broken one, as stated and as the other kind.

    Parameters
    ----------
    count, seed : int
        Number of platforms for each kind of emitter, and seed of the first one.
    say : callable
        Function that reports progress.
    """
    rows = []
    for diameter_m, other_m in zip(EMITTERS_M, EMITTERS_M[::-1], strict=True):
        row = {"diameter_m": diameter_m, "platforms": count, "pulses": count * _N_PULSES}
        row |= dict.fromkeys(("named", "others", "accused", "contradicted", "found"), 0)
        for number in range(seed, seed + count):
            scene = platform_scene(number, random_reflectors(number), diameter_m)
            broken = str(np.random.default_rng([number, 42]).choice([each.name for each in scene.sensors]))
            pulses = [_images(scene, pulse) for pulse in range(_N_PULSES)]
            fuser, names = _fused(scene, pulses, diameter_m)
            row["accused"] += sum(map(bool, names))
            row["contradicted"] += fuser.emitter_warning() is not None
            row["found"] += _fused(scene, pulses, other_m)[0].emitter_warning() is not None
            silent = [_images(scene, pulse, broken) for pulse in range(_N_PULSES)]
            found = {name for each in _fused(scene, silent, diameter_m)[1] for name in each}
            row["named"] += broken in found
            row["others"] += bool(found - {broken})
            say(f"platform {number}, emitters of {1000 * diameter_m:g} mm: {broken} broken, {sorted(found)} named")
        rows.append(row)
    return {"count": count, "seed": seed, "emitters": rows}


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = [
        "emitters",
        "broken ones named",
        "others named then",
        "pulses of working emitters with a name",
        "warnings if stated rightly",
        "warnings if stated wrongly",
    ]
    rows = [
        [
            f"{1000 * row['diameter_m']:g} mm" if row["diameter_m"] else "omnidirectional",
            *(f"{row[key]} of {row['platforms']}" for key in ("named", "others")),
            f"{row['accused']} of {row['pulses']}",
            *(f"{row[key]} of {row['platforms']}" for key in ("contradicted", "found")),
        ]
        for row in report["emitters"]
    ]
    return (
        f"{table(head, rows)}\n\n{report['count']} platforms at rest with four sensors, among ten random reflectors, "
        f"from seed {report['seed']}, {_N_PULSES} SYNC pulses each. Echoes show that a piston is broken only if a "
        "reflector stands in its beam and in that of a neighbour."
    )


def _fused(scene: Scene, pulses: list[list[Energyscape]], diameter_m: float) -> tuple[Fuser, list[tuple[str, ...]]]:
    """Return the fuser of pulses, and the sensors that it names in each of them."""
    mountings: Mapping[str, Any] = {
        each.name: (each.position_m or (), each.quaternion().tolist()) for each in scene.sensors
    }
    fuser = Fuser(mountings, emitter_diameter_m=diameter_m)
    return fuser, [fuser(images).unheard for images in pulses]


def _images(scene: Scene, pulse: int, broken: str = "") -> list[Energyscape]:
    """Return the images of a pulse, with an emitter that is silent although its sensor believes that it emits."""
    sensors = tuple(each.replace(emitter=each.emitter.replace(silent=each.name == broken)) for each in scene.sensors)
    scene, found = scene.replace(sensors=sensors), []
    for sensor in sensors:
        with Pipeline(sensor.settings(), predict=False) as pipeline:
            image = pipeline.process(Simulator(scene, sensor=sensor.name).render(pulse))
        found.append(image.replace(stamp=replace(image.stamp, behaviour="active")))
    return found

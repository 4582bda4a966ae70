"""Fusion of sensors that emit in sequence, for several delays from sensor to sensor."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from ertis_bench.markdown import table
from ertis_bench.platform_trials.differing_calls import compared, points_of
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M, N_REFLECTORS, platform_scene, random_reflectors

__all__ = ["form", "run"]

_DELAYS_MS: Final = 0.0, 1.0, 2.0, 3.0, 4.0  # With longer delays, a record does not reach 4 m.


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the reflectors that points locate, and the points without a reflector, by delay."""
    rows = []
    for diameter_m in EMITTERS_M:
        for delay_ms in _DELAYS_MS:
            errors, spurious = [], 0
            for number in range(seed, seed + count):
                scene = platform_scene(number, random_reflectors(number), diameter_m)
                sensors = tuple(
                    each.replace(call=each.call.replace(delay_s=1e-3 * delay_ms * place))
                    for place, each in enumerate(scene.sensors)
                )
                scene = scene.replace(sensors=sensors)
                cloud, _ = points_of(scene, diameter_m, with_pairs=False)
                here, others = compared(cloud, scene)
                errors += here
                spurious += others
            say(f"delays of {delay_ms:g} ms, emitters of {1000 * diameter_m:g} mm: {spurious} points without reflector")
            rows.append(
                {
                    "diameter_m": diameter_m,
                    "delay_ms": delay_ms,
                    "located": len(errors),
                    "rms_m": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
                    "spurious": spurious,
                }
            )
    return {"count": count, "seed": seed, "delays": rows}


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = ["emitters", "delay", "reflectors located", "position RMS", "points without a reflector"]
    rows = [
        [
            f"{1000 * row['diameter_m']:g} mm" if row["diameter_m"] else "omnidirectional",
            f"{row['delay_ms']:g} ms",
            f"{row['located']} of {N_REFLECTORS * report['count']}",
            f"{1000 * row['rms_m']:.1f} mm" if row["rms_m"] is not None else "–",
            str(row["spurious"]),
        ]
        for row in report["delays"]
    ]
    return (
        f"{table(head, rows)}\n\n{report['count']} scenes of {N_REFLECTORS} reflectors from seed {report['seed']}, "
        "0.9 to 3.2 m from the platform. Its four sensors emit one after another, with the same delay from each to the "
        "next one. Points count as in the table of different calls."
    )

"""Check of clocks and mountings by direct sound, on random platforms with and without errors."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M, platform_scene, random_reflectors
from ertis_numba.fusion import DirectSoundCheck
from ertis_numba.settings import Processing, Recording
from ertis_numba.simulation import Scene
from ertis_numba.simulation.effect_plan import EffectPlan, Verdict
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.render import Simulator

__all__ = ["PlatformTrial", "form", "run"]

_RATE_HZ: Final = 20.0
_LATE: Final = 20
"""Number of the measurement one second after a SYNC pulse, when a drift of 1 ppm is an error of 1 µs."""
_CLOCK_US: Final = 20.0, 300.0  # Limits of errors of clocks, of either sign.
_MOUNTING_M: Final = 0.02, 0.1  # Limits of errors of mountings, in the plane.
# Images are not used, so effects that images do not show must not be left out.
_PLAN: Final = EffectPlan(
    tuple(Verdict(name=name, on=True, reason="all effects that apply", estimate_db=None) for name in EFFECTS)
)


class PlatformTrial(NamedTuple):
    """Platform with at most one fault.

    Attributes
    ----------
    sensor : str
        Sensor with the fault.
    clock_us : float
        Time by which it emits and records early.
    moved_m : (x, y, z)
        Error of its stated position.
    """

    sensor: str
    clock_us: float = 0.0
    moved_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Check platforms with right clocks, with a wrong clock, and with a wrong mounting."""
    rows = []
    for diameter_m in EMITTERS_M:
        heard, accused, found_clocks, found_mountings, errors_us = 0, 0, 0, 0, []
        for number in range(seed, seed + count):
            scene = _scene(number, diameter_m)
            draws = np.random.default_rng([number, 28])
            right, clock, mounting = _trials(scene, draws)
            check = _checked(scene, right)
            heard += len(check.sounds)
            accused += bool(check.warnings())
            warnings = _checked(scene, clock).warnings()
            if len(warnings) == 1 and warnings[0].startswith(f"{clock.sensor} emits and records "):
                found_clocks += 1
                errors_us.append(_stated_us(warnings[0]) - clock.clock_us)
            warnings = _checked(scene, mounting).warnings()
            found_mountings += bool(warnings) and all(_is_about(mounting.sensor, each) for each in warnings)
            say(f"platform {number}, emitters of {1000 * diameter_m:g} mm: {len(check.sounds)} direct sounds")
        rows.append(
            {
                "diameter_m": diameter_m,
                "platforms": count,
                "heard": heard / count,
                "accused": accused,
                "found_clocks": found_clocks,
                "clock_rms_us": float(np.sqrt(np.mean(np.square(errors_us)))) if errors_us else None,
                "found_mountings": found_mountings,
            }
        )
    return {"machine": machine.describe(), "count": count, "seed": seed, "clocks": rows}


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = [
        "emitters",
        "direct sounds heard",
        "correct platforms with a warning",
        "wrong clocks found (RMS error)",
        "wrong mountings found",
    ]
    rows = [
        [
            f"{1000 * row['diameter_m']:g} mm" if row["diameter_m"] else "omnidirectional",
            f"{row['heard']:.1f} of 12",
            f"{row['accused']} of {row['platforms']}",
            f"{row['found_clocks']} of {row['platforms']}"
            + (f" ({row['clock_rms_us']:.1f} µs)" if row["clock_rms_us"] is not None else ""),
            f"{row['found_mountings']} of {row['platforms']}",
        ]
        for row in report["clocks"]
    ]
    low_us, high_us = _CLOCK_US
    low_m, high_m = _MOUNTING_M
    return (
        f"{table(head, rows)}\n\n{report['count']} platforms of four sensors among random reflectors from seed "
        f"{report['seed']}, one SYNC pulse each, with the steps of the SYNC chain. A wrong clock is {low_us:g} to "
        f"{high_us:g} µs early or late, and a wrong mounting is off by {1000 * low_m:g} to {1000 * high_m:g} mm. "
        "Both count as found if the warnings name that sensor and, for clocks, no other one. "
        f"{sentence(report['machine'])}"
    )


def _scene(number: int, diameter_m: float) -> Scene:
    """Return a platform with short records, whose SYNC pulses come every two seconds."""
    scene = platform_scene(number, random_reflectors(number), diameter_m)
    sensors = tuple(
        each.replace(recording=Recording(n_samples=32_768), processing=Processing(range_m=(0.3, 0.6), directions="90"))
        for each in scene.sensors
    )
    return scene.replace(sensors=sensors, rate_hz=_RATE_HZ, sync_every=2 * _LATE)


def _trials(scene: Scene, draws: np.random.Generator) -> tuple[PlatformTrial, PlatformTrial, PlatformTrial]:
    """Return a platform without a fault, one with a wrong clock, and one with a wrong mounting."""
    names = [each.name for each in scene.sensors]
    late, aside = draws.choice(names, 2).tolist()
    clock_us = float(draws.choice([-1.0, 1.0]) * np.exp(draws.uniform(*np.log(_CLOCK_US))))
    turn_rad, far_m = draws.uniform(-np.pi, np.pi), np.exp(draws.uniform(*np.log(_MOUNTING_M)))
    moved_m = float(far_m * np.cos(turn_rad)), float(far_m * np.sin(turn_rad)), 0.0
    return PlatformTrial(names[0]), PlatformTrial(late, clock_us=clock_us), PlatformTrial(aside, moved_m=moved_m)


def _checked(scene: Scene, trial: PlatformTrial) -> DirectSoundCheck:
    """Return the check of one pulse of a platform with a fault."""
    sensors = tuple(
        each.replace(electronics=each.electronics.replace(clock_drift_ppm=trial.clock_us))
        if each.name == trial.sensor
        else each
        for each in scene.sensors
    )
    scene = scene.replace(sensors=sensors)
    mountings = {
        each.name: (
            np.add(each.position_m or (), trial.moved_m if each.name == trial.sensor else 0.0).tolist(),
            each.quaternion().tolist(),
        )
        for each in sensors
    }
    check = DirectSoundCheck(mountings)
    check.add([Simulator(scene, sensor=each.name, plan=_PLAN).render(_LATE) for each in sensors])
    return check


def _stated_us(warning: str) -> float:
    """Return the time by which a sensor is early according to a warning."""
    words = warning.split()
    return float(words[4]) * (1.0 if words[6] == "earlier" else -1.0)


def _is_about(sensor: str, warning: str) -> bool:
    """Return True if a warning is about a distance of a sensor."""
    return sensor in warning.split() and ("their mountings state" in warning or "direct sound of" in warning)

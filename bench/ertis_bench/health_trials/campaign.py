"""Trials of the health checks: false alarms in healthy arrays, and the share of injected faults that are named."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from ertis_bench.health_trials.faults import FAULTS, ArrayFault
from ertis_bench.health_trials.scenes import base, healthy
from ertis_numba.analysis.health import Health, health

__all__ = ["false_alarms", "named", "run"]

_SHORT, _LONG = (40, 1), (1000, 30)


def false_alarms(seed: int) -> tuple[str, dict[str, tuple[int, ...]]]:
    """Return the scene of a healthy array, and the faults that the checks report by mistake."""
    scene, measurement = healthy(seed)
    return scene, health(measurement).faults


def named(name: str, seed: int) -> tuple[bool, Health]:
    """Run one trial of a fault. Return True if the report names it on its channels, and the report."""
    fault = FAULTS[name]
    is_pdm = fault.encodings[seed % len(fault.encodings)]
    rng = np.random.default_rng((seed, list(FAULTS).index(name)))
    measurement, channels = fault.put_into(base(fault.scene, seed, is_pdm=is_pdm), rng)
    report = health(measurement)
    return _is_named(fault, channels, report), report


def _is_named(fault: ArrayFault, channels: tuple[int, ...], report: Health) -> bool:
    found = {
        channel
        for name, those in report.faults.items()
        if any(name.startswith(wanted) for wanted in fault.names)
        for channel in those
    }
    return bool(found) and set(channels) <= found


def run(*, long: bool, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the counts of all trials."""
    n_healthy, trials = _LONG if long else _SHORT
    alarms: list[dict[str, Any]] = []
    scenes: Counter[str] = Counter()
    for number in range(n_healthy):
        if number % 100 == 0:
            say(f"healthy arrays: {number} of {n_healthy}")
        scene, faults = false_alarms(seed + number)
        scenes[scene] += 1
        if faults:
            alarms.append({"seed": seed + number, "scene": scene, "faults": faults})
    rows = []
    counts = dict.fromkeys(FAULTS, 0)
    for trial in range(trials):  # All faults of a trial use the same recordings.
        say(f"faults: trial {trial + 1} of {trials}")
        for name in FAULTS:
            counts[name] += named(name, seed + trial)[0]
    for name, fault in FAULTS.items():
        rows.append(
            {
                "fault": name,
                "scene": fault.scene,
                "observable": fault.observable,
                "why": fault.why,
                "named": counts[name],
                "trials": trials,
            }
        )
    return {"seed": seed, "healthy": n_healthy, "scenes": dict(scenes), "alarms": alarms, "rows": rows, "long": long}

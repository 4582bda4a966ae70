"""Errors of the calibration of arrays with random faults.

Recordings of one reflector are simulated through PDM. Nothing is timed except the calibration itself.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ertis_bench import machine
from ertis_bench.error_trials.faulty_arrays import calibration_errors, faulty_array, image_losses, record
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_numba.calibration import calibrate

__all__ = ["FORMS", "form", "run"]

_QUANTITIES = ("gain (dB)", "delay (µs)", "x (mm)", "y (mm)", "z (mm)")
_RECORDINGS = 20
_HEALTHY_RECORDINGS = 8
_TWO_SIDED_95 = 1.96


def run(*, count: int, healthy: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Calibrate arrays with random errors and faults, and arrays without faults."""
    errors, deviations, losses, before, seconds, found = [], [], [], [], [], 0
    for number in range(seed, seed + count):
        array = faulty_array(number)
        measurements = record(array, number, _RECORDINGS)
        begin_s = time.perf_counter()
        made = calibrate(measurements, ideal=True)
        seconds.append(time.perf_counter() - begin_s)
        is_found = (
            {channel for cycle in made.swaps for channel in cycle} == set(array.displaced)
            and made.silent == array.dead
            and made.inverted == array.inverted
        )
        found += is_found
        errors.append(calibration_errors(array, made))
        deviations.append(made.sd)
        losses.append(image_losses(array, made))
        before.append(image_losses(array, made, calibrated=False))
        say(f"array {number}: {'all faults found' if is_found else 'faults differ'}, {seconds[-1]:.1f} s")
    false = 0
    for number in range(seed, seed + healthy):
        array = faulty_array(number, healthy=True)
        false += bool(calibrate(record(array, number, _HEALTHY_RECORDINGS), ideal=True).findings)
        say(f"healthy array {number}: {false} false findings so far")
    error, deviation = np.concatenate(errors), np.concatenate(deviations)
    rms, bound = np.sqrt(np.mean(error**2, axis=0)), np.sqrt(np.mean(deviation**2, axis=0))
    return {
        "machine": machine.describe(),
        "count": count,
        "healthy": healthy,
        "seed": seed,
        "found": found,
        "false": false,
        "rms": rms.tolist(),
        "bound": bound.tolist(),
        "within": np.mean(np.abs(error) < _TWO_SIDED_95 * deviation, axis=0).tolist(),
        "within_all": float(np.mean(np.abs(error) < _TWO_SIDED_95 * deviation)),
        "loss_db": max(loss for loss, _ in losses),
        "side_lobes_db": max(rise for _, rise in losses),
        "loss_before_db": max(loss for loss, _ in before),
        "side_lobes_before_db": max(rise for _, rise in before),
        "median_s": float(np.median(seconds)),
        "longest_s": max(seconds),
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    rows = [
        [name, f"{rms:.4f}", f"{bound:.4f}", f"{rms / bound:.2f}", f"{within:.1%}"]
        for name, rms, bound, within in zip(_QUANTITIES, report["rms"], report["bound"], report["within"], strict=True)
    ]
    head = ["quantity", "RMS error", "Cramér–Rao bound", "ratio", "errors within 95 % intervals"]
    return (
        f"{table(head, rows)}\n\n{report['count']} arrays eRTIS_v3D1 from seed {report['seed']}, each with "
        f"{_RECORDINGS} recordings of one reflector. All faults were found, and no other was named, in "
        f"{report['found']} of them; {report['false']} of {report['healthy']} arrays without faults, with "
        f"{_HEALTHY_RECORDINGS} recordings each, had a false finding. Relative to the perfectly known array, beams "
        f"lose at most {report['loss_db']:.3f} dB (before the calibration {report['loss_before_db']:.1f} dB), and "
        f"their side lobes are at most {report['side_lobes_db']:.2f} dB higher (before, "
        f"{report['side_lobes_before_db']:.1f} dB). Intervals contain {report['within_all']:.1%} of all errors. A "
        f"calibration takes {report['median_s']:.1f} s (median) to {report['longest_s']:.1f} s. "
        f"{sentence(report['machine'])}"
    )


FORMS = {"calibration": form}
"""Forms of the table, by the name in its markers."""

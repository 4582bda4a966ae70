"""Errors of ego-velocity in furnished rooms, and of odometry along the walls of a hall and in drawn scenes.

Images of rooms and halls are simulated through PDM. Nothing is timed except the estimates themselves.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

import ertis_numba as ertis
from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.platform_trials import drawn_odometry
from ertis_bench.platform_trials.furnished_rooms import (
    Motion,
    PlatformImager,
    hall,
    mountings,
    random_motion,
    random_room,
)

__all__ = ["FORMS", "form", "run"]

_TIME_S: Final = 0.1
_EVERY: Final = 2  # pulses of the hall, so that groups are 0.14 m apart
_TO_SHOWN: Final = np.array([1.0, 1.0, math.degrees(1.0)])


def run(
    *, count: int, length_m: float, seed: int, say: Callable[[str], None], only: Sequence[str] = ()
) -> dict[str, Any]:
    """Estimate velocities in random rooms, and the path through a hall."""
    if only:
        return drawn_odometry.run(count=count, seed=seed, say=say)
    errors, deviations, seconds = [], [], []
    for number in range(seed, seed + count):
        motion = random_motion(number)
        imager = PlatformImager(random_room(number), number)
        before, after = imager(motion, 0, 0.0), imager(motion.after(_TIME_S), 1, _TIME_S)
        imager.close()
        begin_s = time.process_time()
        found = ertis.ego_velocity(before, after, mountings())
        seconds.append(time.process_time() - begin_s)
        estimate = np.array([*found.velocity_m_s, found.yaw_rate_rad_s])
        errors.append((estimate - [motion.forward_m_s, motion.left_m_s, motion.yaw_rate_rad_s]) * _TO_SHOWN)
        deviations.append(found.sd * _TO_SHOWN)
        say(f"room {number}: errors {errors[-1].round(4).tolist()}")
    error, deviation = np.array(errors), np.array(deviations)
    return {
        "machine": machine.describe(),
        "count": count,
        "seed": seed,
        "rms": np.sqrt(np.mean(error**2, axis=0)).tolist(),
        "predicted": np.sqrt(np.mean(deviation**2, axis=0)).tolist(),
        "largest": np.max(np.abs(error), axis=0).tolist(),
        "median_s": float(np.median(seconds)),
        "hall": _hall(seed, length_m, say) if length_m else None,
    }


def _hall(seed: int, length_m: float, say: Callable[[str], None]) -> dict[str, Any]:
    """Return errors of odometry along a closed path through a hall."""
    scene = hall(seed)
    assert scene.platform is not None  # noqa: S101  halls have one
    n_pulses = min(scene.count, round(length_m * scene.rate_hz))  # at 1 m/s
    times_s = [number / scene.rate_hz for number in range(0, n_pulses, _EVERY)]
    motions = [Motion.of(scene.platform, time_s) for time_s in times_s]
    imager = PlatformImager((scene.points, ()), seed, max_range_m=5.0)
    odometry = ertis.Odometry(mountings())
    start = motions[0]
    c, s = math.cos(start.yaw_rad), math.sin(start.yaw_rad)
    errors_m, predicted_m, squares, unmeasured = [], [], [], 0
    for number, (motion, time_s) in enumerate(zip(motions, times_s, strict=True)):
        odometry.add(imager(motion, number, time_s))
        pose = odometry.poses[-1]
        x, y = motion.x_m - start.x_m, motion.y_m - start.y_m
        turn_rad = math.remainder(pose.yaw_rad - motion.yaw_rad + start.yaw_rad, 2 * math.pi)
        error = np.array([pose.x_m - c * x - s * y, pose.y_m + s * x - c * y, turn_rad])
        errors_m.append(math.hypot(*error[:2]))
        predicted_m.append(float(np.sqrt(np.trace(pose.covariance[:2, :2]))))
        if number:  # The first pose is exact.
            squares.append(float(error @ np.linalg.solve(pose.covariance, error)))
        unmeasured += not pose.is_measured
        if number % 20 == 0:
            say(f"group {number} of {len(motions)}: {errors_m[-1]:.3f} m off after {odometry.length_m:.1f} m")
    imager.close()
    return {
        "length_m": times_s[-1],  # at 1 m/s
        "n_groups": len(motions),
        "unmeasured": unmeasured,
        "end_m": errors_m[-1],
        "largest_m": max(errors_m),
        "yaw_deg": math.degrees(turn_rad),
        "predicted_m": predicted_m[-1],
        "ratio": math.sqrt(np.mean(np.square(errors_m)) / np.mean(np.square(predicted_m))),
        "normalised": float(np.mean(squares)) / 3,
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    if "scenes" in report:
        return drawn_odometry.form(report)
    names = ("forward (m/s)", "left (m/s)", "yaw rate (°/s)")
    rows = [
        [name, f"{rms:.4f}", f"{predicted:.4f}", f"{rms / predicted:.2f}", f"{largest:.4f}"]
        for name, rms, predicted, largest in zip(
            names, report["rms"], report["predicted"], report["largest"], strict=True
        )
    ]
    text = (
        f"{table(['quantity', 'RMS error', 'predicted', 'ratio', 'largest error'], rows)}\n\n"
        f"{report['count']} furnished rooms from seed {report['seed']}, with four sensors that emit together, at up to "
        f"1.5 m/s and 90°/s, from two groups of images {_TIME_S:g} s apart. An estimate takes "
        f"{1e3 * report['median_s']:.0f} ms of processor time (median)."
    )
    hall = report["hall"]
    if hall:
        text += (
            f" Odometry over {hall['length_m']:.0f} m of a hall at 1 m/s, {hall['n_groups']} groups: "
            f"{hall['end_m']:.2f} m off at the end, {hall['end_m'] / hall['length_m']:.1%} of the path (predicted "
            f"{hall['predicted_m']:.2f} m), and {hall['largest_m']:.2f} m at most. Yaw is "
            f"{abs(hall['yaw_deg']):.1f}° off at the end. Groups with too few matches: {hall['unmeasured']}. "
            f"Over the path, the RMS error of the position is "
            f"{hall['ratio']:.2f} times the predicted one. The mean normalised squared error of position and yaw is "
            f"{hall['normalised']:.2f} times its expectation."
        )
    return f"{text} {sentence(report['machine'])}"


FORMS = {"motion": form}
"""Forms of the table, by the name in its markers."""

"""Errors of odometry relative to their covariances, in random scenes with images of an independent renderer."""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

import ertis_numba as ertis
from ertis_bench import machine
from ertis_bench.markdown import or_dash, table
from ertis_bench.platform_trials.drawn_images import DrawnImager, DrawnScene
from ertis_bench.platform_trials.drawn_scenes import KINDS, drawn_scene
from ertis_numba.frames import Energyscape

__all__ = ["DrawnSteps", "form", "run", "tried"]

Floats = NDArray[np.float64]

_FAR_SD: Final = 5.0
_FLOOR: Final = 1e-12 * np.eye(3)  # A platform may stay exactly where it was.


class DrawnSteps(NamedTuple):
    """Steps of one scene.

    Attributes
    ----------
    error : (step, 3) float64
        Errors of velocity and yaw rate; NaN where the motion is unknown.
    covariance : (step, 3, 3) float64
    doubt : list of str
    end_error : (3,) float64
        Error of the last pose.
    end_covariance : (3, 3) float64
    """

    error: Floats
    covariance: Floats
    doubt: list[str]
    end_error: Floats
    end_covariance: Floats


def tried(scene: DrawnScene, groups: Sequence[Sequence[Energyscape]]) -> DrawnSteps:
    """Return the errors of odometry with the images of a scene."""
    odometry = ertis.Odometry(scene.platform, alone=len(scene.mountings) == 1 or None)
    poses = scene.path.at(scene.pulses_s)
    errors, covariances = [], []
    for number, group in enumerate(groups):
        velocity = odometry.add(group)
        if number:
            true = _twist(poses[:, number - 1], poses[:, number], scene.pulses_s[number] - scene.pulses_s[number - 1])
            unknown = np.full(3, np.nan)
            errors.append(unknown if velocity is None else [*velocity.velocity_m_s, velocity.yaw_rate_rad_s] - true)
            covariances.append(np.eye(3) if velocity is None else velocity.covariance)
    last = odometry.poses[-1]
    x_m, y_m, yaw_rad = (poses[:, -1] - poses[:, 0]).tolist()
    turn = math.remainder(last.yaw_rad - yaw_rad, 2 * math.pi)
    end_error = np.array([last.x_m - x_m, last.y_m - y_m, turn])
    doubts: list[str] = [pose.doubt for pose in odometry.poses[1:]]
    return DrawnSteps(np.array(errors), np.array(covariances), doubts, end_error, last.covariance)


def _twist(before: Floats, after: Floats, time_s: float) -> Floats:
    """Return the constant velocity between two poses: forward, left and yaw rate."""
    yaw_rad = float(after[2] - before[2])
    way = complex(*(after - before)[:2]) * np.exp(-1j * (before[2] + yaw_rad / 2)) / np.sinc(yaw_rad / 2 / math.pi)
    return np.array([way.real, way.imag, yaw_rad]) / time_s


def run(*, count: int, seed: int, say: Callable[[str], None], kinds: Sequence[str] = tuple(KINDS)) -> dict[str, Any]:
    """Run odometry in random scenes of all kinds."""
    imager, rows = DrawnImager(), []
    for kind in kinds:
        trials = []
        for number in range(seed, seed + count):
            scene, draws = drawn_scene(kind, number)
            groups = [imager(scene, pulse, draws) for pulse in range(len(scene.pulses_s))]
            trials.append(tried(scene, groups))
            largest = _largest(trials[-1])
            if largest > _FAR_SD:
                say(f"{kind}, seed {number}: an error of {largest:.1f} standard deviations")
        rows.append({"name": KINDS[kind][0], **_row(trials)})
        say(f"{rows[-1]}")
    return {"machine": machine.describe(), "scenes": {"count": count, "seed": seed, "rows": rows}}


def _scaled(trial: DrawnSteps) -> tuple[Floats, Floats]:
    """Return the largest error in standard deviations, and the NEES / 3, of each measured step."""
    known = ~np.isnan(trial.error[:, 0])
    error, covariance = trial.error[known], trial.covariance[known]
    largest = np.abs(error / np.sqrt(np.einsum("sxx->sx", covariance))).max(axis=1, initial=0.0)
    return largest, np.einsum("sx,sxy,sy->s", error, np.linalg.inv(covariance), error) / 3


def _largest(trial: DrawnSteps) -> float:
    return float(_scaled(trial)[0].max(initial=0.0))


def _row(trials: Sequence[DrawnSteps]) -> dict[str, Any]:
    largest, squares = (np.concatenate(parts) for parts in zip(*(_scaled(trial) for trial in trials), strict=True))
    ends = [
        float(trial.end_error @ np.linalg.solve(trial.end_covariance + _FLOOR, trial.end_error)) / 3 for trial in trials
    ]
    doubts = [doubt for trial in trials for doubt in trial.doubt]
    return {
        "steps": len(doubts),
        "measured": len(largest),
        "few_echoes": doubts.count("few echoes"),
        "other_motion": doubts.count("other motion"),
        "nees": float(squares.mean()) if len(squares) else None,
        "largest_sd": float(largest.max()) if len(largest) else None,
        "far": int(np.sum(largest > _FAR_SD)),
        "end_nees": float(np.mean(ends)),
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    scenes = report["scenes"]
    head = ["scenes", "steps", "measured", "few echoes", "other motion", "NEES", "largest error", "NEES of the end"]
    rows = [
        [
            row["name"],
            str(row["steps"]),
            str(row["measured"]),
            str(row["few_echoes"]),
            str(row["other_motion"]),
            or_dash(row["nees"], 2),
            f"{row['largest_sd']:.1f} σ" if row["measured"] else "–",
            or_dash(row["end_nees"], 2),
        ]
        for row in scenes["rows"]
    ]
    measured = sum(row["measured"] for row in scenes["rows"])
    far = sum(row["far"] for row in scenes["rows"])
    return (
        f"{table(head, rows)}\n\n{scenes['count']} scenes of each kind from seed {scenes['seed']}, with images of an "
        "independent renderer, mostly of eight pulses 0.1 s apart. Emitters are omnidirectional or 12 mm wide. NEES is "
        "the mean normalised squared error of velocity and yaw rate over the measured steps, divided by its "
        "expectation of 3, and that of the last pose. The largest error is that of one component, in its standard "
        f"deviations. {far} of {measured} measured steps are more than {_FAR_SD:g} standard deviations off."
    )

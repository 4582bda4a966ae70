"""Poses of a file, row by row, and the trajectory that they form."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.base.units import counted
from ertis_numba.frames import PoseAxes, Trajectory
from ertis_numba.frames.pose_doubts import pose_doubts

__all__ = ["PoseRows", "trajectory_of"]

Floats = NDArray[np.float64]

_MAX_NORM_ERROR: Final = 0.05  # Quaternions with two digits have such errors; others are no quaternions.
_ROUNDING: Final = 1e-3  # Error in the length of a quaternion that needs no note.
_SAME_M: Final = 0.2  # Largest difference between two rows for one time. A platform at 2 m/s moves by it in 0.1 s.
_SAME_DEG: Final = 10.0
_LONG_S: Final = 1.0  # Interval in which a platform may have gone anywhere.
_UNUSUAL: Final = 5.0  # Ratio of a gap to the median interval.
_MAX_POSITION_M: Final = 1e8  # As for Trajectory.


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """Poses of a file, as its rows state them."""

    kind: str  # name of a row in messages: "line" or "message"
    numbers: NDArray[np.int64]  # (row,) from 1
    time_ns: NDArray[np.int64]  # (row,)
    position_m: Floats  # (row, 3), NaN where the file has no number
    rotation_xyzw: Floats  # (row, 4), likewise
    covariance: Floats | None = None  # (row, 6, 6)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.numbers)

    def name(self, row: np.intp | int) -> str:
        """Return the name of a row in messages, such as "line 3"."""
        return f"{self.kind} {self.numbers[row]}"

    def count(self, n_rows: int) -> str:
        """Return a number of rows in messages, such as "3 lines"."""
        return f"{counted(n_rows, self.kind)}"

    def kept(self, is_kept: NDArray[np.bool_], note: str) -> "PoseRows":
        """Return some rows, and a note on the others."""
        return PoseRows(
            self.kind,
            self.numbers[is_kept],
            self.time_ns[is_kept],
            self.position_m[is_kept],
            self.rotation_xyzw[is_kept],
            None if self.covariance is None else self.covariance[is_kept],
            (*self.notes, note),
        )


def trajectory_of(rows: PoseRows, pose_axes: PoseAxes = "platform") -> Trajectory:
    """Return the trajectory that rows form, with notes on the rows that were left out or changed."""
    rows = _complete(rows)
    if not len(rows):
        raise DataError("; ".join(("the file contains no complete pose", *rows.notes, "choose a file with poses")))
    _require_places(rows)
    rows = _normalised(rows)
    rows = _one_per_time(rows)
    try:
        made = Trajectory(rows.time_ns, rows.position_m, rows.rotation_xyzw, rows.covariance, source="file")
    except ArgumentError as error:
        raise DataError(str(error)) from error
    made = made.converted(pose_axes)
    return made.replace(notes=(*rows.notes, *filter(None, [_gap_note(rows)]), *pose_doubts(made)))


def _gap_note(rows: PoseRows) -> str | None:
    """Return a note if some intervals between poses are long, and longer than usual."""
    steps_s = np.diff(rows.time_ns) / 1e9
    if not len(steps_s):
        return None
    gaps = np.flatnonzero((steps_s > _LONG_S) & (steps_s > _UNUSUAL * np.median(steps_s)))
    if not gaps.size:
        return None
    worst = gaps[np.argmax(steps_s[gaps])]
    return (
        f"{counted(len(gaps), 'gap')} of more than {_LONG_S:g} s between poses, bridged by interpolation; "
        f"the longest lasts {steps_s[worst]:.3g} s after {rows.name(worst)}"
    )


def _complete(rows: PoseRows) -> PoseRows:
    """Leave out rows with NaN, which programs write where they have lost the platform."""
    is_unknown = np.asarray(np.isnan(np.column_stack([rows.position_m, rows.rotation_xyzw])).any(axis=1))
    if not is_unknown.any():
        return rows
    first = rows.name(np.argmax(is_unknown))
    n_unknown = int(is_unknown.sum())
    return rows.kept(
        ~is_unknown, f"{n_unknown} of {rows.count(len(rows))} left out because numbers are missing, first {first}"
    )


def _require_places(rows: PoseRows) -> None:
    beyond = np.flatnonzero(~(np.abs(rows.position_m) <= _MAX_POSITION_M).all(axis=1))
    if beyond.size:
        place = " ".join(f"{each:g}" for each in rows.position_m[beyond[0]])
        raise DataError(
            f"{rows.name(beyond[0])} has position_m {place}; positions must be in metres, within "
            f"±{_MAX_POSITION_M:g} m of the world's origin"
        )


def _normalised(rows: PoseRows) -> PoseRows:
    """Return unit quaternions, and a note if the lengths differ from 1 by more than rounding."""
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(rows.rotation_xyzw, axis=1)
    errors = np.abs(lengths - 1)
    wrong = np.flatnonzero(~(errors <= _MAX_NORM_ERROR))
    if wrong.size:
        numbers = " ".join(f"{each:g}" for each in rows.rotation_xyzw[wrong[0]])
        raise DataError(
            f"{rows.name(wrong[0])}: rotation_xyzw has length {lengths[wrong[0]]:g} ({numbers}), but must be a unit "
            f"quaternion x, y, z, w; correct or remove {rows.count(len(wrong))}"
        )
    if errors.max() <= _ROUNDING:
        return rows
    count = int(np.count_nonzero(errors > _ROUNDING))
    worst = np.argmax(errors)
    note = (
        f"quaternions of {rows.count(count)} were scaled to length 1; the largest deviation is "
        f"{100 * errors[worst]:.1f} % in {rows.name(worst)}"
    )
    return replace(rows, rotation_xyzw=rows.rotation_xyzw / lengths[:, None], notes=(*rows.notes, note))


def _one_per_time(rows: PoseRows) -> PoseRows:
    """Return one row for each time: the first one."""
    steps_ns = np.diff(rows.time_ns)
    if (steps_ns < 0).any():
        late = int(np.argmax(steps_ns < 0)) + 1
        raise DataError(
            f"time_ns does not increase: {rows.name(late)} is {-steps_ns[late - 1] / 1e9:.9g} s before the "
            f"{rows.kind} before; sort the {rows.kind}s by time, or split a file of several runs"
        )
    repeated = np.flatnonzero(steps_ns == 0) + 1
    if not repeated.size:
        return rows
    is_first = np.append(True, steps_ns > 0)
    kept = np.maximum.accumulate(np.where(is_first, np.arange(len(rows)), 0))[repeated]
    away_m = np.linalg.norm(rows.position_m[repeated] - rows.position_m[kept], axis=1)
    away_deg = _angles_deg(rows.rotation_xyzw[kept], rows.rotation_xyzw[repeated])
    worst = int(np.argmax(np.maximum(away_m / _SAME_M, away_deg / _SAME_DEG)))
    between = f"{rows.name(kept[worst])} and {rows.name(repeated[worst])}"
    if away_m[worst] > _SAME_M or away_deg[worst] > _SAME_DEG:
        raise DataError(
            f"{between} have the same time, but poses {away_m[worst]:.3g} m and {away_deg[worst]:.3g}° apart; remove "
            "one of them, or write the times with all digits"
        )
    if 2 * np.count_nonzero(away_m > 0) > len(rows):
        raise DataError(
            f"{len(repeated)} of {rows.count(len(rows))} repeat the time of an earlier {rows.kind} with another pose; "
            "write the times with all digits"
        )
    differences = "the same pose"
    if away_m.any() or away_deg.any():
        differences = f"poses up to {away_m.max():.2g} m and {away_deg.max():.2g}° apart ({between})"
    note = f"{rows.count(len(repeated))} left out because an earlier {rows.kind} has the same time and {differences}"
    return rows.kept(is_first, note)


def _angles_deg(one: Floats, other: Floats) -> Floats:
    """Return the angles between rotations of quaternions whose lengths are nearly 1, exact for small ones."""
    one, other = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (one, other))
    chord = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    return np.asarray(np.degrees(4 * np.arcsin(np.minimum(chord / 2, 1.0))))

"""Poses in text files: TUM, tables with a header such as those of EuRoC, and KITTI."""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.base.units import counted
from ertis_numba.interop._pose_rows import PoseRows
from ertis_numba.interop._pose_times import times_of

__all__ = ["TUM", "read_table"]

Floats = NDArray[np.float64]
Row = tuple[int, list[str]]
"""Number of a line, and its cells."""

TUM: Final = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""Columns of a text file of TUM."""
_N_KITTI: Final = 12
_DIGITS_OF_NS: Final = 17
_COLUMNS: Final = (
    "time_ns or time_s (or dates as time), x_m, y_m, z_m (optional), and either qx, qy, qz, qw or yaw_deg or yaw_rad, "
    "with roll and pitch likewise (optional)"
)
_EXAMPLE: Final = "such as time_s,x_m,y_m,z_m,qx,qy,qz,qw, in the order of the columns"
_TIME: Final = re.compile(r"(?:time|timestamp|stamp|t)(?:_(s|ms|us|ns))?")
_POSITION: Final = re.compile(r"(?:([xyz])_m|t([xyz])|p_([xyz])|p_rs_r_([xyz]))")
_IN_METRES: Final = re.compile(r"(?:p|pos|position|t)?_?([xyz])")
_ROTATION: Final = re.compile(r"(?:q|q_|q_rs_|quat_|rot_|rotation_|orientation_)([xyzw])")
_BARE: Final = "columns of positions state no unit and are read as metres; name them x_m, y_m and z_m"
_ANGLE: Final = re.compile(r"(roll|pitch|yaw)(?:_(deg|rad))?")
_DEGREES: Final = {"deg": 1.0, "°": 1.0, "degrees": 1.0, "rad": 180 / math.pi, "radians": 180 / math.pi}
_PLACES: Final = re.compile(r"[xyz]_|alt|height", re.IGNORECASE)
_UNREAD: Final = re.compile(r"[xyz]_[mcd]m|(?:alt|altitude|height)(?:_m)?|(?:roll|pitch|yaw|heading|theta)(?:_\w+)?")
"""Names that change poses, if they are not read otherwise."""
_MANY_TURNS_RAD: Final = 50.0
_UNITS: Final = {
    "sec": "s",
    "secs": "s",
    "seconds": "s",
    "msec": "ms",
    "usec": "us",
    "µs": "us",
    "μs": "us",
    "nsec": "ns",
}
_DECIMAL_COMMAS: Final = re.compile(r"(?:[-+]?\d+(?:,\d+)?(?:e[-+]?\d+)?(?:\s+|$))+", re.IGNORECASE)
"""Numbers between spaces, whose commas are therefore those of decimals."""
_NAMED: Final = re.compile(r"([^\[(]+?)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?")  # name [unit]
_SPACED_UNIT: Final = re.compile(r"\s+(?=[\[(])")
_UNKNOWN: Final = ("", "null", "none", "na", "n/a", "nan(ind)", "-nan(ind)")
_SENSORS: Final = {"w_rs_s_x": "an IMU", "a_rs_s_x": "an IMU", "filename": "a camera"}


class _Columns(NamedTuple):
    """Places of the columns in a row."""

    time: int
    unit: str | None
    axes: dict[str, int]
    quaternion: dict[str, int]
    angles: dict[str, tuple[int, float]]
    """Places of roll, pitch and yaw, and the degrees in their unit."""
    n_fields: int
    is_bare: bool = False
    """True if the names of positions state no unit."""

    @property
    def is_complete(self) -> bool:
        has_rotation = len(self.quaternion) == len("xyzw") or ("yaw" in self.angles and not self.quaternion)
        return self.time >= 0 and {*"xy"} <= self.axes.keys() and has_rotation


_ORDER_OF_TUM: Final = _Columns(0, None, {"x": 1, "y": 2, "z": 3}, {"x": 4, "y": 5, "z": 6, "w": 7}, {}, len(TUM))


def read_table(text: str, *, needs_header: bool, time_unit: str | None, times: str | None = None) -> PoseRows:
    """Return the poses of a text."""
    # `needs_header` refuses rows of TUM or KITTI; `times` is a text with one time per pose of KITTI.
    columns, rows = _header(text, needs_header=needs_header)
    if not rows:
        raise DataError("the file contains no poses; choose a file with at least one")
    if columns is None and all(not cells[-1] for _, cells in rows):
        rows = [(number, cells[:-1]) for number, cells in rows]  # Each line ends with a separator.
    n_fields = len(rows[0][1])
    if columns is None and n_fields == _N_KITTI:
        return _kitti(rows, time_unit, times)
    if times is not None:
        raise DataError(
            f"a file of times is for poses of KITTI, with {_N_KITTI} fields in a row, but the rows have {n_fields}; "
            "remove it (times)"
        )
    if columns is None:
        columns = _without_header(rows[0], text)
    for number, row in rows:
        if len(row) != columns.n_fields:
            is_tum = columns is _ORDER_OF_TUM
            wanted = f"{len(TUM)}: {' '.join(TUM)}" if is_tum else f"{columns.n_fields}, as in the first line"
            raise DataError(f"line {number} has {len(row)} fields; write {wanted}")
    if time_unit is not None and columns.unit is not None and time_unit != columns.unit:
        raise DataError(
            f"the file states that its times are in {columns.unit}, but time_unit is {time_unit}; remove time_unit"
        )
    rows, unknown = _with_times(rows, columns.time)
    time_ns, notes = times_of([(number, row[columns.time]) for number, row in rows], columns.unit or time_unit)
    position_m = np.zeros((len(rows), 3))
    for axis, place in columns.axes.items():
        position_m[:, "xyz".index(axis)] = _numbers(rows, place)
    notes = (*unknown, *notes, *[_BARE] * (needs_header and columns.is_bare))
    return PoseRows("line", _line_numbers(rows), time_ns, position_m, _rotations(rows, columns), None, notes)


def _with_times(rows: list[Row], place: int) -> tuple[list[Row], tuple[str, ...]]:
    """Return the rows with a time, and a note on the others, which are empty or NaN."""
    kept = [(number, cells) for number, cells in rows if cells[place].lower() not in (*_UNKNOWN, "nan", "-nan")]
    if len(kept) == len(rows):
        return rows, ()
    numbers = {number for number, _ in kept}
    first = next(number for number, _ in rows if number not in numbers)
    n_left = len(rows) - len(kept)
    note = f"{counted(n_left, 'line')} of {len(rows)} without a time (NaN) left out, the first is line {first}"
    if not kept:
        raise DataError(f"there are no poses; {note}; write at least one pose")
    return kept, (note,)


def _header(text: str, *, needs_header: bool) -> tuple[_Columns | None, list[Row]]:
    """Return the columns that a header names, also in a comment, and the rows below it."""
    columns: _Columns | None = None
    rows: list[Row] = []
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#", 1)[0].strip()
        if not rows and columns is None:
            names = _names(line.strip().lstrip("#%/").strip())
            is_stated = bool(content) and (needs_header or not any(map(_is_number, names)))
            _require_no_sensor(names)
            found = _columns(names, is_stated=is_stated)
            _require_rotations(number, found, names)
            if is_stated and not found.is_complete:
                if all(map(_is_number, names)):
                    raise DataError(f"the first line has numbers instead of names of columns; add a line {_EXAMPLE}")
                raise DataError(f"the first line names the columns {', '.join(names)}; they must be {_COLUMNS}")
            if found.is_complete:
                columns = found
                continue
        if content and not content.startswith(("%", "//")):
            rows.append((number, _cells(content)))
    if needs_header and columns is None:
        raise DataError(f"the file contains no line that names its columns; the columns must be {_COLUMNS}")
    return columns, rows


def _cells(line: str) -> list[str]:
    """Return the cells of a line, which semicolons, commas or spaces separate."""
    if "," in line and _DECIMAL_COMMAS.fullmatch(line):
        return line.replace(",", ".").split()
    separator = next((each for each in ";," if each in line), None)
    cells = [cell.strip().strip('"').strip() for cell in line.split(separator)]
    return [cell.replace(",", ".") for cell in cells] if separator == ";" else cells  # 1,5;2,0 has decimal commas.


def _names(line: str) -> list[str]:
    """Return the names in a header. Between spaces, a unit in brackets belongs to the name before it."""
    return _cells(line if {*",;"} & {*line} else _SPACED_UNIT.sub("", line))


def _columns(names: Sequence[str], *, is_stated: bool) -> _Columns:
    """Return the places of known columns; refuse ambiguous ones if they are stated to be a header."""
    time, unit, is_bare = -1, None, False
    angles: dict[str, tuple[int, float]] = {}
    unread: list[str] = []
    axes: dict[str, int] = {}
    quaternion: dict[str, int] = {}
    repeated: list[str] = []
    for place, full in enumerate(names):
        named = _NAMED.fullmatch(full)
        name, bracket = (named[1].lower(), (named[2] or "").lower()) if named else (full.lower(), "")
        name = name.replace(".", "_")
        if found := _TIME.fullmatch(name):
            repeated += [full] * (time >= 0)
            time, unit = place, found[1] or _unit(full, bracket)
        elif found := _POSITION.fullmatch(name) or _IN_METRES.fullmatch(name):
            if bracket not in {"", "m"}:
                raise DataError(f"column {full!r} is not in metres; convert the column, and name it {name[-1]}_m")
            is_bare |= bracket != "m" and found.re is _IN_METRES
            axis = next(filter(None, found.groups()))
            repeated += [full] * (axis in axes)
            axes[axis] = place
        elif found := _ROTATION.fullmatch(name):
            repeated += [full] * (found[1] in quaternion)
            quaternion[found[1]] = place
        elif (found := _ANGLE.fullmatch(name)) and (found[2] or bracket) in _DEGREES:
            repeated += [full] * (found[1] in angles)
            angles[found[1]] = place, _DEGREES[found[2] or bracket]
        elif _UNREAD.fullmatch(name):
            unread.append(full)
    is_known = {True: "z" in axes, False: len(quaternion) == len("xyzw")}
    unread = [each for each in unread if not is_known[_PLACES.match(each) is not None]]
    if unread and is_stated and axes:
        raise DataError(
            f"the first line names the columns {', '.join(names)}, but {', '.join(unread)} are unknown; use "
            f"{_COLUMNS}, and remove or rename other columns"
        )
    if repeated and is_stated:
        raise DataError(
            f"the first line names {', '.join(names)}, but each column must occur once, and only one may be a time; "
            "rename or remove columns"
        )
    return _Columns(-1 if repeated else time, unit, axes, quaternion, angles, len(names), is_bare)


def _unit(name: str, bracket: str) -> str | None:
    """Return the unit in the brackets of a column of times; None without any."""
    unit = _UNITS.get(bracket, bracket)
    if unit not in {"", "s", "ms", "us", "ns"}:
        raise DataError(f"column {name!r} is not in s, ms, us or ns; convert the column, and name it time_s")
    return unit or None


def _require_rotations(number: int, columns: _Columns, names: Sequence[str]) -> None:
    """Refuse a header with times and positions, but without rotations."""
    if columns.time >= 0 and {*"xy"} <= columns.axes.keys() and not columns.quaternion and "yaw" not in columns.angles:
        raise DataError(
            f"line {number} names the columns {', '.join(names)}, but none contains a rotation; add qx, qy, qz, qw, "
            "yaw_deg or yaw_rad"
        )


def _require_no_sensor(names: Sequence[str]) -> None:
    """Refuse the header of a sensor of EuRoC."""
    for name in names:
        sensor = _SENSORS.get(name.split("[")[0].strip().lower())
        if sensor is not None:
            raise DataError(
                f"the file contains measurements of {sensor} instead of poses; choose the poses of the data set, such "
                "as state_groundtruth_estimate0/data.csv of EuRoC"
            )


def _without_header(first: Row, text: str) -> _Columns:
    """Return the columns of TUM for rows without a header, unless the order of these may be another."""
    number, cells = first
    if len(cells) == 1:
        raise DataError(
            f"line {number} has one number, as in the times of KITTI; choose the file of the poses, and add this file "
            "as that of the times (times)"
        )
    if len(cells) > len(TUM):
        raise DataError(
            f"line {number} has {len(cells)} fields; write {len(TUM)}: {' '.join(TUM)}, or name all columns in the "
            "first line, as in 'timestamp tx ty tz qx qy qz qw other'"
        )
    if "," in text.splitlines()[number - 1] and len(cells[0].split(".")[0]) > _DIGITS_OF_NS:
        raise DataError(
            f"the order of the quaternion in line {number} is unclear: x y z w as in TUM, or w x y z as in EuRoC; name "
            "the columns in the first line, as in 'timestamp,tx,ty,tz,qx,qy,qz,qw'"
        )
    return _ORDER_OF_TUM


def _kitti(rows: list[Row], time_unit: str | None, times: str | None) -> PoseRows:
    """Return poses of KITTI: the first three rows of a matrix of 4 × 4 in each line."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  importing it takes longer than this package

    if times is None:
        raise DataError(
            "the rows have 12 fields, as poses of KITTI do, but no times; add the file of their times (times)"
        )
    cells = [(number, cells[0]) for number, cells in _lines(times)]
    if len(cells) != len(rows):
        raise DataError(f"there are {len(rows)} poses, but {len(cells)} times; choose the times of the same drive")
    time_ns, notes = times_of(cells, time_unit)
    for number, row in rows:
        if len(row) != _N_KITTI:
            raise DataError(f"line {number} has {len(row)} fields; write {_N_KITTI}, as in the first line")
    matrix = np.stack([_numbers(rows, place) for place in range(_N_KITTI)], axis=1).reshape(-1, 3, 4)
    turns = matrix[:, :, :3]
    wrong = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 0.05
    wrong |= np.linalg.det(turns) < 0
    if wrong.any():
        raise DataError(f"line {rows[int(np.argmax(wrong))][0]}: the matrix is not a rotation; correct the pose")
    is_known = np.isfinite(turns).all(axis=(1, 2))
    rotation_xyzw = np.full((len(rows), 4), np.nan)
    rotation_xyzw[is_known] = Rotation.from_matrix(turns[is_known]).as_quat()
    return PoseRows("line", _line_numbers(rows), time_ns, matrix[:, :, 3].copy(), rotation_xyzw, None, notes)


def _lines(text: str) -> Iterator[Row]:
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#", 1)[0].strip()
        if content:
            yield number, _cells(content)


def _rotations(rows: list[Row], columns: _Columns) -> Floats:
    if columns.quaternion:
        return np.stack([_numbers(rows, columns.quaternion[axis]) for axis in "xyzw"], axis=1)
    x, y, z = (_half_turns(rows, columns, name) for name in ("roll", "pitch", "yaw"))
    return np.stack(  # Fixed axes, as in ROS: first roll about x, then pitch about y, then yaw about z.
        [
            x.imag * y.real * z.real - x.real * y.imag * z.imag,
            x.real * y.imag * z.real + x.imag * y.real * z.imag,
            x.real * y.real * z.imag - x.imag * y.imag * z.real,
            x.real * y.real * z.real + x.imag * y.imag * z.imag,
        ],
        axis=1,
    )


def _half_turns(rows: list[Row], columns: _Columns, name: str) -> NDArray[np.complex128]:
    """Return the cosines and sines of half an angle in radians, as complex numbers; an angle without a column is 0."""
    if name not in columns.angles:
        return np.ones(len(rows), np.complex128)
    place, degrees = columns.angles[name]
    numbers = _numbers(rows, place)
    if degrees > 1 and np.nanmax(np.abs(numbers), initial=0.0) > _MANY_TURNS_RAD:
        raise DataError(
            f"{name} in radians reaches {np.nanmax(np.abs(numbers)):g}; if it is in degrees, name it {name}_deg"
        )
    return np.exp(0.5j * np.radians(degrees * numbers))


def _numbers(rows: list[Row], place: int) -> Floats:
    """Return the numbers of a column; NaN for empty cells and for other words that programs write for NaN."""
    found = []
    for number, cells in rows:
        try:
            found.append(math.nan if cells[place].lower() in _UNKNOWN else _number(cells[place]))
        except ValueError as error:
            raise DataError(f"line {number}: {error}; use decimal numbers") from None
    return np.array(found, np.float64)


def _line_numbers(rows: list[Row]) -> NDArray[np.int64]:
    return np.array([number for number, _ in rows], np.int64)


def _number(cell: str) -> float:
    if "_" in cell:
        raise ValueError(f"{cell!r} is not a number")
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True

"""Trajectories in text files of TUM, tables in CSV, and messages in MCAP."""

from collections.abc import Iterable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.atomic_files import atomic_write, check_target
from ertis_numba.errors import ArgumentError, DataError, ErtisError
from ertis_numba.extras import extra
from ertis_numba.frames import Trajectory

__all__ = ["check_tum_target", "read_trajectory", "write_tum"]

Floats = NDArray[np.float64]
Found = TypeVar("Found")

_TUM: Final = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_NS_PER_UNIT: Final = {"time_ns": 1, "time_s": 10**9}
_POSITIONS: Final = ("x_m", "y_m", "z_m")
_QUATERNION: Final = ("qx", "qy", "qz", "qw")
_YAW: Final = "yaw_deg"
_OTHER_SUFFIXES: Final = (".csv", ".h5", ".mcap", ".mat", ".ply")
_COLUMNS: Final = "time_ns or time_s, x_m, y_m, z_m (optional), and either qx, qy, qz, qw or yaw_deg"
_POSES: Final = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
)


def read_trajectory(path: str | Path, *, topic: str | None = None) -> Trajectory:
    """Read a trajectory from a file.

    Parameters
    ----------
    path : str or Path
        The suffix decides the format. ``.csv`` is a table whose first line names its columns: ``time_ns`` or
        ``time_s``, ``x_m``, ``y_m``, optionally ``z_m``, and either ``qx``, ``qy``, ``qz``, ``qw`` or ``yaw_deg``.
        ``.mcap`` holds messages of ROS 2: Odometry, PoseStamped or PoseWithCovarianceStamped. All others are text
        files of TUM: lines of ``timestamp tx ty tz qx qy qz qw`` in seconds and metres, and comments after #.
    topic : str, optional
        Topic of an MCAP file; the only one with poses by default.

    Returns
    -------
    Trajectory
        Its source is "file".

    Raises
    ------
    DataError
        The file is missing or contains no valid trajectory.
    ArgumentError
        The topic does not exist, several topics have poses, or the packages for MCAP are not installed.

    Examples
    --------
    >>> from pathlib import Path
    >>> import ertis_numba as ertis
    >>> _ = Path("path.tum").write_text("1700000000.5 1 2 0 0 0 0 1")
    >>> path = ertis.read_trajectory("path.tum")
    >>> path.time_ns.tolist(), path.position_m.tolist()
    ([1700000000500000000], [[1.0, 2.0, 0.0]])
    """
    path = Path(path)
    if not path.is_file():
        fault = "is a folder" if path.is_dir() else "does not exist"
        raise DataError(f"trajectory {path} {fault}; give a .tum, .txt, .csv or .mcap file")
    suffix = path.suffix.lower()
    if topic is not None and suffix != ".mcap":
        raise ArgumentError(f"topic is {topic!r}, but {path} is not an .mcap file; leave out the topic")
    try:
        if suffix == ".mcap":
            return _read_mcap(path, topic)
        text = path.read_text("utf-8-sig")
        return _read_csv(text) if suffix == ".csv" else _read_tum(text)
    except UnicodeDecodeError as error:
        raise DataError(f"trajectory {path} is not a text file; give a .tum, .txt, .csv or .mcap file") from error
    except (ArgumentError, DataError) as error:
        raise type(error)(f"{path}: {error}") from error


def write_tum(path: str | Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write a trajectory as a text file of TUM, which evo and many SLAM programs read.

    Parameters
    ----------
    path : str or Path
        File to write. It appears only when it is complete.
    trajectory : Trajectory
        Poses to write. The format holds no covariances.
    overwrite : bool, default False
        Replace an existing file.

    Raises
    ------
    ArgumentError
        The file exists, its folder does not exist, or its suffix is that of another format.

    Examples
    --------
    >>> from pathlib import Path
    >>> import ertis_numba as ertis
    >>> path = ertis.Trajectory([1_700_000_000_123_456_789], [[1, 2, 0]], [[0, 0, 0, 1]])
    >>> ertis.write_tum("written.tum", path)
    >>> print(Path("written.tum").read_text(), end="")
    # timestamp tx ty tz qx qy qz qw
    1700000000.123456789 1 2 0 0 0 0 1
    """
    checks.instance("trajectory", trajectory, Trajectory, "Odometry.trajectory and read_trajectory return")
    check_tum_target(Path(path), overwrite=overwrite)
    with atomic_write(Path(path), overwrite=overwrite) as part, part.open("w", encoding="utf-8") as file:
        file.write(f"# {' '.join(_TUM)}\n")
        for time_ns, position, rotation in zip(
            trajectory.time_ns.tolist(), trajectory.position_m.tolist(), trajectory.rotation_xyzw.tolist(), strict=True
        ):
            # Decimal keeps nanoseconds, which a float64 of seconds since 1970 does not hold.
            numbers = " ".join(format(number, ".15g") for number in (*position, *rotation))
            file.write(f"{Decimal(time_ns).scaleb(-9):f} {numbers}\n")


def check_tum_target(path: Path, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Refuse a path to which `write_tum` could not write.

    Parameters
    ----------
    path : Path
    overwrite : bool
    sources : iterable of Path
        Input files, which are never overwritten.

    Raises
    ------
    ArgumentError
        As for `write_tum`.
    """
    suffix = path.suffix.lower()
    if suffix in _OTHER_SUFFIXES:
        raise ArgumentError(f"output {path} ends in {suffix}, but the file is text of TUM; give a name in .tum or .txt")
    check_target(path, overwrite=overwrite, sources=sources)


def _read_tum(text: str) -> Trajectory:
    rows = _some((number, row.split()) for number, row in _lines(text))
    for number, row in rows:
        if len(row) != len(_TUM):
            raise DataError(f"line {number} has {len(row)} fields; give {len(_TUM)}: {' '.join(_TUM)}")
    times_ns = _times_ns(((number, row[0]) for number, row in rows), _NS_PER_UNIT["time_s"])
    table = _table((number, row[1:]) for number, row in rows)
    return _trajectory(times_ns, table[:, :3], table[:, 3:])


def _read_csv(text: str) -> Trajectory:
    lines = [(number, [cell.strip().strip('"') for cell in row.split(",")]) for number, row in _lines(text)]
    _, header = lines[0] if lines else (0, [])
    unit = next((name for name in _NS_PER_UNIT if name in header), None)
    by_yaw = _YAW in header
    wanted = [*_POSITIONS[:2], *((_YAW,) if by_yaw else _QUATERNION)]
    missing = [name for name in wanted if name not in header]
    if len(set(header)) < len(header) or set(_NS_PER_UNIT) <= set(header):
        raise DataError(f"the first line names the columns {', '.join(header)}; give each once, and one time")
    if unit is None or missing:
        raise DataError(f"the first line names the columns {', '.join(header) or 'none'}; give {_COLUMNS}")
    rows = _some(lines[1:])
    for number, row in rows:
        if len(row) != len(header):
            raise DataError(f"line {number} has {len(row)} fields; give {len(header)} as in the first line")
    place = header.index(unit)
    times_ns = _times_ns(((number, row[place]) for number, row in rows), _NS_PER_UNIT[unit])
    if _POSITIONS[2] in header:
        wanted.insert(2, _POSITIONS[2])
    places = [header.index(name) for name in wanted]
    table = _table((number, [row[k] for k in places]) for number, row in rows)
    n_axes = len(wanted) - (1 if by_yaw else len(_QUATERNION))
    position_m = np.pad(table[:, :n_axes], ((0, 0), (0, 3 - n_axes)))
    if not by_yaw:
        return _trajectory(times_ns, position_m, table[:, n_axes:])
    half_rad = np.radians(table[:, -1]) / 2
    none = np.zeros(len(half_rad))
    return _trajectory(times_ns, position_m, np.stack([none, none, np.sin(half_rad), np.cos(half_rad)], axis=1))


def _read_mcap(path: Path, topic: str | None) -> Trajectory:
    with extra("ros", "trajectories in .mcap files need mcap and mcap-ros2-support"):
        from mcap.reader import make_reader  # noqa: PLC0415  an extra
        from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415  an extra
    with path.open("rb") as file:
        try:
            reader: Any = make_reader(file, decoder_factories=[DecoderFactory()])
            summary = reader.get_summary()
            chosen = _topic({} if summary is None else _pose_topics(summary), topic)
            messages = [message for *_, message in reader.iter_decoded_messages(topics=[chosen], log_time_order=True)]
            return _of_messages(_some(messages))
        except (ErtisError, MemoryError, OSError):
            raise
        except Exception as error:  # The libraries raise errors of any type.
            raise DataError(
                "the file is damaged or cut short; record it again, or repair it with 'mcap recover'"
            ) from error


def _of_messages(messages: list[Any]) -> Trajectory:
    stamps = [message.header.stamp for message in messages]
    # Odometry and PoseWithCovarianceStamped hold a pose with covariance in their field "pose".
    holders = [message.pose for message in messages]
    poses = [getattr(holder, "pose", holder) for holder in holders]
    covariances = [holder.covariance for holder in holders if hasattr(holder, "covariance")]
    points, turns = [pose.position for pose in poses], [pose.orientation for pose in poses]
    return _trajectory(
        [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps],
        np.array([(point.x, point.y, point.z) for point in points]).reshape(-1, 3),
        np.array([(turn.x, turn.y, turn.z, turn.w) for turn in turns]).reshape(-1, 4),
        np.array(covariances, np.float64).reshape(-1, 6, 6) if covariances else None,
    )


def _pose_topics(summary: Any) -> dict[str, str]:
    """Return the topics with poses, and the type of their messages."""
    schemas = {number: schema.name for number, schema in summary.schemas.items()}
    found = {channel.topic: schemas.get(channel.schema_id, "") for channel in summary.channels.values()}
    return {topic: kind for topic, kind in found.items() if kind in _POSES}


def _topic(topics: dict[str, str], wanted: str | None) -> str:
    listed = ", ".join(sorted(topics)) or "none"
    if wanted is None and len(topics) == 1:
        return next(iter(topics))
    if wanted is None:
        remedy = (
            "choose one of them (import-poses --topic)" if topics else f"record a topic of type {', '.join(_POSES)}"
        )
        raise ArgumentError(f"topics with poses: {listed}; {remedy}")
    if wanted not in topics:
        raise ArgumentError(f"topic {wanted!r} does not exist or has no poses; topics with poses: {listed}")
    return wanted


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines with content, and their numbers from 1."""
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#", 1)[0].strip()
        if content:
            yield number, content


def _some(found: Iterable[Found]) -> list[Found]:
    """Return the items as a list.

    Raises
    ------
    DataError
        There is nothing.
    """
    listed = list(found)
    if not listed:
        raise DataError("there are no poses; give at least one")
    return listed


def _times_ns(cells: Iterable[tuple[int, str]], ns_per_unit: int) -> list[int]:
    times_ns = []
    for number, cell in cells:
        try:
            times_ns.append(int((Decimal(cell) * ns_per_unit).to_integral_value()))
        except (ArithmeticError, ValueError):
            raise DataError(f"line {number}: time {cell!r} is not a number; give a decimal number") from None
    return times_ns


def _table(rows: Iterable[tuple[int, list[str]]]) -> Floats:
    table = []
    for number, cells in rows:
        try:
            table.append([float(cell) for cell in cells])
        except ValueError as error:
            raise DataError(f"line {number}: {error}; give decimal numbers") from None
    return np.array(table, np.float64)


def _trajectory(
    times_ns: list[int], position_m: Floats, rotation_xyzw: Floats, covariance: Floats | None = None
) -> Trajectory:
    try:
        return Trajectory(np.array(times_ns, np.int64), position_m, rotation_xyzw, covariance, "file")
    except OverflowError as error:
        raise DataError("a time is beyond the year 2262; give seconds or nanoseconds since 1970") from error
    except ArgumentError as error:
        raise DataError(str(error)) from error

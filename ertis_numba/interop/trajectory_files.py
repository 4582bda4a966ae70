"""Trajectories in text files of TUM, tables, poses of KITTI, and messages in MCAP."""

import warnings
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path
from typing import Final

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import atomic_write, check_target
from ertis_numba.base.errors import ArgumentError, DataError, PoseWarning
from ertis_numba.base.file_kinds import kind_of, markup_of, quoted
from ertis_numba.frames import PoseAxes, Trajectory
from ertis_numba.interop._pose_messages import read_messages
from ertis_numba.interop._pose_rows import trajectory_of
from ertis_numba.interop._pose_table import TUM, read_table
from ertis_numba.interop._pose_times import TIME_UNITS

__all__ = ["check_tum_target", "read_trajectory", "write_tum"]

_OTHER_SUFFIXES: Final = (".csv", ".h5", ".mcap", ".mat", ".ply")
_KINDS: Final = "a .tum, .txt, .csv or .mcap file"
_CONVERT: Final = (
    "convert it with 'pip install rosbags' and 'rosbags-convert --src {} --dst BAG --dst-storage mcap', and use the "
    ".mcap file in BAG"
)
_MCAP = b"\x89MCAP0\r\n"
_SIGNATURES: Final = {
    b"#ROSBAG": f"is a bag of ROS 1; {_CONVERT.format('{file}')}",
    b"SQLite format 3": f"is a bag of ROS 2 in SQLite; {_CONVERT.format('{folder}')}",
    b"\x89HDF": "is HDF5, not text; if it is a recording, write its poses with 'ertis export {file} -o POSES.tum'",
    b"PK\x03\x04": f"is an archive or a spreadsheet; unpack it or save it as CSV, and use {_KINDS}",
}
"""First bytes of files that are refused by name."""


def read_trajectory(
    path: str | Path,
    *,
    topic: str | None = None,
    time_unit: str | None = None,
    times: str | Path | None = None,
    pose_axes: PoseAxes = "platform",
) -> Trajectory:
    """Read a trajectory from a file.

    Parameters
    ----------
    path : str or Path
        The suffix decides the format. ``.csv`` is a table whose first line names its columns: ``time_ns`` or
        ``time_s``, ``x_m``, ``y_m``, optionally ``z_m``, and either ``qx``, ``qy``, ``qz``, ``qw`` or ``yaw_deg``; or
        those of EuRoC. ``.mcap`` holds messages of ROS 2: Odometry, PoseStamped, PoseWithCovarianceStamped, Path or
        TFMessage. All others are text files of TUM: lines of ``timestamp tx ty tz qx qy qz qw`` in seconds and metres,
        and comments after #, which may name columns; or poses of KITTI.
    topic : str, optional
        Topic of an MCAP file; the only one with poses by default. ``/tf:PARENT.CHILD`` reads the transform from one
        frame to another.
    time_unit : {"s", "ms", "us", "ns"}, optional
        Unit of times in text whose column states none. By default, the unit in which they are between 1973 and 2116,
        and otherwise seconds.
    times : str or Path, optional
        Text file with one time per line, for poses of KITTI.
    pose_axes : {"platform", "camera", "camera-world", "ned"}
        Axes of the poses, as for `Trajectory.converted`.

    Returns
    -------
    Trajectory
        Its source is "file". Its ``notes`` state rows without numbers, several rows for one time, quaternions that were
        scaled by more than rounding, doubtful units of time, and poses that are hardly those of a platform: they tilt
        it, are mirrored or in other units, leap, or are relative to the centre of the Earth.

    Warns
    -----
    PoseWarning
        For each note.

    Raises
    ------
    DataError
        The file is missing or contains no valid trajectory.
    ArgumentError
        The topic does not exist, several topics have poses, an option does not suit the file, or the packages for MCAP
        are not installed.

    Examples
    --------
    >>> from pathlib import Path
    >>> import ertis_numba as ertis
    >>> _ = Path("path.tum").write_text("1700000000.5 1 2 0 0 0 0 1")
    >>> path = ertis.read_trajectory("path.tum")
    >>> path.time_ns.tolist(), path.position_m.tolist(), path.notes
    ([1700000000500000000], [[1.0, 2.0, 0.0]], ())
    """
    path = Path(path)
    if time_unit is not None:
        checks.choice("time_unit", time_unit, TIME_UNITS)
    is_mcap = path.suffix.lower() == ".mcap"
    if topic is not None and not is_mcap:
        raise ArgumentError(f"{path} is not an .mcap file and has no topics; remove the topic (topic)")
    for name, value in (("time_unit", time_unit), ("times", times)):
        if value is not None and is_mcap:
            raise ArgumentError(f"{name} applies to text, but messages in {path} contain times; remove {name}")
    _require_poses(path)
    stamps = None if times is None else _text(Path(times))
    text = "" if is_mcap else _text(path)
    try:
        rows = (
            read_messages(path, topic)
            if is_mcap
            else read_table(text, needs_header=path.suffix.lower() == ".csv", time_unit=time_unit, times=stamps)
        )
        found = trajectory_of(rows, pose_axes)
    except (ArgumentError, DataError) as error:
        raise type(error)(f"{path}: {error}") from error
    for note in found.notes:
        warnings.warn(f"{path}: {note}", PoseWarning, stacklevel=2)
    return found


def _require_poses(path: Path) -> None:
    """Refuse folders, missing files, and files of other formats by name."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        raise DataError(f"trajectory {path} is the folder of a bag of ROS 2; use the .mcap file in this folder")
    if not path.is_file():
        fault = "is a folder" if path.is_dir() else "does not exist"
        raise DataError(f"trajectory {path} {fault}; choose {_KINDS}")
    with path.open("rb") as file:
        start = file.read(16)
    for signature, fault in _SIGNATURES.items():
        if start.startswith(signature):
            raise DataError(f"trajectory {path} {fault.format(file=quoted(path), folder=quoted(path.parent))}")
    kind, is_mcap = kind_of(path), path.suffix.lower() == ".mcap"
    found = f"is {kind.name}" if kind else "has content of an unknown format" if start else "is empty"
    if is_mcap and not start.startswith(_MCAP):
        remedy = "rename it to end in .tum or .csv" if kind and kind.is_text else f"choose {_KINDS}"
        raise DataError(f"trajectory {path} {found}, not messages in MCAP; {remedy}")
    if kind and not (is_mcap or kind.is_text):
        remedy = "rename it to end in .mcap" if start.startswith(_MCAP) else f"choose {_KINDS}"
        raise DataError(f"trajectory {path} {found}; {remedy}")


def _text(path: Path) -> str:
    """Return a text in UTF-8, or in UTF-16 with its byte-order mark, as PowerShell writes it."""
    try:
        content = path.read_bytes()
        text = content.decode("utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error}); choose an existing file") from error
    if "\0" in text:
        raise DataError(f"trajectory {path} is not a text file; choose {_KINDS}")
    if markup := markup_of(text):
        raise DataError(f"trajectory {path} is {markup}, not a table; choose {_KINDS}")
    return text


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
        file.write(f"# {' '.join(TUM)}\n")
        for time_ns, position, rotation in zip(
            trajectory.time_ns.tolist(), trajectory.position_m.tolist(), trajectory.rotation_xyzw.tolist(), strict=True
        ):
            # Decimal keeps nanoseconds, which a float64 of seconds since 1970 does not hold.
            numbers = " ".join(format(number, ".15g") for number in (*position, *rotation))
            file.write(f"{Decimal(time_ns).scaleb(-9):f} {numbers}\n")


def check_tum_target(path: Path, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Refuse a path to which `write_tum` could not write; ``sources`` are never overwritten."""
    suffix = path.suffix.lower()
    if suffix in _OTHER_SUFFIXES:
        raise ArgumentError(
            f"output {path} ends in {suffix}, but poses are written as TUM text; choose a name that ends in "
            ".tum or .txt"
        )
    check_target(path, overwrite=overwrite, sources=sources)

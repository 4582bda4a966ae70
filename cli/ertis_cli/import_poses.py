"""``ertis import poses``: add the poses of a platform to recordings."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from ertis_cli import _poses, options

if TYPE_CHECKING:
    from ertis_numba.frames import Trajectory

__all__ = ["import_poses"]

_NS_PER_S = 1e9
_MAX_OFFSET_S = 4e9  # Covers clocks that count from another year; times remain within 64 bits.


@click.command("poses")
@options.input_file("REC.h5|FOLDER")
@click.argument("trajectory_file", metavar="TRAJ", type=options.FILE)
@click.option(
    "--offset-s",
    "offset_s",
    type=float,
    default=0.0,
    show_default=True,
    metavar="S",
    help="Time in s to add to the poses, if their clock differs from the clock of the recording.",
)
@_poses.reading
@click.option(
    "--output",
    "-o",
    "target",
    type=options.FILE,
    metavar="OUT",
    help="Recording to write, or folder for the recordings of a folder; by default, each recording is replaced.",
)
@click.option("--force", is_flag=True, help="Replace poses that a recording has, and overwrite existing output.")
@options.quiet
@options.as_json
def import_poses(
    *,
    path: Path,
    trajectory_file: Path,
    offset_s: float,
    target: Path | None,
    force: bool,
    quiet: bool,
    as_json: bool,
    **reading: Any,
) -> None:
    """Add the poses of a platform to recordings.

    TRAJ is a text file of TUM (.tum, .txt), a table (.csv) such as those of EuRoC, poses of KITTI with --times, or
    messages of ROS 2 (.mcap). The trajectory is interpolated at the times of the measurements of all sensors, and must
    cover all of them. Notes report rows that were left out, and the number of measurements whose pose is interpolated
    across more than a second. A folder stands for its recordings (*.h5). A recording is replaced only when the new one
    is complete.
    """
    from ertis_numba.base import checks
    from ertis_numba.base.atomic_files import make_folder
    from ertis_numba.base.errors import PoseWarning
    from ertis_numba.storage import add_poses, check_target, recorded_trajectory, require_fitting_poses
    from ertis_numba.storage.poses import count_in_gaps

    checks.between("offset_s", offset_s, -_MAX_OFFSET_S, _MAX_OFFSET_S)
    _require_order(path, trajectory_file)
    given = _poses.trajectory_of(trajectory_file, quiet=quiet, **reading)
    shifted: Trajectory = given.replace(time_ns=given.time_ns + round(offset_s * _NS_PER_S))
    recordings = _recordings(path)
    outputs = _outputs(recordings, target, is_folder=path.is_dir())
    for recording, output in zip(recordings, outputs, strict=True):  # All are checked before the first is written.
        require_fitting_poses(recording, shifted, replace=force)
        if output is not None and output.parent.is_dir():
            check_target(output, overwrite=force, sources=[recording])
    if target is not None and path.is_dir():
        make_folder(target)
    reports: list[dict[str, Any]] = []
    for recording, output in zip(recordings, outputs, strict=True):
        with warnings.catch_warnings(category=PoseWarning, action="ignore"):  # A note says the same.
            written = add_poses(recording, shifted, output=output, overwrite=force, replace=force)
        poses = cast("Trajectory", recorded_trajectory(written))
        count = options.counted(len(poses), "pose")
        options.say(f"{written}: {count}, {poses.length_m:.2f} m", quiet=quiet)
        n_in_gaps = count_in_gaps(shifted, poses.time_ns)
        if n_in_gaps:
            between = f"poses of {trajectory_file} more than a second apart"
            options.note(f"{n_in_gaps} of {count} interpolated between {between}", quiet=quiet)
        reports.append(
            {
                "output": str(written),
                "poses": len(poses),
                "path_length_m": round(poses.length_m, 6),
                "notes": list(given.notes),
            }
        )
    if as_json:
        for report in reports:
            options.print_json(report)


def _require_order(path: Path, trajectory_file: Path) -> None:
    """Refuse poses before a recording."""
    from ertis_numba.base.file_kinds import kind_of, quoted

    first, second = kind_of(path), kind_of(trajectory_file)
    if second is not None and second.is_hdf5 and not (path.is_dir() or (first is not None and first.is_hdf5)):
        order = f"'ertis import poses {quoted(trajectory_file)} {quoted(path)}'"
        raise click.UsageError(f"the recording comes before the poses; use {order}", click.get_current_context())


def _recordings(path: Path) -> list[Path]:
    """Return the recordings of a folder, or the recording itself."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.campaign import find_recordings
    from ertis_numba.storage import file_kind

    if not path.is_dir():
        return [path]
    recordings = [each.path for each in find_recordings([path]) if file_kind(each.path) == "recording"]
    if not recordings:
        raise DataError(f"folder {path} contains energyscape files only; choose a folder with recordings")
    return recordings


def _outputs(recordings: list[Path], target: Path | None, *, is_folder: bool) -> list[Path | None]:
    """Return the output of each recording; None if the recording is replaced."""
    if target is None:
        return [None] * len(recordings)
    return [target / recording.name for recording in recordings] if is_folder else [target]

"""Options of commands that read the poses of a platform from a file."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from collections.abc import Callable

    from ertis_numba.frames import Trajectory

__all__ = ["export_poses", "print_notes", "reading", "trajectory_of"]


def reading(command: "Callable[..., Any]") -> "Callable[..., Any]":
    """Add the options of `trajectory_of`."""
    for option in (
        click.option(
            "--pose-axes",
            type=click.Choice(("platform", "camera", "camera-world", "ned")),
            default="platform",
            show_default=True,
            help="Axes of the poses. platform: x forward, z up. camera: z forward and y down, in a world with z up. "
            "camera-world: as camera, and the world has the axes of the first camera. ned: x forward, z down, in a "
            "world of north, east and down.",
        ),
        click.option("--times", type=options.FILE, metavar="FILE", help="Text file with the times of KITTI poses."),
        click.option(
            "--time-unit",
            type=click.Choice(("s", "ms", "us", "ns")),
            help="Unit of the times, if the file of poses does not state one; by default, it follows from the size "
            "of the numbers.",
        ),
        click.option(
            "--topic",
            metavar="NAME",
            help="Topic of an MCAP file, or transform as TOPIC:PARENT.CHILD; by default, the only topic with poses.",
        ),
    ):
        command = option(command)
    return command


def trajectory_of(path: Path, *, quiet: bool, **chosen: Any) -> "Trajectory":
    """Return the trajectory in a file, and print its notes."""
    from ertis_numba import read_trajectory
    from ertis_numba.base.errors import PoseWarning

    with warnings.catch_warnings(category=PoseWarning, action="ignore"):  # Notes say the same.
        found = read_trajectory(path, **chosen)
    print_notes(path, found.notes, quiet=quiet)
    return found


def print_notes(path: Path, notes: tuple[str, ...], *, quiet: bool) -> None:
    """Print the notes of a trajectory."""
    for note in notes:
        options.note(f"{path}: {note}", quiet=quiet)


def export_poses(path: Path, target: Path, sensor: str | None, *, force: bool, quiet: bool, as_json: bool) -> None:
    """Write the poses of a recording in the TUM format."""
    from ertis_numba import write_tum
    from ertis_numba.base.atomic_files import check_target
    from ertis_numba.base.errors import DataError
    from ertis_numba.storage import recorded_trajectory, sensor_names

    check_target(target, overwrite=force, sources=[path])
    poses = recorded_trajectory(path, sensor=sensor)
    if poses is None:
        raise DataError(f"{path} has no poses; add them to its recording with 'ertis import poses RECORDING TRAJ.tum'")
    write_tum(target, poses, overwrite=force)
    options.say(f"{target}: {options.counted(len(poses), 'pose')}, {poses.length_m:.2f} m", quiet=quiet)
    if as_json:
        report = {
            "output": str(target),
            "format": "tum",
            "files": [str(target)],
            "sensors": list(sensor_names(path) if sensor is None else [sensor]),
            "poses": len(poses),
        }
        options.print_json(report)

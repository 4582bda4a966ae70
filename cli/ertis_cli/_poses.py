"""Options of commands that read the poses of a platform from a file."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from collections.abc import Callable

    from ertis_numba.frames import Trajectory

__all__ = ["print_notes", "reading", "trajectory_of"]


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

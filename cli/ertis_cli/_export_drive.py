"""Drives for ``ertis export --format batslam``: the sensor with virtual ears, true poses and odometry."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _naming, _poses, _pulses, _results, options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ertis_cli._mountings import Mounting
    from ertis_numba.frames import Trajectory
    from ertis_numba.interop import Drive
    from ertis_numba.settings import Settings
    from ertis_numba.storage import RecordingReader

__all__ = ["drive_of", "drive_options", "open_ears", "require_fitting"]

_IDENTITY: "Mounting" = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def drive_options(command: Any) -> Any:
    """Add the options of format batslam, named like the fields of `Drive`."""
    for option in (
        click.option(
            "--beam-azimuth",
            "beam_azimuth_deg",
            type=click.FloatRange(-90.0, 90.0),
            default=30.0,
            show_default=True,
            metavar="DEG",
            help="Azimuth of the two virtual ears for BatSLAM in °: the left ear to the left, the right ear to the "
            "right; 0 is ahead.",
        ),
        click.option("--scene", type=options.FILE, metavar="SCENE.toml", help="Scene with the reflectors for BatSLAM."),
        click.option(
            "--odometry",
            type=options.FILE,
            metavar="TRAJ",
            help="Odometry of the platform for BatSLAM; computed from the echoes of all sensors by default.",
        ),
        click.option(
            "--poses",
            type=options.FILE,
            metavar="TRAJ",
            help="File with the true poses of the platform for BatSLAM, such as a TUM file; by default, the poses "
            "in the recording.",
        ),
    ):
        command = option(command)
    return command


def require_fitting(name: str, paths: "Sequence[Path]") -> None:
    """Raise UsageError for options that a format does not have, and for several files."""
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.interop import EXPORT_FORMATS, require_options

    context = click.get_current_context()
    of_formats = dict.fromkeys(option for each in EXPORT_FORMATS.values() for option in each.options)
    try:
        require_options(name, {option: True for option in of_formats if typed(option)})
    except ArgumentError as error:
        raise click.UsageError(_naming.named(str(error), context), context) from error
    if len(paths) > 1 and EXPORT_FORMATS[name].content != "drive":
        raise click.UsageError(
            f"format {name} exports one recording, but {len(paths)} are given; choose one of them", context
        )


def open_ears(
    paths: "Sequence[Path]", sensor: str | None, stack: ExitStack
) -> "tuple[list[RecordingReader], RecordingReader]":
    """Open the recordings of all sensors; return them, and that of the sensor with ears."""
    readers = _pulses.open_sensors(paths, stack)
    names = [reader.sensor for reader in readers]
    if sensor is None and len(readers) > 1:
        raise click.UsageError(
            f"format batslam holds the echoes of one sensor, but there are {', '.join(names)}; choose one (--sensor)",
            click.get_current_context(),
        )
    if sensor is not None and sensor not in names:
        raise click.UsageError(
            f"no recording has sensor {sensor!r}; choose one of {', '.join(names)}", click.get_current_context()
        )
    return readers, readers[0 if sensor is None else names.index(sensor)]


def drive_of(
    readers: "Sequence[RecordingReader]",
    ears: "RecordingReader",
    chosen: "Sequence[int]",
    known: "Mapping[str, Mounting]",
    *,
    poses: Path | None,
    odometry: Path | None,
    scene: Path | None,
    beam_azimuth_deg: float,
    quiet: bool,
) -> "Drive":
    """Return the true poses, the odometry and the scene of a drive, for chosen measurements of the ears."""
    from ertis_numba import load_scene
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.interop import Drive

    true = ears.trajectory if poses is None else _poses.trajectory_of(poses, quiet=quiet)
    if true is None:
        raise ArgumentError(
            f"{ears.path} has no poses; add the true poses with --poses TRAJ, or without ground truth the output of "
            "'ertis odometry'"
        )
    simulated = None if scene is None else load_scene(scene)
    alone = simulated is not None and len(simulated.sensors) == 1
    return Drive(
        poses=true,
        odometry=_measured(readers, ears, chosen, known, alone=alone or None, quiet=quiet)
        if odometry is None
        else _poses.trajectory_of(odometry, quiet=quiet),
        scene=simulated,
        beam_azimuth_deg=beam_azimuth_deg,
    )


def _measured(
    readers: "Sequence[RecordingReader]",
    ears: "RecordingReader",
    chosen: "Sequence[int]",
    known: "Mapping[str, Mounting]",
    *,
    alone: bool | None,
    quiet: bool,
) -> "Trajectory":
    """Return the odometry of all sensors at the chosen measurements of the sensor with ears."""
    import numpy as np

    from ertis_cli.odometry import odometry_of
    from ertis_numba.frames import Trajectory

    if len(readers) == 1 and ears.sensor not in known:
        known = {ears.sensor: _IDENTITY}
    groups = _pulses.active_groups(readers, _as_recorded, quiet=quiet).groups
    kept = set(chosen)
    wanted = [
        number for number, group in enumerate(groups) if ears.sensor in group and group[ears.sensor].index in kept
    ]
    groups = groups[wanted[0] : wanted[-1] + 1]
    with ExitStack() as stack:
        pipelines = _pulses.PipelinesBySensor(_as_recorded, stack, located=False, quiet=quiet)
        if any(reader.sensor not in known for reader in readers):
            known = _pulses.mountings_of(readers, None)
        found = odometry_of(readers, groups, pipelines, known, alone=alone, quiet=quiet).trajectory
    # Clocks of sensors may differ, so each pose gets the time of the sensor with ears.
    indices = [number - wanted[0] for number in wanted]
    times_ns = np.array([groups[index][ears.sensor].stamp.timestamp_ns for index in indices])
    return Trajectory(times_ns, found.position_m[indices], found.rotation_xyzw[indices], None, source=found.source)


def _as_recorded(settings: "Settings") -> "Settings":
    _results.require_image(settings, "odometry needs images; add its result with --odometry TRAJ")
    return settings

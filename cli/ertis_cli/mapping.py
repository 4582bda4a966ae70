"""``ertis map``: occupancy maps from recordings and the poses of their platform."""

import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _poses, _pulses, options

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ertis_cli._pulses import StampedIndex
    from ertis_numba.frames import OccupancyMap, Trajectory
    from ertis_numba.mapping import Mapper
    from ertis_numba.storage import RecordingReader

__all__ = ["mapping"]


@click.command("map")
@options.input_files("REC.h5...")
@click.option(
    "--poses",
    "poses_file",
    type=options.FILE,
    metavar="FILE",
    help="Poses of the platform in the world frame, .tum, .csv or .mcap; those of the recordings by default.",
)
@_poses.reading
@options.output("Map to write: .h5, .ply, .mcap, or .pgm with a .yaml for ROS; REC.map.h5 by default.")
@click.option(
    "--dimensions",
    type=click.IntRange(2, 3),
    default=2,
    show_default=True,
    metavar="2|3",
    help="3 for cells in space, from images with directions over elevation; 2 for cells in the horizontal plane.",
)
@click.option(
    "--cell",
    "cell_m",
    type=click.FloatRange(0.005, 1.0),
    default=0.05,
    show_default=True,
    metavar="M",
    help="Side of the cells in m.",
)
@click.option(
    "--half-life",
    "half_life_s",
    type=click.FloatRange(0.0, min_open=True),
    metavar="S",
    help="Time in s after which old echoes count half, for places where things move; by default, they count for ever.",
)
@click.option(
    "--height",
    "height_m",
    type=options.INTERVAL,
    help="Lowest and highest height of echoes in the world frame in m, to leave out floor and ceiling; all by default.",
)
@click.option(
    "--probabilities",
    is_flag=True,
    help="Write probabilities in percent to .mcap and .pgm instead of 100 (occupied), 0 (free) and -1 (unknown).",
)
@options.emitter_diameter("Diameter of emitters")
@_pulses.processing
@options.force
@options.quiet
@options.as_json
def mapping(
    *,
    paths: tuple[Path, ...],
    poses_file: Path | None,
    target: Path | None,
    dimensions: int,
    cell_m: float,
    half_life_s: float | None,
    height_m: tuple[float, float] | None,
    probabilities: bool,
    emitter_diameter_m: float | None,
    preset: str | None,
    settings_file: Path | None,
    device: str,
    threads: int | None,
    plan: str,
    mounting: Path | None,
    force: bool,
    quiet: bool,
    as_json: bool,
    **reading: Any,
) -> None:
    """Compute an occupancy map from recordings and poses.

    All sensors of the recordings belong to one platform. Their measurements are grouped by SYNC pulse and fused, as by
    'ertis fuse'. Images of 'ertis process' are used as they are. Cells with echoes become occupied, and cells
    in front of the first clear echo of a direction become free. Pulses outside of the time of the poses are left out.
    """
    from ertis_numba.base.errors import PoseWarning
    from ertis_numba.interop import map_files, write_map
    from ertis_numba.mapping import Mapper
    from ertis_numba.storage import check_target
    from ertis_numba.storage.placed_truth import PlacedTruth

    target = target or paths[0].with_suffix(".map.h5")
    for each in map_files(target, n_dimensions=dimensions, probabilities=probabilities):
        check_target(each, overwrite=force, sources=paths)
    with ExitStack() as stack:
        readers = _pulses.open_sensors(paths, stack, images=True)
        trajectory = _trajectory(poses_file, paths, quiet=quiet, **reading)
        changed = _pulses.image_settings(settings_file, preset)
        mountings = _pulses.platform_mountings(readers, mounting, quiet=quiet)
        pipelines = _pulses.PipelinesBySensor(
            changed, stack, quiet=quiet, mountings=mountings, device=device, threads=threads, plan=plan
        )
        truth = PlacedTruth(readers, mountings, trajectory)
        mapper = Mapper(
            mountings,
            dimensions=dimensions,
            cell_m=cell_m,
            half_life_s=half_life_s,
            height_m=height_m,
            emitter_diameter_m=emitter_diameter_m,
        )
        active = _pulses.active_groups(readers, changed, quiet=quiet)
        located = _located(active.groups, trajectory)
        _note_gaps(located, trajectory, quiet=quiet)
        by_name = {reader.sensor: reader for reader in readers}
        _pulses.note_missing(located, [*by_name], quiet=quiet)
        with (
            options.progress(located, length=len(located), label="mapping", quiet=quiet) as shown,
            warnings.catch_warnings(category=PoseWarning, action="ignore"),  # A note says the same.
        ):
            for group in shown:
                images = {name: pipelines.image(by_name[name][place.index]) for name, place in group.items()}
                mapper.add(images.values(), trajectory)
                truth.add(images, {name: place.index for name, place in group.items()})
    occupancy = mapper.map
    warned, noted = _warn(mapper, len(by_name), len(located), quiet=quiet)
    if height_m is not None and not mapper.n_points and mapper.n_empty < len(located):
        _report_heights(occupancy, height_m, quiet=quiet)
    _pulses.note_truth(truth, quiet=quiet)
    placed = truth.truth(height_m)
    written = write_map(target, occupancy, overwrite=force, probabilities=probabilities, truth=placed)
    if len(located) < len(active.groups):
        left_out = options.counted(len(active.groups) - len(located), "pulse")
        options.note(f"{left_out} of {len(active.groups)} outside of the time of the poses left out", quiet=quiet)
    report = _report(written, readers, occupancy) | {
        "left_out": active.n_passive + len(active.groups) - len(located),
        "empty": mapper.n_empty,
        "without_own_echo": mapper.without_own_echo,
        "simulated": placed is not None and target.suffix.lower() == ".h5",
        "notes": [*trajectory.notes, *noted],
        "warnings": [*pipelines.warnings, *warned],
    }
    options.say(_summary(target, len(located), report), quiet=quiet)
    if as_json:
        options.print_json(report)


def _warn(mapper: "Mapper", n_sensors: int, n_pulses: int, *, quiet: bool) -> tuple[list[str], list[str]]:
    """Report pulses and sensors without echoes, and return the warnings of wrong emitters and poses, and notes."""
    contradiction = mapper.emitter_warning()
    warned = [each for each in (contradiction, mapper.pose_warning()) if each]
    for each in warned:
        options.warn(each)
    _pulses.note_empty(mapper.n_empty, n_pulses, quiet=quiet)
    if mapper.n_empty < n_pulses and not contradiction:
        _pulses.note_without_own_echo(mapper.without_own_echo, n_sensors, n_pulses, quiet=quiet)
    noted = [each for each in (mapper.pose_note(),) if each]
    for each in noted:
        options.note(each, quiet=quiet)
    return warned, noted


def _report_heights(occupancy: "OccupancyMap", height_m: tuple[float, float], *, quiet: bool) -> None:
    """State that no point lies within the heights, as an error if the map has no known cell."""
    from ertis_numba.base.errors import DataError

    low_m, high_m = height_m
    reason = (
        f"no point of the images lies within the heights of {low_m:g} to {high_m:g} m; correct --height, which refers "
        "to the world frame of the poses, or remove it"
    )
    if not occupancy.log_odds.any():
        raise DataError(reason)
    options.note(reason, quiet=quiet)


def _trajectory(
    poses_file: Path | None, paths: "Sequence[Path]", *, quiet: bool, pose_axes: Any, **reading: Any
) -> "Trajectory":
    """Return the poses of a file, or else those of the recordings, and print notes on them."""
    from ertis_numba.frames.pose_doubts import pose_doubts
    from ertis_numba.storage import platform_trajectory

    if poses_file is not None:
        return _poses.trajectory_of(poses_file, quiet=quiet, pose_axes=pose_axes, **reading)
    for name, value in reading.items():
        if value is not None:
            option = f"--{name.replace('_', '-')}"
            raise click.UsageError(
                f"{option} requires --poses; add --poses FILE, or remove {option}", click.get_current_context()
            )
    found = platform_trajectory(paths)
    if found is None:
        raise click.UsageError(
            f"{paths[0]} contains no poses of the platform; add --poses FILE, or store poses with 'ertis import poses'",
            click.get_current_context(),
        )
    found = found.converted(pose_axes)
    found = found.replace(notes=pose_doubts(found))
    _poses.print_notes(paths[0], found.notes, quiet=quiet)
    return found


def _located(groups: "Sequence[dict[str, StampedIndex]]", trajectory: "Trajectory") -> "list[dict[str, StampedIndex]]":
    """Return the groups within the time of a trajectory."""
    from ertis_numba.base.errors import DataError

    times_ns = _times_ns(groups)
    if len(groups) > 1 and len(set(times_ns)) == 1:
        raise DataError(
            f"all {len(groups)} pulses have the same time, {times_ns[0] / 1e9:.3f} s; set the clock of the sensors, "
            "and record again"
        )
    located = [group for group, is_covered in zip(groups, trajectory.covers(times_ns), strict=True) if is_covered]
    if not located:
        first_ns, last_ns = trajectory.time_ns[[0, -1]].tolist()
        raise DataError(
            f"all pulses lie outside of the time of the poses: pulses from {min(times_ns) / 1e9:.3f} s to "
            f"{max(times_ns) / 1e9:.3f} s, poses from {first_ns / 1e9:.3f} s to {last_ns / 1e9:.3f} s; use poses of "
            "these recordings, with times in seconds since 1970-01-01 UTC"
        )
    return located


def _times_ns(groups: "Sequence[dict[str, StampedIndex]]") -> list[int]:
    return [min(place.stamp.timestamp_ns for place in group.values()) for group in groups]


def _note_gaps(groups: "Sequence[dict[str, StampedIndex]]", trajectory: "Trajectory", *, quiet: bool) -> None:
    """State the number of pulses between poses more than a second apart."""
    from ertis_numba.storage.poses import count_in_gaps

    n_in_gaps = count_in_gaps(trajectory, _times_ns(groups))
    if n_in_gaps:
        pulses = f"{n_in_gaps} of {options.counted(len(groups), 'pulse')}"
        options.note(f"{pulses} between poses more than a second apart, which are interpolated", quiet=quiet)


def _summary(target: Path, n_pulses: int, report: dict[str, Any]) -> str:
    size = " × ".join(f"{side_m:.2f}" for side_m in report["size_m"])
    cells = f"{report['occupied']} cells occupied, {report['free']} free"
    return f"{target}: {options.counted(n_pulses, 'pulse')}, {size} m, {cells}"


def _report(
    written: "Sequence[Path]", readers: "Sequence[RecordingReader]", occupancy: "OccupancyMap"
) -> dict[str, Any]:
    return {
        "output": str(written[0]),
        "files": [str(path) for path in written],
        "sensors": [reader.sensor for reader in readers],
        "pulses": occupancy.n_groups,
        "cell_m": occupancy.cell_m,
        "origin_m": [round(edge_m, 6) for edge_m in occupancy.origin_m],
        "size_m": [round(high_m - low_m, 6) for low_m, high_m in occupancy.limits_m],
        "occupied": int(occupancy.is_occupied.sum()),
        "free": int(occupancy.is_free.sum()),
    }

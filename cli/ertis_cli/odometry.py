"""``ertis odometry``: compute the trajectory of a platform from recordings."""

from collections import Counter
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ertis_cli import _pulses, options

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ertis_cli._mountings import Mounting
    from ertis_cli._pulses import StampedIndex
    from ertis_numba.motion import Odometry
    from ertis_numba.storage import RecordingReader

__all__ = ["odometry", "odometry_of"]

_NS_PER_S = 1e9
_NOTES = {
    "pause": "follow a pause of more than a second and assume that the last velocity continued",
    "few echoes": "have too few echoes in common and assume that the last velocity continued",
    "copies": "have images that are copies of those before in every value; check the link to the sensors",
    "other motion": "are uncertain because standing still, mirrored motion or the motion of objects explains the "
    "echoes about as well; the more likely motion is assumed",
}
_REFUSALS = {
    "few echoes": "no two successive pulses have enough echoes in common, at most a second apart; record more pulses "
    "per second, or a place with more reflectors",
    "copies": "all measurements are copies of those before in every sample; check the link to the sensors, and record "
    "again",
    "other motion": "no step determines the motion, because standing still, mirrored motion or the motion of objects "
    "explains the echoes about as well; add the recordings of sensors that face other ways, use 'ertis odometry "
    "--alone' if no other sensor emits, or record a place with more reflectors at rest",
}


@click.command()
@options.input_files("REC.h5...")
@click.option(
    "--output",
    "-o",
    "target",
    type=options.FILE,
    metavar="TRAJ.tum",
    help="Trajectory to write in the TUM format; REC.odometry.tum beside the first recording by default.",
)
@options.alone
@_pulses.processing
@options.force
@options.quiet
@options.as_json
def odometry(
    *,
    paths: tuple[Path, ...],
    target: Path | None,
    alone: bool,
    preset: str | None,
    settings_file: Path | None,
    device: str,
    threads: int | None,
    plan: str,
    mounting: Path | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Compute the trajectory of a platform from its echoes.

    All sensors of the recordings belong to one platform. Their measurements are grouped by SYNC pulse, and each group
    is compared with the one before. The trajectory starts at the origin and lies in the plane. Where too few echoes
    match, the last velocity is assumed to continue for at most a second. Where two motions explain the echoes about
    equally well, the more likely one is assumed. Notes and --json state how many steps are affected. Pulses may be at
    most a second apart.
    """
    from ertis_numba import write_tum
    from ertis_numba.interop import check_tum_target

    file = target or paths[0].with_suffix(".odometry.tum")
    check_tum_target(file, overwrite=force, sources=paths)

    with ExitStack() as stack:
        readers = _pulses.open_sensors(paths, stack)
        mountings = _pulses.mountings_of(readers, mounting)
        changed = _pulses.image_settings(settings_file, preset)
        pipelines = _pulses.PipelinesBySensor(
            changed, stack, quiet=quiet, mountings=mountings, located=False, device=device, threads=threads, plan=plan
        )
        active = _pulses.active_groups(readers, changed, quiet=quiet)
        found = odometry_of(readers, active.groups, pipelines, mountings, alone=alone or None, quiet=quiet)
    write_tum(file, found.trajectory, overwrite=force)
    measured = sum(pose.is_measured for pose in found.poses[1:]) / (len(found.poses) - 1)
    duration_s = (found.poses[-1].timestamp_ns - found.poses[0].timestamp_ns) / _NS_PER_S
    poses = options.counted(len(found.poses), "pose")
    options.say(f"{file}: {poses}, {found.length_m:.2f} m in {duration_s:.1f} s, {measured:.0%} measured", quiet=quiet)
    if as_json:
        report = {
            "output": str(file),
            "sensors": [reader.sensor for reader in readers],
            "poses": len(found.poses),
            "left_out": active.n_passive,
            "length_m": round(found.length_m, 6),
            "duration_s": round(duration_s, 6),
            "measured": round(measured, 6),
            "uncertain": sum(pose.doubt == "other motion" for pose in found.poses),
        }
        options.print_json(report)


def odometry_of(
    readers: "Sequence[RecordingReader]",
    groups: "Sequence[Mapping[str, StampedIndex]]",
    pipelines: "_pulses.PipelinesBySensor",
    mountings: "Mapping[str, Mounting]",
    *,
    alone: bool | None = None,
    quiet: bool,
) -> "Odometry":
    """Return the odometry of pulses, under a progress bar."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.frames import is_passive
    from ertis_numba.motion import Odometry

    _require_times(readers, groups)
    found = Odometry(mountings, alone=alone)
    by_name = {reader.sensor: reader for reader in readers}
    settings = {reader.sensor: pipelines.settings(reader) for reader in readers}
    with options.progress(groups, length=len(groups), label="odometry", quiet=quiet) as shown:
        for group in shown:
            emitted = {name: place for name, place in group.items() if not is_passive(settings[name], place.stamp)}
            found.add([pipelines.image(by_name[name][place.index]) for name, place in emitted.items()])
    doubts = Counter(pose.doubt for pose in found.poses if pose.doubt)
    if doubts.total() == len(groups) - 1:
        reason = next((each for each in ("other motion", "copies") if doubts[each]), "few echoes")
        raise DataError(f"{readers[0].path}: {_REFUSALS[reason]}")
    for doubt, number in doubts.items():
        steps = options.counted(len(groups) - 1, "step")
        options.note(f"{number} of {steps} {_NOTES[doubt]}", quiet=quiet)
    return found


def _require_times(readers: "Sequence[RecordingReader]", groups: "Sequence[Mapping[str, StampedIndex]]") -> None:
    """Raise DataError if the times of pulses do not increase, or if sensors share no pulse."""
    from ertis_numba.base.errors import DataError

    if len(groups) < 2:
        raise DataError(f"{readers[0].path} contains one pulse; at least two are needed, from a moving platform")
    times_ns = [next(iter(group.values())).stamp.timestamp_ns for group in groups]
    if any(later <= earlier for earlier, later in pairwise(times_ns)):
        raise DataError(
            f"{readers[0].path} contains several pulses with the same timestamp; use recordings whose timestamps "
            "increase"
        )
    if len(readers) > 1 and all(len(group) == 1 for group in groups):
        spans = ", ".join(_span(reader) for reader in readers)
        raise DataError(
            f"no pulse has measurements of two sensors: {spans}; use recordings of the same SYNC pulses, whose clocks "
            "agree within half a second"
        )


def _span(reader: "RecordingReader") -> str:
    stamps = list(reader.stamps())
    counts = f"{stamps[0].sync_count} to {stamps[-1].sync_count}"
    first_s, last_s = (stamp.timestamp_ns / _NS_PER_S for stamp in (stamps[0], stamps[-1]))
    return f"{reader.sensor} has pulses {counts} from {first_s:.3f} s to {last_s:.3f} s"

"""Fused images of all sensors of one or several recordings."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ertis_cli._mountings import Mounting
    from ertis_numba.frames import Energyscape, Measurement, Stamp
    from ertis_numba.fusion import Fused
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import Settings
    from ertis_numba.storage import RecordingReader

__all__ = ["write_fused"]


def write_fused(
    paths: "Sequence[Path]",
    target: Path,
    changed: "Callable[[Settings], Settings]",
    *,
    mounting: "Mapping[str, Mounting] | None",
    emitter_diameter_m: float,
    force: bool,
    quiet: bool,
    as_json: bool,
    **device: Any,
) -> None:
    """Write the fused image of each SYNC pulse.

    Parameters
    ----------
    paths : sequence of Path
        Recordings of sensors of one platform.
    target : Path
        Energyscape file to write.
    changed : callable
        Function that returns the settings to use from those of the recording.
    mounting : mapping of str to Mounting, or None
        Mountings by sensor instead of those of the recordings.
    emitter_diameter_m : float
        Diameter of the emitters.
    force, quiet, as_json : bool
        As for the command.
    **device
        Device, threads and plan, as for `options.pipeline`.
    """
    from ertis_numba.fusion import PLATFORM, Fuser
    from ertis_numba.storage import EnergyscapeWriter, check_target

    check_target(target, overwrite=force, sources=paths)
    with ExitStack() as stack:
        readers = _readers(paths, stack)
        mountings = {reader.sensor: _mounting(reader, mounting) for reader in readers}
        fuser = Fuser(mountings, emitter_diameter_m=emitter_diameter_m)
        pipelines = _Pipelines(changed, stack, quiet=quiet, **device)
        groups = list(_groups(readers))
        incomplete = 0
        writer = stack.enter_context(
            EnergyscapeWriter(target, overwrite=force, mounting={PLATFORM: ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))})
        )
        by_name = {reader.sensor: reader for reader in readers}
        with options.progress(groups, length=len(groups), label="fusing", quiet=quiet) as shown:
            for number, group in enumerate(shown):
                fused = fuser(pipelines.image(by_name[name][place.index]) for name, place in group.items())
                incomplete += bool(fused.missing)
                if fused.missing:
                    options.say(f"note: pulse {number} has no image of {', '.join(fused.missing)}", quiet=quiet)
                writer.write(_numbered(fused, number))
    pulses = options.counted(len(groups), "pulse")
    options.say(f"{target}: {pulses} of {', '.join(by_name)}, fused", quiet=quiet)
    if as_json:
        report = {"output": str(target), "sensors": list(by_name), "pulses": len(groups), "incomplete": incomplete}
        options.print_json(report)


def _readers(paths: "Sequence[Path]", stack: ExitStack) -> "list[RecordingReader]":
    from ertis_numba.storage import open_recording, sensor_names

    found: dict[str, RecordingReader] = {}
    for path in paths:
        for name in sensor_names(path):
            if name in found:
                raise click.UsageError(
                    f"{path} and {found[name].path} have the same sensor {name!r}; give recordings of other sensors",
                    click.get_current_context(),
                )
            found[name] = stack.enter_context(open_recording(path, sensor=name))
    if len(found) < 2:
        raise click.UsageError(
            f"--fuse needs at least two sensors, but there is only {', '.join(found)}; give more recordings, or leave "
            "out --fuse",
            click.get_current_context(),
        )
    return list(found.values())


def _mounting(reader: "RecordingReader", given: "Mapping[str, Mounting] | None") -> "Mounting":
    from ertis_numba.errors import ArgumentError

    if given is not None and reader.sensor in given:
        return given[reader.sensor]
    if reader.translation_m is None or reader.rotation_xyzw is None:
        raise ArgumentError(
            f"{reader.path}: the mounting of sensor {reader.sensor!r} is unknown; give --mounting FILE with it"
        )
    return reader.translation_m.tolist(), reader.rotation_xyzw.tolist()


@dataclass(frozen=True)
class _StampedIndex:
    """Index of a measurement in the recording of its sensor, and its stamp."""

    index: int
    stamp: "Stamp"


def _groups(readers: "Sequence[RecordingReader]") -> "Iterator[dict[str, _StampedIndex]]":
    """Yield the measurements of each pulse, by sensor."""
    from ertis_numba.fusion.pulses import PulseGroups

    places = [_StampedIndex(index, stamp) for reader in readers for index, stamp in enumerate(reader.stamps())]
    groups: PulseGroups[_StampedIndex] = PulseGroups.of(reader.sensor for reader in readers)
    for place in sorted(places, key=lambda place: (place.stamp.timestamp_ns, place.stamp.sync_count)):
        yield from groups.add(place)
    rest = groups.close()
    if rest:
        yield rest


class _Pipelines:
    """Pipelines by sensor, for the air of each measurement."""

    def __init__(
        self, changed: "Callable[[Settings], Settings]", stack: ExitStack, *, quiet: bool, **device: Any
    ) -> None:
        self._changed, self._stack, self._quiet, self._device = changed, stack, quiet, device
        self._made: dict[str, tuple[Settings, Pipeline]] = {}

    def image(self, measurement: "Measurement") -> "Energyscape":
        """Return the image of a measurement."""
        sensor, settings = measurement.stamp.sensor, measurement.settings
        if sensor not in self._made or self._made[sensor][0] != settings:
            pipeline = options.pipeline(self._changed(settings), quiet=self._quiet, **self._device)
            self._made[sensor] = settings, self._stack.enter_context(pipeline)
        pipeline = self._made[sensor][1]
        return pipeline.process(replace(measurement, settings=pipeline.settings))


def _numbered(fused: "Fused", number: int) -> "Energyscape":
    """Return the image with the number of its pulse, since sensors may have begun at different numbers."""
    stamp = replace(fused.image.stamp, sequence=number, session_id=0)
    return fused.image.replace(stamp=stamp)

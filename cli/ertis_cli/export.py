"""``ertis export``: energyscapes and signals for other programs."""

import itertools
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _export_drive, _export_sound, _mountings, _poses, options
from ertis_numba.interop.export_formats import EXPORT_FORMATS, TOPICS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from ertis_numba.frames import Beams, Energyscape, Measurement, MicrophoneSignals
    from ertis_numba.storage import EnergyscapeReader, RecordingReader

    _Exported = Energyscape | Measurement | Beams | MicrophoneSignals

__all__ = ["export"]

_ENDINGS = ", ".join(f"{each.suffix} {each.about}".rstrip() for each in EXPORT_FORMATS.values())


class _Places(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "I|A:B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        first, colon, last = str(value).partition(":")
        with suppress(ValueError):
            places = int(first), int(last if colon else first)
            if min(places) >= 0:
                return places
        return self.fail(f"{value!r} is not a measurement; use one number, or two as in 2:5", param, ctx)


@click.command()
@options.input_files("REC.h5|IMG.h5...")
@click.option(
    "--output",
    "-o",
    "target",
    type=options.FILE,
    metavar="OUT",
    required=True,
    help=f"File to write: {_ENDINGS}.",
)
@click.option(
    "--format",
    "file_format",
    type=click.Choice([*EXPORT_FORMATS]),
    help="Output format; chosen by the suffix of OUT by default.",
)
@options.sensor("Export this sensor only; all sensors by default.")
@click.option(
    "--measurement",
    "-m",
    "places",
    type=_Places(),
    metavar="I|A:B",
    help="One measurement, counted from 0, or measurements A to B; all by default.",
)
@click.option(
    "--topic",
    "topics",
    type=click.Choice(TOPICS),
    multiple=True,
    help="Topic to write to an MCAP file; repeat for several; all topics by default.",
)
@click.option("--top", type=int, metavar="N", help="Largest number of points per image; 256 by default.")
@click.option(
    "--min-level",
    "min_level_db",
    type=float,
    metavar="DB",
    help="Omit points below this level, relative to the strongest; -20 by default.",
)
@_mountings.mounting
@click.option("--ascii", "text", is_flag=True, help="Write PLY and PCD as text.")
@_export_drive.drive_options
@_export_sound.sound_options
@options.force
@options.quiet
@options.as_json
def export(
    *,
    paths: tuple[Path, ...],
    target: Path,
    file_format: str | None,
    sensor: str | None,
    places: tuple[int, int] | None,
    topics: tuple[str, ...],
    top: int | None,
    min_level_db: float | None,
    mounting: Path | None,
    text: bool,
    direction: tuple[float, float] | None,
    heterodyne_hz: float | None,
    expansion: float | None,
    with_silence: bool,
    force: bool,
    quiet: bool,
    as_json: bool,
    **drive: Any,
) -> None:
    """Export images or signals for other programs.

    MCAP contains ROS 2 messages. PLY, PCD and CSV contain the points of images, and NPZ the images of one sensor. The
    files for Acoular contain the microphone signals of one measurement. TUM files contain the poses of a recording.
    BatSLAM 2.0 reads the echoes at two virtual ears, true poses and odometry; several recordings then belong to one
    platform. WAV files contain the sound
    from one direction. Except for Acoular, TUM, BatSLAM and WAV, a recording is first processed with its own settings.
    """
    from ertis_numba import interop

    name = interop.choose_format(target, file_format)
    content = interop.EXPORT_FORMATS[name].content
    _export_drive.require_fitting(name, paths)
    if content == "poses":
        _poses.export_poses(paths[0], target, sensor, force=force, quiet=quiet, as_json=as_json)
        return
    from ertis_numba.storage import check_target, file_kind, open_recording, sensor_names

    if content == "sound":
        sound = _export_sound.SoundOptions(direction, heterodyne_hz, expansion, with_silence)
        _export_sound.require_possible(sound)
        with open_recording(paths[0], sensor=sensor) as reader:
            _export_sound.export_sound(
                reader, _between(places, len(reader)), target, sound, force=force, quiet=quiet, as_json=as_json
            )
        return
    for file in interop.output_files(target, name):
        check_target(file, overwrite=force, sources=paths)
    given = {"topics": topics or None, "top": top, "min_level_db": min_level_db, "text": text}
    fitting = interop.FORMATS[name].options
    chosen: dict[str, Any] = {key: value for key, value in given.items() if key in fitting}
    with ExitStack() as stack:
        every, readers = _readers(content, paths, sensor, stack)
        known = _known(every, mounting) if "mounting" in fitting else None
        process = content not in {"signals", "drive"} and file_kind(paths[0]) == "recording"
        items = _Items(readers, places, process=process, echoes=content == "drive", quiet=quiet)
        if content == "drive":
            (ears,), (indices,) = readers, items.indices
            chosen["drive"] = _export_drive.drive_of(every, ears, indices, known or {}, **drive, quiet=quiet)
        written = interop.export(
            target,
            items,
            file_format=name,
            mounting=known,
            overwrite=force,
            **chosen,
        )
    if known is not None:
        _note_places(readers, known, content, quiet=quiet)
    if content == "topics" and sum(len(sensor_names(path)) for path in paths) > 1 and "scan" in (topics or TOPICS):
        options.note(
            "scans of single sensors contain echoes of the other sensors' calls; for /fused/scan, export the file that "
            "'ertis fuse' writes",
            quiet=quiet,
        )
    measurements, sensors = options.counted(len(items), "measurement"), options.counted(len(readers), "sensor")
    options.say(f"{target}: {measurements} of {sensors} as {name}", quiet=quiet)
    if as_json:
        options.print_json(
            {
                "output": str(target),
                "format": name,
                "files": [str(file) for file in written],
                "sensors": [reader.sensor for reader in readers],
                "measurements": len(items),
            }
        )


def _readers(
    content: str, paths: tuple[Path, ...], sensor: str | None, stack: ExitStack
) -> "tuple[Sequence[Any], Sequence[Any]]":
    """Open files; return the readers of all sensors of the platform, and of those to export."""
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording

    if content == "drive":
        every, ears = _export_drive.open_ears(paths, sensor, stack)
        return every, [ears]
    path = paths[0]
    open_file: Callable[..., Any] = (
        open_recording if content == "signals" or file_kind(path) == "recording" else open_energyscapes
    )
    readers = [stack.enter_context(open_file(path, sensor=each)) for each in options.sensors_of(path, sensor)]
    for reader in readers:
        options.note_missing_points(reader, quiet=content == "results")
    return readers, readers


def _known(
    readers: "Sequence[RecordingReader | EnergyscapeReader]", given: Path | None
) -> "dict[str, _mountings.Mounting]":
    """Return the mountings of sensors from the file given with --mounting, or else from the input file."""
    if given is not None:
        return _mountings.mountings(given, [reader.sensor for reader in readers]) or {}
    return {
        each.sensor: (each.translation_m.tolist(), each.rotation_xyzw.tolist())
        for each in readers
        if each.translation_m is not None and each.rotation_xyzw is not None
    }


def _note_places(
    readers: "Sequence[RecordingReader | EnergyscapeReader]",
    known: "Mapping[str, _mountings.Mounting]",
    content: str,
    *,
    quiet: bool,
) -> None:
    """Report microphones and sensors whose place on the platform is unknown."""
    for reader in () if content == "drive" else readers:
        options.note_unknown_places(reader.sensor, reader.settings, quiet=quiet)
    unknown = [reader.sensor for reader in readers if reader.sensor not in known]
    remedy = "the export uses the frame of the sensor; add --mounting FILE for the frame of the platform"
    _mountings.note_unknown(unknown, remedy, quiet=quiet)


class _Items:
    """Measurements, or images with process, to export under a progress bar; with echoes, those with a call."""

    def __init__(
        self,
        readers: "Sequence[RecordingReader | EnergyscapeReader]",
        places: tuple[int, int] | None,
        *,
        process: bool,
        echoes: bool,
        quiet: bool,
    ) -> None:
        self._readers, self._process, self._quiet = readers, process, quiet
        chosen = [_between(places, len(reader)) for reader in readers]
        self.indices = [
            _with_call(reader, each)
            if echoes or (process and reader.settings.processing.last_stage == "envelope")  # Signals need no call.
            else each
            for reader, each in zip(readers, chosen, strict=True)
        ]
        n_passive = sum(map(len, chosen)) - len(self)
        if n_passive:
            left_out = options.counted(n_passive, "measurement")
            options.note(
                f"{left_out} without a call left out; 'ertis acoustic' makes maps of their sound",
                quiet=quiet,
            )

    def __len__(self) -> int:
        return sum(map(len, self.indices))

    def __iter__(self) -> "Iterator[_Exported]":
        with options.progress(self._each(), length=len(self), label="exporting", quiet=self._quiet) as shown:
            yield from shown

    def _each(self) -> "Iterator[_Exported]":
        for reader, chosen in zip(self._readers, self.indices, strict=True):
            read = (reader[index] for index in chosen)
            yield from self._processed(read) if self._process else read

    def _processed(self, measurements: "Iterable[Any]") -> "Iterator[_Exported]":
        """Yield results; each change of the air needs a new pipeline."""
        for settings, group in itertools.groupby(measurements, lambda measurement: measurement.settings):
            with options.pipeline(settings, quiet=self._quiet) as pipeline:
                for measurement in group:
                    yield pipeline.result(measurement)


def _with_call(reader: "RecordingReader | EnergyscapeReader", chosen: range) -> "Sequence[int]":
    """Return the chosen measurements of a recording that have echoes of a call."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.frames import is_passive

    stamps = list(reader.stamps())
    found = [place for place in chosen if not is_passive(reader.settings, stamps[place])]
    if chosen and not found:
        raise DataError(
            f"{reader.path}: all chosen measurements of sensor {reader.sensor} are passive and have no echoes; use "
            "'ertis acoustic' for maps of their sound, or write wav"
        )
    return found


def _between(places: tuple[int, int] | None, count: int) -> range:
    """Return the chosen range of measurement indices; raise an error if it is outside the file."""
    if places is None:
        return range(count)
    first, last = (options.place(place, count) for place in places)
    if first > last:
        raise click.UsageError(
            f"--measurement runs from {first} to {last}; use the smaller number first", click.get_current_context()
        )
    return range(first, last + 1)

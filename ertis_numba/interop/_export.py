"""Energyscapes, beams and microphone signals in the formats of other programs."""

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeAlias

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import atomic_write, check_target, remedy
from ertis_numba.base.errors import ArgumentError, DataError, ErtisError
from ertis_numba.frames import Beams, Energyscape, Measurement, MicrophoneSignals
from ertis_numba.geometry import observable_angles
from ertis_numba.interop._drive import Drive
from ertis_numba.interop._mountings import Mountings, validated
from ertis_numba.interop.export_formats import EXPORT_FORMATS, FORMATS, TOPICS, ExportFormat

__all__ = ["choose_format", "export", "output_files", "require_options"]

Exported: TypeAlias = Energyscape | Measurement | Beams | MicrophoneSignals
"""Items that some format supports."""


def choose_format(
    path: str | Path, name: str | None = None, formats: Mapping[str, ExportFormat] = EXPORT_FORMATS
) -> str:
    """Return the name of the format to write: the given name, or that of the file's suffix."""
    if name is None:
        endings = {each.suffix: known for known, each in formats.items()}
        return endings[checks.file_ending("export", path, endings)]
    checks.choice("format", name, formats)
    return name


def output_files(path: str | Path, name: str) -> tuple[Path, ...]:
    """Return the files of an export: for ``acoular`` also that of the array, with the suffix ``.xml``."""
    if name != "acoular":
        return (Path(path),)
    files = Path(path), Path(path).with_suffix(".xml")
    if files[0] == files[1]:
        raise ArgumentError(f"{path} is also the name of the array's file; choose a name that ends in .h5")
    return files


def export(
    path: str | Path,
    items: Iterable[Exported],
    *,
    file_format: str | None = None,
    mounting: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None,
    topics: Collection[str] | None = None,
    top: int | None = None,
    min_level_db: float | None = None,
    text: bool = False,
    drive: Drive | None = None,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write energyscapes, or the signals of measurements, for other programs.

    A file appears complete, or not at all. ``docs/how-to/export.md`` describes the formats and their fields.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    items : iterable of Energyscape, of Measurement, or of Beams or MicrophoneSignals
        One measurement for ``acoular``, measurements of one sensor for ``batslam``, otherwise energyscapes. ``npz`` can
        also contain beams, or microphone signals: demodulated ones if that is the last stage of their settings, and
        matched-filtered ones otherwise; it holds one sensor. Other formats can contain several sensors. ``mcap`` is
        written one image at a time, and so is ``npz`` if ``items`` has a length. Other formats collect all points or
        signals first.
    file_format : str, optional
        Name of the format, one of ``interop.FORMATS``; by default that of the suffix of ``path``.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mounting of each sensor on its platform, by name, as for `RecordingWriter`. Points of ``ply``, ``pcd`` and
        ``csv`` are then in the platform frame, otherwise in the sensor frame. ``batslam`` contains the
        poses of the sensor, not of the platform.
    topics : collection of {"points", "scan", "image", "sonar_image"}, optional
        Topics of each sensor in ``mcap``; all by default.
    top : int, optional
        Maximum number of points per image; the strongest 256 by default.
    min_level_db : float, optional
        Minimum level relative to the strongest point of the image; -20 dB by default.
    text : bool
        Write ``ply`` and ``pcd`` as text.
    drive : Drive, optional
        Poses and odometry of the platform for ``batslam``, which needs them.
    overwrite : bool
        Replace existing files.

    Returns
    -------
    tuple of Path
        Written files. For ``acoular``, the second file describes the array and has the suffix ``.xml``.

    Raises
    ------
    ArgumentError
        There is nothing to write, the format does not support the items or an option, an option is missing, or a file
        exists.
    DataError
        The disk is full or cannot be written.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     images = list(ertis.Pipeline(recording.settings).process_many(recording))
    >>> for path in ertis.export("points.csv", images, overwrite=True):
    ...     print(path)
    points.csv
    """
    if not isinstance(items, Iterable):
        raise ArgumentError(f"items is of type {type(items).__name__}; pass a list of Energyscape")
    name = choose_format(path, file_format, FORMATS)
    finding = {"top": top, "min_level_db": min_level_db}
    require_options(name, {"mounting": mounting, "topics": topics, "text": text or None, **finding, "drive": drive})
    chosen = TOPICS if topics is None else topics
    for topic in chosen:
        checks.choice("topic", topic, TOPICS)
    paths = output_files(path, name)
    for each in paths:
        check_target(each, overwrite=overwrite)
    try:
        with ExitStack() as stack:
            parts = [stack.enter_context(atomic_write(each, overwrite=overwrite)) for each in paths]
            match FORMATS[name].content:
                case "signals":
                    _write_signals(name, parts, items)
                case "results":
                    FORMATS[name].load()(*parts, _results(items), len(items) if isinstance(items, Sized) else None)
                case "drive":
                    _write_drive(name, parts[0], items, validated(mounting), drive)
                case _:
                    _write_points(
                        name, parts[0], _located(items, name), validated(mounting), chosen, finding, text=text
                    )
    except OSError as error:
        if isinstance(error, ErtisError):  # Errors of the images' source pass unchanged.
            raise
        raise DataError(f"{path} cannot be written ({error.strerror or error}); {remedy(error)}") from error
    return paths


def require_options(name: str, given: Mapping[str, object]) -> None:
    """Refuse options that a format does not use; None stands for an option that is not given."""
    for option, value in given.items():
        if value is not None and option not in EXPORT_FORMATS[name].options:
            *others, last = [other for other, each in EXPORT_FORMATS.items() if option in each.options]
            fitting = f"{', '.join(others)} or {last}" if others else last
            raise ArgumentError(
                f"option {option!r} is given, but format {name!r} does not have it; leave it out, or write {fitting}"
            )


def _write_signals(name: str, paths: Sequence[Path], items: Iterable[Exported]) -> None:
    several = list(itertools.islice(items, 2))
    if len(several) != 1 or not isinstance(several[0], Measurement):
        came = f"{'no' if not several else 'more than one'} measurement" if len(several) != 1 else "an energyscape"
        raise ArgumentError(
            f"format {name!r} contains signals of one measurement, but {came} was passed; choose one measurement "
            "(measurement)"
        )
    FORMATS[name].load()(*paths, several[0])


def _write_drive(name: str, path: Path, items: Iterable[Any], mountings: Mountings, drive: Drive | None) -> None:
    if drive is None:
        raise ArgumentError(f"format {name!r} needs poses and odometry; pass drive=Drive(poses=…, odometry=…)")
    FORMATS[name].load()(path, items, drive, mountings)


def _write_points(
    name: str,
    path: Path,
    images: Iterator[Energyscape],
    mountings: Mountings,
    topics: Collection[str],
    finding: dict[str, Any],
    *,
    text: bool,
) -> None:
    from ertis_numba.analysis.point_finder import PointFinder  # noqa: PLC0415  it imports scipy.spatial
    from ertis_numba.interop._points import PointTable  # noqa: PLC0415

    find, write = PointFinder(**finding), FORMATS[name].load()
    if FORMATS[name].content == "topics":
        write(path, images, find, mountings, topics=topics)
        return
    table = PointTable.from_images(images, find, mountings)
    write(path, table, **({"text": text} if "text" in FORMATS[name].options else {}))


def _energyscapes(items: Iterable[Exported]) -> Iterator[Energyscape]:
    """Yield energyscapes; refuse other results."""
    for item in _results(items):
        if not isinstance(item, Energyscape):
            raise ArgumentError(
                f"{type(item).__name__} is given, but this format holds images; write npz, or call Pipeline.process"
            )
        yield item


def _located(items: Iterable[Exported], name: str) -> Iterator[Energyscape]:
    """Yield energyscapes; refuse those of an array that observes no directions, such as one on an inclined line."""
    for image in _energyscapes(items):
        seen = observable_angles(image.settings.array)
        if not (seen.azimuth or seen.elevation) or not seen.has_direction(is_planar=image.is_planar):
            raise ArgumentError(
                f"sensor {image.stamp.sensor} {seen.note}, so format {name!r} cannot place points; write npz"
            )
        yield image


def _results(items: Iterable[Exported]) -> Iterator[Energyscape | Beams | MicrophoneSignals]:
    """Yield results of processing; refuse measurements, and an empty sequence."""
    count = 0
    for count, item in enumerate(items, 1):  # noqa: B007  it is used below
        if not isinstance(item, Energyscape | Beams | MicrophoneSignals):
            raise ArgumentError(
                "a measurement is given, but energyscapes are needed; process it first (Pipeline.process)"
            )
        yield item
    if not count:
        raise ArgumentError("no energyscape is passed; pass at least one")

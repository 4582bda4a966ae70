"""Energyscapes, beams and microphone signals in the formats of other programs."""

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import atomic_write, check_target, remedy
from ertis_numba.base.errors import ArgumentError, DataError, ErtisError
from ertis_numba.frames import Beams, Energyscape, Measurement, MicrophoneSignals
from ertis_numba.geometry import observable_angles
from ertis_numba.interop._drive import Drive
from ertis_numba.interop._mountings import Mountings, validated

__all__ = ["FORMATS", "TOPICS", "ExportFormat", "choose_format", "export", "output_files"]

TOPICS: Final = ("points", "scan", "image", "sonar_image")
"""Products of a sensor in MCAP."""
Exported: TypeAlias = Energyscape | Measurement | Beams | MicrophoneSignals
"""Items that some format supports."""
_POINTS = (
    *("x", "y", "z", "intensity", "uncertainty_range", "uncertainty_across"),
    *("sensor", "sequence", "sec", "nanosec"),
)
_POINT_OPTIONS = ("mounting", "top", "min_level_db")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportFormat:
    """Export format."""

    suffix: str
    fields: tuple[str, ...]
    options: tuple[str, ...] = ()  # of `export` that apply to this format, but not to all


FORMATS: Final = {
    "mcap": ExportFormat(suffix=".mcap", fields=(*TOPICS, "tf_static"), options=(*_POINT_OPTIONS, "topics")),
    "ply": ExportFormat(suffix=".ply", fields=_POINTS, options=(*_POINT_OPTIONS, "text")),
    "pcd": ExportFormat(suffix=".pcd", fields=_POINTS, options=(*_POINT_OPTIONS, "text")),
    "csv": ExportFormat(
        suffix=".csv",
        fields=(
            *("sensor", "session_id", "sequence", "sync_count", "timestamp_ns"),
            *("x_m", "y_m", "z_m", "amplitude", "uncertainty_range_m", "uncertainty_across_m"),
        ),
        options=_POINT_OPTIONS,
    ),
    "npz": ExportFormat(
        suffix=".npz",
        fields=(
            *("amplitude", "azimuth_rad", "elevation_rad", "range_m"),
            *("session_id", "sequence", "sync_count", "timestamp_ns", "timestamp_uncertainty_ns"),
            *("behaviour", "sensor", "settings"),
        ),
    ),
    "acoular": ExportFormat(suffix=".h5", fields=("time_data", "metadata")),
    "batslam": ExportFormat(
        suffix=".mat",
        fields=(
            *("gt_pose", "gt_delta", "odom_delta", "t", "lap"),
            *("echo_left", "echo_right", "echo_scale", "meta", "reflectors"),
        ),
        options=("mounting", "drive"),
    ),
}
"""Formats by name; the how-to guide on exports states the content of each."""


def choose_format(path: str | Path, name: str | None = None) -> str:
    """Return the name of the format to write: the given name, or that of the file's suffix."""
    if name is None:
        endings = {each.suffix: known for known, each in FORMATS.items()}
        return endings[checks.file_ending("export", path, endings)]
    checks.choice("format", name, FORMATS)
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
    file_format : {"mcap", "ply", "pcd", "csv", "npz", "acoular", "batslam"}, optional
        Name of the format; by default that of the suffix of ``path``.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mounting of each sensor on its platform, by name, as for `RecordingWriter`. Points of ``ply``, ``pcd`` and
        ``csv`` are then in the platform frame, otherwise in the sensor frame. ``batslam`` contains the
        poses of the sensor, not of the platform.
    topics : collection of {"points", "image", "sonar_image"}, optional
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
    name = choose_format(path, file_format)
    finding = {"top": top, "min_level_db": min_level_db}
    _require_options(name, {"mounting": mounting, "topics": topics, "text": text or None, **finding, "drive": drive})
    chosen = TOPICS if topics is None else topics
    for topic in chosen:
        checks.choice("topic", topic, TOPICS)
    paths = output_files(path, name)
    for each in paths:
        check_target(each, overwrite=overwrite)
    try:
        with ExitStack() as stack:
            parts = [stack.enter_context(atomic_write(each, overwrite=overwrite)) for each in paths]
            if name == "acoular":
                _write_signals(parts[0], parts[1], items)
            elif name == "npz":
                _write_npz(parts[0], items)
            elif name == "batslam":
                _write_drive(parts[0], items, validated(mounting), drive)
            else:
                _write_points(name, parts[0], _located(items, name), validated(mounting), chosen, finding, text=text)
    except OSError as error:
        if isinstance(error, ErtisError):  # Errors of the images' source pass unchanged.
            raise
        raise DataError(f"{path} cannot be written ({error.strerror or error}); {remedy(error)}") from error
    return paths


def _require_options(name: str, given: Mapping[str, object]) -> None:
    """Refuse options that a format does not use; None stands for an option that is not given."""
    for option, value in given.items():
        if value is not None and option not in FORMATS[name].options:
            *others, last = [other for other, each in FORMATS.items() if option in each.options]
            fitting = f"{', '.join(others)} or {last}" if others else last
            raise ArgumentError(
                f"option {option!r} is given, but format {name!r} does not have it; leave it out, or write {fitting}"
            )


# Writers are imported when they are needed: they import scipy.spatial, and one of them needs an extra.


def _write_signals(path: Path, geometry: Path, items: Iterable[Exported]) -> None:
    from ertis_numba.interop._acoular import write_acoular  # noqa: PLC0415

    several = list(itertools.islice(items, 2))
    if len(several) != 1 or not isinstance(several[0], Measurement):
        came = f"{'no' if not several else 'more than one'} measurement" if len(several) != 1 else "an energyscape"
        raise ArgumentError(
            f"format 'acoular' contains signals of one measurement, but {came} was passed; choose one measurement "
            "(measurement)"
        )
    write_acoular(path, geometry, several[0])


def _write_drive(path: Path, items: Iterable[Any], mountings: Mountings, drive: Drive | None) -> None:
    from ertis_numba.interop._batslam import write_batslam  # noqa: PLC0415

    if drive is None:
        raise ArgumentError("format 'batslam' needs poses and odometry; pass drive=Drive(poses=…, odometry=…)")
    write_batslam(path, items, drive, mountings)


def _write_npz(path: Path, items: Iterable[Exported]) -> None:
    from ertis_numba.interop._npz import write_npz  # noqa: PLC0415

    count = len(items) if isinstance(items, Sized) else None
    write_npz(path, _results(items), count)


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
    from ertis_numba.analysis.point_finder import PointFinder  # noqa: PLC0415
    from ertis_numba.interop import _mcap, _point_files  # noqa: PLC0415
    from ertis_numba.interop._points import PointTable  # noqa: PLC0415

    find = PointFinder(**finding)
    if name == "mcap":
        _mcap.write_mcap(path, images, find, mountings, topics=topics)
        return
    table = PointTable.from_images(images, find, mountings)
    if name == "csv":
        _point_files.write_csv(path, table)
    elif name == "ply":
        _point_files.write_ply(path, table, text=text)
    else:
        _point_files.write_pcd(path, table, text=text)


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

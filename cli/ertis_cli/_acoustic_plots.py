"""Plots of acoustic maps and of sound: their inputs."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_numba.base.constants import FALSE_ALARM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ertis_numba.frames import AcousticMap, Measurement

__all__ = ["FIELD_OF_VIEW", "KINDS", "draw", "is_acoustic", "plot_options", "require_fitting", "row_name"]

KINDS = {
    "acoustic_map": "sound power from each direction, chosen for passive measurements and files of acoustic maps",
    "spectrum": "level over frequency of a direction, or of the mean of the microphones",
    "spectrogram": "level over time and frequency of a direction, or of the mean of the microphones",
}
_OF_MAPS = ("acoustic_map", "spectrum")


class _FieldOfView(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "AZ,EL"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        horizontal, comma, vertical = str(value).partition(",")
        if comma:
            with suppress(ValueError):
                return float(horizontal), float(vertical)
        return self.fail(f"{value!r} is not a field of view; use two angles in degrees, such as 60,40", param, ctx)


FIELD_OF_VIEW = _FieldOfView()


def plot_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of acoustic maps."""
    for option in (
        click.option(
            "--photo-fov",
            "photo_fov_deg",
            type=FIELD_OF_VIEW,
            help="Horizontal and vertical field of view of --photo in degrees.",
        ),
        click.option(
            "--photo",
            type=options.FILE,
            metavar="PICTURE",
            help="Draw an acoustic map over a picture, whose camera is at the sensor and looks ahead.",
        ),
        click.option(
            "--band",
            "band_hz",
            type=options.INTERVAL,
            help="Bands of an acoustic map to add: limits of their centres in Hz; all by default.",
        ),
    ):
        command = option(command)
    return command


def is_acoustic(path: Path, sensor: str | None, index: int) -> bool:
    """Return True for a file of acoustic maps, and for a passive measurement; False for files that cannot be read."""
    from ertis_numba.base.errors import ErtisError
    from ertis_numba.frames import is_passive
    from ertis_numba.storage import file_kind, open_recording

    with suppress(ErtisError):
        kind = file_kind(path)
        if kind == "recording":
            with open_recording(path, sensor=sensor) as recording:
                stamps = recording.stamps()
                return 0 <= index < len(stamps) and is_passive(recording.settings, stamps[index])
        return kind == "acoustic_map"
    return False


def require_fitting(kind: str, path: Path) -> None:
    """Raise an error for a file of acoustic maps and a kind of plot that it does not support."""
    from ertis_numba.base.errors import ErtisError
    from ertis_numba.storage import file_kind

    with suppress(ErtisError):  # Reading the file reports the error.
        if kind not in _OF_MAPS and file_kind(path) == "acoustic_map":
            raise click.UsageError(
                f"--kind {kind} does not support {path}, a file of acoustic maps; use --kind {' or '.join(_OF_MAPS)}, "
                "or its recording",
                click.get_current_context(),
            )


def row_name(path: Path) -> str:
    """Return the name of a row in a file, which --measurement counts: ``map`` or ``measurement``."""
    from ertis_numba.storage import file_kind

    return "map" if file_kind(path) == "acoustic_map" else "measurement"


def draw(
    kind: str,
    path: Path,
    sensor: str | None,
    index: int,
    *,
    steer: tuple[float, float] | None,
    band_hz: tuple[float, float] | None,
    photo: Path | None,
    photo_fov_deg: tuple[float, float] | None,
    quiet: bool,
    look: dict[str, Any],
) -> "tuple[Figure, str]":
    """Return the figure of a kind, and the name of its sensor."""
    from ertis_numba import figures
    from ertis_numba.storage import file_kind

    if kind == "acoustic_map":
        _require_pair(photo, photo_fov_deg)
        found, note = _map(path, sensor, index, quiet=quiet)
        figure = figures.acoustic_map(found, band_hz=band_hz, photo=photo, photo_fov_deg=photo_fov_deg, **look)
        _warn_of_map(found, note)
        return figure, found.stamp.sensor
    if kind == "spectrum" and file_kind(path) == "acoustic_map":
        found, note = _map(path, sensor, index, quiet=quiet)
        figure = figures.spectrum(found, direction_deg=steer, **look)
        _warn_of_map(found, note)
        return figure, found.stamp.sensor
    if kind == "spectrum":
        source = _measurement(path, sensor, index)
        return figures.spectrum(source, direction_deg=steer, **look), source.stamp.sensor
    heard = _measurement(path, sensor, index)
    return figures.spectrogram(heard, direction_deg=steer, **look), heard.stamp.sensor


def _warn_of_map(found: "AcousticMap", note: str | None) -> None:
    """Print notes on a map that is drawn: its directions, and sound that its bands do not show."""
    from ertis_numba.passive.search_grid import coarse_map_warning

    options.note_unknown_angles(found.stamp.sensor, found.settings, found, is_passive=True)
    options.warn_of(found.stamp.sensor, coarse_map_warning(found.settings, found))
    options.warn_of(found.stamp.sensor, note)


def _require_pair(photo: Path | None, photo_fov_deg: tuple[float, float] | None) -> None:
    """Raise an error for a photo without its field of view, or the reverse."""
    context = click.get_current_context()
    if photo is not None and photo_fov_deg is None:
        raise click.UsageError("--photo needs --photo-fov AZ,EL, its field of view in degrees; add it", context)
    if photo is None and photo_fov_deg is not None:
        raise click.UsageError("--photo-fov needs --photo PICTURE; add it, or leave out --photo-fov", context)


def _map(path: Path, sensor: str | None, index: int, *, quiet: bool) -> "tuple[AcousticMap, str | None]":
    """Return a map, and a note on sound that its bands do not show."""
    from ertis_numba.storage import file_kind, open_acoustic_maps

    if file_kind(path) == "acoustic_map":
        with open_acoustic_maps(path, sensor=sensor) as maps:
            return maps[options.place(index, len(maps))], maps.band_note
    heard = _measurement(path, sensor, index)
    with options.note_when_slow(options.PREPARING, quiet=quiet):
        from ertis_numba.passive import AcousticCamera

        with AcousticCamera(heard.settings, check=False, false_alarm=FALSE_ALARM) as camera:
            return camera.process(heard), camera.band_note


def _measurement(path: Path, sensor: str | None, index: int) -> "Measurement":
    from ertis_numba.storage import open_recording

    with open_recording(path, sensor=sensor) as recording:
        return recording[options.place(index, len(recording))]

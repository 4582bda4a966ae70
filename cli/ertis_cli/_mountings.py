"""Mountings of sensors: read from a file, and reported if unknown."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_cli.options import Decorator

__all__ = ["Mounting", "mounting", "mountings", "note_unknown"]

Mounting = tuple[Sequence[float], Sequence[float]]
_WANTED: Final = "a scene or mounting file (.toml), or a file of ertis that contains mountings"

mounting: "Decorator" = click.option(
    "--mounting",
    type=options.FILE,
    metavar="FILE",
    help="Mountings of sensors on their platform: a scene, its [[sensors]], or a recording that contains them.",
)


def mountings(path: Path | None, sensors: Iterable[str] | None) -> dict[str, Mounting] | None:
    """Return the mountings of some or all sensors, at the start of a scene; return None without a file."""
    if path is None:
        return None
    from ertis_numba.base.errors import ArgumentError

    known = _of_scene(path) if path.suffix.lower() == ".toml" else _of_file(path)
    if not known:
        raise ArgumentError(f"{path} contains no mounting of a sensor; use a scene, or its [[sensors]]")
    wanted = [*known] if sensors is None else [*sensors]
    for name in wanted:
        if name not in known:
            raise ArgumentError(
                f"{path} does not contain sensor {name!r}; add its mounting, or use sensors of this file: "
                f"{', '.join(known)}"
            )
    return {name: known[name] for name in wanted}


def note_unknown(sensors: Sequence[str], remedy: str, *, quiet: bool) -> None:
    """Print a line if the mounting of sensors is unknown."""
    if sensors:
        noun = "sensor" if len(sensors) == 1 else "sensors"
        options.note(f"the mounting of {noun} {', '.join(sensors)} is unknown; {remedy}", quiet=quiet)


def _of_scene(path: Path) -> dict[str, Mounting]:
    from ertis_numba.simulation.scene import load_scene

    return {
        sensor.name: (sensor.path().position_at(0.0).tolist(), sensor.quaternion().tolist())
        for sensor in load_scene(path).sensors
    }


def _of_file(path: Path) -> dict[str, Mounting]:
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording, sensor_names

    opened = open_energyscapes if file_kind(path, _WANTED) == "energyscape" else open_recording
    found = {}
    for name in sensor_names(path):
        with opened(path, sensor=name) as reader:
            if reader.translation_m is not None and reader.rotation_xyzw is not None:
                found[name] = reader.translation_m.tolist(), reader.rotation_xyzw.tolist()
    return found

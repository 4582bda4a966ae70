"""Comparison of an existing output with the one to be made."""

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from ertis_numba.base.errors import DamagedError, ErtisError
from ertis_numba.campaign.recordings import ResultKind
from ertis_numba.geometry import direction_grid, grid_count, self_contained
from ertis_numba.settings import Accuracy, Settings
from ertis_numba.storage import (
    AcousticMapReader,
    EnergyscapeReader,
    RecordingReader,
    file_kind,
    open_acoustic_maps,
    open_energyscapes,
    sensor_names,
)
from ertis_numba.storage.recording import Mounting
from ertis_numba.storage.schema import software_versions

__all__ = ["difference", "inspect_output"]

_AUTOMATIC = (None, "auto")  # Values that let the planner choose.
_UNREADABLE = (OSError, RuntimeError, LookupError, AttributeError, TypeError, ValueError)  # Errors of h5py.


_Reader = EnergyscapeReader | AcousticMapReader

_OPENERS: Final[dict[ResultKind, Callable[..., _Reader]]] = {
    "energyscape": open_energyscapes,
    "acoustic_map": open_acoustic_maps,
}


def _axes(made: _Reader) -> str:
    return _digest(made.azimuth_rad.tobytes(), made.elevation_rad.tobytes())


def _mounting(made: _Reader) -> list[list[float]] | None:
    """Return translation and rotation of the sensor; None if its mounting is unknown."""
    if made.translation_m is None or made.rotation_xyzw is None:
        return None
    return [made.translation_m.tolist(), made.rotation_xyzw.tolist()]


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(parts)).hexdigest()


def inspect_output(target: Path, recording: RecordingReader, kind: ResultKind, dtype: str) -> dict[str, Any] | None:
    """Return settings and axes by sensor of an existing output of a recording; None without a file."""
    # `differs` is the reason why the file is not this output, or that it is damaged.
    if not target.exists():
        return None
    try:
        found, made_of = _read(target, recording, kind, dtype)
    except DamagedError:
        return {"differs": "is damaged"}
    except (ErtisError, *_UNREADABLE):
        return {
            "differs": f"is not a readable {'energyscape file' if kind == 'energyscape' else 'file of acoustic maps'}"
        }
    if not found["differs"] and made_of != recording.sha256():  # Hashing reads the whole file, so it comes last.
        return {"differs": "was made from another file of the same recording"}
    return found


def _read(target: Path, recording: RecordingReader, kind: ResultKind, dtype: str) -> tuple[dict[str, Any], object]:
    """Return the description of a file, and the SHA-256 of the file that it was made from."""
    if file_kind(target) == "recording":
        return {"differs": "is a recording", "recording": True}, None
    sensors: dict[str, Any] = {}
    made_of: object = None
    for name in sensor_names(target):
        with _OPENERS[kind](target, sensor=name) as made:
            differs = _differs(made, recording, dtype)
            if differs:
                return {"differs": differs}, None
            made.check_rows()
            made_of = made.attributes.get("recording_sha256")
            sensors[name] = {
                "settings": made.settings.to_toml(),
                "axes": _axes(made),
                "measurements": len(made),
                "mounting": _mounting(made),
            }
    return {"differs": "", "sensors": sensors}, made_of


def _differs(made: _Reader, recording: RecordingReader, dtype: str) -> str:
    if made.attributes.get("recording_uuid") != recording.uuid:
        return "was made from another recording"
    for name, wanted in software_versions().items():
        came = made.attributes.get(f"{name.replace('-', '_')}_version", "unknown")
        if came != wanted:
            return f"was made by {name} {came}, but this is {wanted}"
    if made.dtype != dtype:
        return f"contains {made.dtype}, not {dtype}"
    if isinstance(made, AcousticMapReader) and not made.has_bearings:
        return "contains no bearings of sources"
    return ""


def difference(
    made: dict[str, Any], wanted: dict[str, Settings], mounting: Mapping[str, Mounting] | None = None
) -> str:
    """Return the difference between a file and the output of these settings and given mountings; empty if none."""
    if made["differs"]:
        return str(made["differs"])
    if list(made["sensors"]) != list(wanted):
        return f"contains sensor {', '.join(made['sensors'])}, not {', '.join(wanted)}"
    for name, settings in wanted.items():
        held = made["sensors"][name]
        found = _changed(Settings.from_toml(held["settings"], "settings"), self_contained(settings))
        # A file of directions may have other content than before.
        if not found and grid_count(settings.processing.directions) is None:
            grid = direction_grid(settings.processing)
            found = "" if _digest(grid.azimuth_rad.tobytes(), grid.elevation_rad.tobytes()) == held["axes"] else "grid"
        if found:
            return f"was made with other settings ({found} of sensor {name})"
        if mounting and name in mounting and held["mounting"] != [list(each) for each in mounting[name]]:
            return f"was made with another mounting of sensor {name}"
    return ""


def _changed(made: Settings, wanted: Settings) -> str:
    """Return the name of the first different setting; ignore settings that a plan has completed."""
    opened = made.replace(accuracy=_reopened(made.accuracy, wanted.accuracy))
    if wanted.processing.wavefront == "auto":
        opened = opened.replace(processing=opened.processing.replace(wavefront="auto"))
    for table in Settings.__struct_fields__:
        came, asked = getattr(opened, table), getattr(wanted, table)
        if came != asked:
            fields = [name for name in came.__struct_fields__ if getattr(came, name) != getattr(asked, name)]
            return f"{table}.{fields[0]}"
    return ""


def _reopened(made: Accuracy, wanted: Accuracy) -> Accuracy:
    asked = {name: getattr(wanted, name) for name in Accuracy.__struct_fields__}
    return made.replace(**{name: value for name, value in asked.items() if value in _AUTOMATIC})

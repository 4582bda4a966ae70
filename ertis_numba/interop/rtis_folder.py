"""Folders of RTIS Dev: one raw file per measurement, and the settings as JSON."""

import json
import math
import re
from pathlib import Path
from typing import Any

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.interop.raw_pdm import RawReader
from ertis_numba.interop.rtis_custom import CUSTOM_KEYS, with_custom_files
from ertis_numba.settings import Air, Array, Call, Processing, Recording, Settings, fit_ranges

__all__ = ["open_rtis_folder"]

_RECORDING: dict[str, float] = {
    "microphoneSamples": 163_840,
    "microphoneSampleFrequency": 4_500_000,
    "callSampleFrequency": 450_000,
    "callDuration": 2.5,  # Milliseconds.
    "callMinimumFrequency": 25_000,
    "callMaximumFrequency": 50_000,
    "callEmissions": 1,
}
"""Defaults of rtisdev 2.16.0 for settings that a file of recording settings omits."""
_PROCESSING = (
    "microphoneLayout",
    "minRange",
    "maxRange",
    "directions",
    "2D",
    "azimuthLowLimit",
    "azimuthHighLimit",
    "elevationLowLimit",
    "elevationHighLimit",
    "elevation2DAngle",
)
_KEYS_OF_DICT = {"dacSampleFrequency": "callSampleFrequency", "nDirections": "directions"}
"""Names in settings files, by the name in ``dict(RTISSettings)``, which users also write to JSON."""
_AZIMUTHS, _ELEVATIONS = "directionsAzimuth", "directionsElevation"  # Radians, in dict(RTISSettings).
_KNOWN = {*_RECORDING, *_PROCESSING, *_KEYS_OF_DICT, *CUSTOM_KEYS, "callCustom", _AZIMUTHS, _ELEVATIONS}


def open_rtis_folder(
    folder: str | Path,
    *,
    layout: str | None = None,
    preset: str | None = None,
    air: Air | None = None,
    sensor: str = "sensor",
) -> RawReader:
    """Open a folder of measurements saved by an RTIS Dev program.

    RTIS Dev returns the words of a measurement, and its examples write each to a file ``NAME<number>.bin``. The number
    becomes the sequence number, so that a missing file is a gap. Settings are read from JSON files beside them, as
    rtisdev 2.16.0 (PyPI) reads and returns them: recording settings (``microphoneSamples``, ``callMinimumFrequency``
    and others), processing settings (``microphoneLayout``, ``maxRange`` and others), or all of ``dict(RTISSettings)``
    in one. Filters, cleaning and beamforming are not used. Directions, delays and ranges in CSV files are used.

    Parameters
    ----------
    folder : str or Path
        Folder with ``.bin`` files, and settings in ``.json`` files.
    layout : str, optional
        Name of the array, instead of that in the folder.
    preset : str, optional
        Preset for call and length of a measurement, instead of those in the folder.
    air : Air, optional
        Air; standard air by default, because the folder contains no air data.
    sensor : str
        Name of the sensor.

    Returns
    -------
    RawReader
        Iterable of measurements with a length.

    Raises
    ------
    DataError
        There are no measurements, or their order is unknown. Settings are missing, contradict each other, or cannot be
        stored in a recording.
    ArgumentError
        The value of a setting is invalid.

    Examples
    --------
    >>> from pathlib import Path
    >>> import ertis_numba as ertis
    >>> Path("run").mkdir(exist_ok=True)
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     recording[0].data.tofile("run/raw1.bin")
    >>> reader = ertis.open_rtis_folder("run", layout=recording.settings.array.layout, preset="default_25_50")
    >>> [measurement.stamp.sequence for measurement in reader]
    [1]
    """
    folder = Path(folder)
    paths, first = _measurements(folder)
    reported = _settings_in(folder)
    layout = layout or reported.get("microphoneLayout")
    if layout is None:
        raise DataError(f"{folder} does not name its array (microphoneLayout); set it (layout)")
    if not isinstance(layout, str):
        raise ArgumentError(
            f"{folder}: microphoneLayout is {layout!r}; correct it to the name of an array, or set another (layout)"
        )
    if preset is not None:
        settings = Settings.from_preset(preset)
    elif reported.keys() & {*_RECORDING, "callCustom"}:
        settings = _recording_settings(folder, reported)
    else:
        raise DataError(f"{folder} contains no recording settings of RTIS Dev (.json); choose a preset (preset)")
    processing = _processing_settings(folder, reported, settings.processing)
    settings = settings.replace(array=Array(layout=layout), air=air or Air(), processing=processing)
    settings = with_custom_files(folder, reported, settings)
    return RawReader(paths, settings, sensor=sensor, first=first)


def _measurements(folder: Path) -> tuple[list[Path], list[int]]:
    """Return the raw files in their order, and their numbers."""
    try:
        paths = [path for path in folder.iterdir() if path.suffix == ".bin"]
    except OSError as error:
        raise DataError(f"{folder}: {error.strerror}; choose a folder of raw files") from error
    if not paths:
        raise DataError(
            f"{folder} is a folder; choose a file of raw words, or a folder with .wav files or .bin files of RTIS Dev"
        )
    split = [re.fullmatch(r"(.*?)(\d*)", path.stem) for path in paths]
    names = {match[1] for match in split if match}
    digits = [match[2] for match in split if match]
    if len(paths) == 1:
        return paths, [int(digits[0] or 0)]
    if len(names) != 1 or not all(digits) or len({int(number) for number in digits}) != len(paths):
        raise DataError(
            f"{folder}: the order of its {len(paths)} .bin files is unknown, because their names are not like "
            "NAME<number>.bin; list the files themselves in their order"
        )
    ordered = sorted(zip(map(int, digits), paths, strict=True))
    return [path for _, path in ordered], [number for number, _ in ordered]


def _settings_in(folder: Path) -> dict[str, Any]:
    """Return the settings in all JSON files of a folder, by their names in settings files."""
    reported: dict[str, Any] = {}
    sources: dict[str, Path] = {}
    for path in sorted(folder.glob("*.json")):
        try:
            content = json.loads(path.read_text("utf-8-sig"))
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: {error}; correct the JSON, or remove the file") from error
        for key in _KNOWN & content.keys() if isinstance(content, dict) else ():
            name = _KEYS_OF_DICT.get(key, key)
            if name in reported and reported[name] != content[key]:
                raise DataError(
                    f"{path}: {key} is {content[key]!r}, but {reported[name]!r} in {sources[name].name}; keep one of "
                    "them"
                )
            reported[name], sources[name] = content[key], path
    return reported


def _recording_settings(folder: Path, reported: dict[str, Any]) -> Settings:
    """Return call and length of a measurement."""
    if "callCustom" in reported:
        raise DataError(
            f"{folder}: callCustom is the file {reported['callCustom']!r}, which a recording cannot contain; "
            "choose a preset (preset) to process the call as a sweep"
        )
    number = {
        name: checks.finite(f"{folder}: {name}", reported.get(name, standard)) for name, standard in _RECORDING.items()
    }
    if number["callEmissions"] != 1:
        raise DataError(
            f"{folder}: callEmissions is {number['callEmissions']:g}, but an image shows only 1 emission; "
            "choose a preset (preset) to use the first emission"
        )
    call = Call(
        start_frequency_hz=number["callMaximumFrequency"],
        stop_frequency_hz=number["callMinimumFrequency"],
        duration_s=round(number["callDuration"] / 1e3, 12),
        sample_rate_hz=number["callSampleFrequency"],
    )
    n_samples = checks.integer(f"{folder}: microphoneSamples", reported.get("microphoneSamples", 163_840), 1)
    recording = Recording(sample_rate_hz=number["microphoneSampleFrequency"], n_samples=n_samples)
    return Settings(call=call, recording=recording, processing=fit_ranges(Processing(), recording, call))


def _processing_settings(folder: Path, reported: dict[str, Any], standard: Processing) -> Processing:
    """Return ranges and directions."""

    def number(name: str, otherwise: float) -> float:
        return checks.finite(f"{folder}: {name}", reported.get(name, otherwise))

    range_m = (number("minRange", standard.range_m[0]), number("maxRange", standard.range_m[1]))
    processing = standard.replace(range_m=range_m)
    if "directions" not in reported:
        return processing
    count = checks.integer(f"{folder}: directions", reported["directions"], 1)
    is_flat = reported.get("2D", True)
    if not isinstance(is_flat, bool):
        is_flat = bool(number("2D", 1))
    elevation_deg = checks.between(f"{folder}: elevation2DAngle", number("elevation2DAngle", 0.0), -90.0, 90.0)
    if _ELEVATIONS in reported:
        elevation_rad = _angles_rad(folder, reported, _ELEVATIONS)
        is_flat, elevation_deg = min(elevation_rad) == max(elevation_rad), math.degrees(elevation_rad[0])
    azimuth_rad = [-math.pi / 2, math.pi / 2]
    if is_flat and _AZIMUTHS in reported:
        azimuth_rad = _angles_rad(folder, reported, _AZIMUTHS)
    return processing.replace(
        directions=f"{2 if is_flat else 3}d:{count}",
        azimuth_limits_deg=(
            number("azimuthLowLimit", math.degrees(min(azimuth_rad))),
            number("azimuthHighLimit", math.degrees(max(azimuth_rad))),
        ),
        elevation_limits_deg=(number("elevationLowLimit", -90.0), number("elevationHighLimit", 90.0)),
        elevation_deg=elevation_deg if is_flat else 0.0,
    )


def _angles_rad(folder: Path, reported: dict[str, Any], name: str) -> list[float]:
    """Return the angles of all directions."""
    angles = reported[name]
    if not isinstance(angles, list) or not angles:
        raise ArgumentError(f"{folder}: {name} is {angles!r}; write an angle for each direction, or remove the key")
    return [checks.finite(f"{folder}: {name}", angle_rad) for angle_rad in angles]

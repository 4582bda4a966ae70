"""Measurements of a recording that become images: those that are not passive."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import overload

from ertis_numba.base.errors import DataError
from ertis_numba.base.file_kinds import quoted
from ertis_numba.campaign.attitudes import Attitudes
from ertis_numba.frames import Behaviour, Measurement, Stamp, is_passive
from ertis_numba.settings import Settings
from ertis_numba.storage import RecordingReader
from ertis_numba.storage.recording import Mounting

__all__ = ["EchoMeasurements", "count_images", "no_images", "passive_note", "require_images"]


class EchoMeasurements(Sequence[Measurement]):
    """Measurements of one sensor that become images of echoes by their own mode; ``settings`` are the recording's."""

    def __init__(self, recording: RecordingReader, settings: Settings) -> None:
        self.recording = recording
        self.path: Path = recording.path
        self.sensor, self.settings = recording.sensor, recording.settings
        stamps = recording.stamps()
        self._places = [place for place, stamp in enumerate(stamps) if not is_passive(settings, stamp)]
        self._n_silent = sum(stamps[place].behaviour == "passive" for place in self._places)

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> Measurement: ...
    @overload
    def __getitem__(self, index: slice) -> list[Measurement]: ...
    def __getitem__(self, index: int | slice) -> Measurement | list[Measurement]:
        if isinstance(index, slice):
            return [self.recording[place] for place in self._places[index]]
        return self.recording[self._places[index]]

    def __iter__(self) -> Iterator[Measurement]:
        return (self.recording[place] for place in self._places)

    def attitudes(self, mountings: Mapping[str, Mounting] | None = None) -> Attitudes:
        """Return the attitudes of the sensor at its measurements; ``mountings`` by sensor replace recorded ones."""
        stamps = self.recording.stamps()
        _, rotation_xyzw = (mountings or {}).get(self.sensor, (None, None))
        return Attitudes(self.recording, [stamps[place] for place in self._places], rotation_xyzw)

    @property
    def warning(self) -> str:
        """Warning of images of measurements without a call, which ``processing.mode`` requested; empty if none."""
        if not self._n_silent:
            return ""
        return (
            f"no call was emitted for {self._n_silent} of {len(self)} measurements, so their images show no echoes "
            "of a call; use 'ertis acoustic' for maps of their sound"
        )

    @property
    def note(self) -> str:
        """Line on the passive measurements that are left out; empty if there are none."""
        return passive_note(self.path, self.sensor, len(self), len(self.recording))


def count_images(settings: Settings, behaviours: Mapping[Behaviour, int]) -> int:
    """Return the number of measurements that become images, of their numbers by behaviour."""
    return sum(count for behaviour, count in behaviours.items() if not is_passive(settings, Stamp(behaviour=behaviour)))


def passive_note(path: Path, sensor: str, n_images: int, n_measurements: int) -> str:
    """Return a line on passive measurements, which have no image; empty if there are none."""
    if n_images == n_measurements:
        return ""
    count = f"{n_measurements - n_images} of {n_measurements}"
    return (
        f"{path}: {count} measurements of sensor {sensor} are passive and left out; use 'ertis acoustic' for maps of "
        "their sound"
    )


def no_images(path: Path) -> str:
    """Return a line on a recording of which no measurement becomes an image."""
    return (
        f"{path}: all measurements are passive and have no echoes; use 'ertis acoustic {quoted(path)}' for maps of "
        'their sound, or the setting processing.mode = "active" for images'
    )


def require_images(path: Path, n_images: int) -> None:
    """Refuse a recording of which no measurement becomes an image."""
    if not n_images:
        raise DataError(no_images(path))

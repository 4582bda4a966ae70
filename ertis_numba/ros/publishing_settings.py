"""Settings of a publisher that may change while it publishes, and their file."""

import math
from pathlib import Path
from typing import Any

from msgspec import field

from ertis_numba.base import checks
from ertis_numba.base.errors import SettingsError
from ertis_numba.interop.ros_messages import MESSAGES
from ertis_numba.settings.documents import TomlDocument

__all__ = ["PublishingSettings", "WatchedSettings"]

_MAX_DB = 1000.0


class PublishingSettings(TomlDocument, frozen=True, kw_only=True):
    """Limits of published points and echoes, rates, and the state of playback.

    Attributes
    ----------
    min_level_db : float, default -20
        Lowest level of points and of echoes in scans, relative to the strongest point of the image, -1000 to 0 dB.
    floor_dbfs : float, optional, default None
        Lowest level of echoes in scans in dBFS, -1000 to 1000.
    range_m : (first, last), optional, default None
        Ranges of points and of echoes in scans, in metres; all by default.
    max_rate_hz : table of float, default {}
        Largest rate of a topic of each sensor, by topic. Messages above it are left out.
    paused : bool, default False
        Publish nothing; a file waits, and ``/clock`` stands still.
    speed : float, default 1
        Speed of a file relative to the recording, 0.01 to 100.

    Examples
    --------
    >>> from ertis_numba.ros import PublishingSettings
    >>> PublishingSettings.from_toml("range_m = [0.5, 3]").range_m
    (0.5, 3.0)
    """

    min_level_db: float = -20.0
    floor_dbfs: float | None = None
    range_m: tuple[float, float] | None = None
    max_rate_hz: dict[str, float] = field(default_factory=dict)
    paused: bool = False
    speed: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("min_level_db", self.min_level_db, -_MAX_DB, 0.0)
        if self.floor_dbfs is not None:
            checks.between("floor_dbfs", self.floor_dbfs, -_MAX_DB, _MAX_DB)
        if self.range_m is not None:
            checks.interval("range_m", self.range_m, 0.0, math.inf)
        for topic, rate_hz in self.max_rate_hz.items():
            checks.choice("topic", topic, MESSAGES)
            checks.between("max_rate_hz", rate_hz, 1e-3, 1e4)
        checks.between("speed", self.speed, 0.01, 100.0)


class WatchedSettings:
    """Settings in a file, read again when it changes.

    Parameters
    ----------
    path : Path

    Raises
    ------
    SettingsError
        The file cannot be read or used.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._used = self._seen = self._look()
        self.settings = PublishingSettings.load(path)

    def changed(self) -> PublishingSettings | None:
        """Return new settings, or None if there are none.

        A change counts if two calls in a row find the same file, because editors write files in several steps.

        Raises
        ------
        SettingsError
            The file has changed, and cannot be read or used; the former settings stay. It is reported once.
        """
        state = self._look()
        is_stable, self._seen = state == self._seen, state
        if state == self._used or not is_stable:
            return None
        self._used = state
        if state is None:
            raise SettingsError(f"{self._path} is missing; its last settings stay in use until it is back")
        self.settings = PublishingSettings.load(self._path)
        return self.settings

    def _look(self) -> tuple[Any, ...] | None:
        try:
            state = self._path.stat()
        except OSError:
            return None
        return state.st_mtime_ns, state.st_size, state.st_ino

"""Plans that complete open settings once for all recordings with the same settings."""

import hashlib
from collections.abc import Mapping
from typing import Any, Literal

from ertis_numba.settings import Accuracy, Air, Settings

__all__ = ["Plans"]


class Plans:
    """Plans by the kind of result and the settings, and the plans in progress."""

    # Without them, workers with different measured costs could choose different plans.

    def __init__(self) -> None:
        self._found: dict[bytes, Accuracy | str] = {}
        self._compiled: set[bytes] = set()  # Settings without their air, whose kernels are compiled.
        self._in_progress: dict[bytes, bool] = {}  # True for settings with new kernels.

    def get(self, settings: Settings) -> Accuracy | str | None:
        """Return the plan for settings, or an error text, or None while it is not known."""
        return self._found.get(_key(settings))

    def begin(self, settings: Settings) -> Literal["new", "known"] | None:
        """Register settings as being planned; return ``new`` or ``known`` for their kernels, None if they have to wait.

        New kernels are planned one at a time: processes that compile the same ones could corrupt the cache.
        """
        key, new = _key(settings), _kernels_key(settings) not in self._compiled
        if key in self._in_progress or (new and any(self._in_progress.values())):
            return None
        self._in_progress[key] = new
        return "new" if new else "known"

    def finish(self, settings: Settings, reported: Mapping[str, Any]) -> None:
        """Store the result; after a temporary error, the next request plans again."""
        key = _key(settings)
        self._in_progress.pop(key)
        if "by_chance" in reported:
            return
        if "error" in reported:
            self._found[key] = str(reported["error"])
        else:
            self._found[key] = Settings.from_toml(reported["settings"], "settings").accuracy
            self._compiled.add(_kernels_key(settings))


def _key(settings: Settings) -> bytes:
    return hashlib.sha256(settings.to_toml().encode()).digest()


def _kernels_key(settings: Settings) -> bytes:
    return _key(settings.replace(air=Air()))

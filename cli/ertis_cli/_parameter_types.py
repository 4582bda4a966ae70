"""Types of option values: intervals, directions, channels, error budgets and paths."""

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from ertis_numba.base.constants import MAX_MICROPHONES
from ertis_numba.settings.beamformers import BEAMFORMERS
from ertis_numba.settings.limits import CLEANING_DB, Limits

__all__ = [
    "BEAMFORMER",
    "CHANNELS",
    "CLEANING",
    "DIRECTION",
    "ELEVATION",
    "ERROR_BUDGET",
    "FILE",
    "FOLDER",
    "INTERVAL",
    "NAMES",
    "TEXT_PATH",
    "WORKERS",
    "ranged",
]

_MAX_DEG = 90.0  # limit of azimuth and elevation in front of an array


def ranged(limits: Limits) -> Any:
    """Return the type of an option whose value has the limits of a field."""
    high: Any = None if math.isinf(limits.high) else limits.high
    return click.IntRange(limits.low, high) if isinstance(limits.low, int) else click.FloatRange(limits.low, high)


class _Assignments(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    """Numbers as ``KEY=X,...``, by the names of their fields."""

    def numbers(self, text: str, known: Mapping[str, tuple[str, Limits]], usage: str) -> dict[str, float]:
        """Return the numbers of a text; ``known`` has the name and the limits of each, ``usage`` completes errors."""
        found: dict[str, float] = {}
        for each in text.split(","):
            key, _, number = each.partition("=")
            if key not in known:
                self.fail(f"{each!r} is not an option of {usage}")
            name, limits = known[key]
            if name in found:
                self.fail(f"{key} appears twice; state it once")
            try:
                found[name] = ranged(limits).convert(number, None, None)
            except click.BadParameter as error:
                self.fail(f"{each!r}: {error.message}")
            if not math.isfinite(found[name]):
                self.fail(f"{each!r}: use a finite number")
        return found


class _Beamformer(_Assignments):
    """Beamformer with its options, as fields of `Processing`."""

    name = "NAME[:OPTION=X,...]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> dict[str, Any]:
        name, colon, text = str(value).partition(":")
        declared = {str(known): each.options for known, each in BEAMFORMERS.items()}
        if name not in declared:
            self.fail(f"{name!r} is not a beamformer; choose one of {', '.join(declared)}", param, ctx)
        known = {option.name.removeprefix(f"{name}_"): (option.name, option.limits) for option in declared[name]}
        usage = f"use {name}:{', '.join(f'{other}=X' for other in known)}" if known else f"use {name} alone"
        return {"beamformer": name, **(self.numbers(text, known, f"{name}; {usage}") if colon else {})}


class _Cleaning(_Assignments):
    """Levels of range-wise cleaning, as fields of `Processing`."""

    name = "within=DB,above_mean=DB"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> dict[str, float]:  # noqa: ARG002
        known = {key: (f"clean_{key}_db", CLEANING_DB) for key in ("within", "above_mean")}
        return self.numbers(str(value), known, f"--clean; use {self.name}, or one of them")


class _Workers(click.ParamType):  # type: ignore[type-arg]  # as above
    """Number of processes, or the address of a dask scheduler."""

    name = "N|tcp://HOST:PORT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        if "://" in str(value):
            return str(value)
        with suppress(ValueError):
            if int(value) > 0:
                return int(value)
        return self.fail(
            f"{value!r} is not a number of workers; use a number of at least 1, or the address of a dask scheduler, "
            "as in tcp://127.0.0.1:8786",
            param,
            ctx,
        )


class _Interval(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "A:B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        first, colon, last = str(value).partition(":")
        if colon:
            with suppress(ValueError):
                return float(first), float(last)
        return self.fail(f"{value!r} is not an interval; use two numbers, as in 0.5:5", param, ctx)


class _Elevation(_Interval):
    name = "A:B|E"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        with suppress(ValueError):
            return float(value)
        return super().convert(value, param, ctx)


class _Channels(click.ParamType):  # type: ignore[type-arg]  # as above
    """Channels of a sensor, or of all sensors if there is no name."""

    name = "[NAME:]N,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, tuple[int, ...]]:
        from ertis_numba.base.checks import sensor_name

        name, _, numbers = str(value).rpartition(":")
        with suppress(ValueError):  # also of names that no sensor can have
            channels = tuple(int(channel) for channel in numbers.split(","))
            if all(0 <= channel < MAX_MICROPHONES for channel in channels):
                return (sensor_name(name) if ":" in str(value) else ""), channels
        wanted = f"integers from 0 to {MAX_MICROPHONES - 1}, as in 5,12, or those of one sensor, as in left:5,12"
        return self.fail(f"{value!r} is not a list of channels; use {wanted}", param, ctx)


class _Names(click.ParamType):  # type: ignore[type-arg]  # as above
    name = "NAME,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        names = tuple(str(value).split(","))
        if all(names):
            return names
        return self.fail(f"{value!r} is not a list of names; write them as in front,left", param, ctx)


class _Direction(click.ParamType):  # type: ignore[type-arg]  # as above
    name = "AZ:EL"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        azimuth, colon, elevation = str(value).replace(",", ":").partition(":")
        if colon:
            with suppress(ValueError):
                angles_deg = float(azimuth), float(elevation)
                if all(-_MAX_DEG <= angle_deg <= _MAX_DEG for angle_deg in angles_deg):
                    return angles_deg
        wanted = f"azimuth and elevation, each from -{_MAX_DEG:g} to {_MAX_DEG:g}, as in 30:0"
        return self.fail(f"{value!r} is not a direction; use {wanted}", param, ctx)


class _ErrorBudget(click.ParamType):  # type: ignore[type-arg]  # as above
    name = "DB"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        from ertis_numba.settings import ERROR_PRESETS_DB

        if value in ERROR_PRESETS_DB:
            return ERROR_PRESETS_DB[value]
        with suppress(ValueError):
            return float(value)
        return self.fail(
            f"{value!r} is not an error budget; use dB, as in -40, or {', '.join(ERROR_PRESETS_DB)}", param, ctx
        )


class _File(click.Path):
    noun = "file"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return (
            super().convert(value, param, ctx)
            if str(value)
            else self.fail(f"the path is empty; name a {self.noun}", param, ctx)
        )


class _Folder(_File):
    noun = "folder"


BEAMFORMER = _Beamformer()
CHANNELS = _Channels()
CLEANING = _Cleaning()
DIRECTION = _Direction()
ELEVATION = _Elevation()
ERROR_BUDGET = _ErrorBudget()
FILE = _File(path_type=Path)
FOLDER = _Folder(path_type=Path)
INTERVAL = _Interval()
NAMES = _Names()
TEXT_PATH = _File()
WORKERS = _Workers()

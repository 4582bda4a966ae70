"""Shipped presets of RTIS, which are parts of a settings file."""

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any, Literal

import msgspec
import tomli_w

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["PRESETS", "PresetKind", "preset_tables", "preset_text", "presets"]

PresetKind = Literal["recording", "processing"]

_INSTEAD = {
    "recording": "use it with Settings.from_preset or 'ertis capture --preset {0}'",
    "processing": "use it with Processing.from_preset or 'ertis process --preset {0}'",
}


@cache
def _shipped() -> dict[str, dict[str, Any]]:
    """Return the tables of each preset."""
    text = resources.files("ertis_numba.settings").joinpath("presets.toml").read_text("utf-8")
    held: dict[str, dict[str, Any]] = msgspec.toml.decode(text)
    return held


def _kind(tables: Mapping[str, Any]) -> PresetKind:
    return "processing" if "processing" in tables else "recording"


def presets(kind: PresetKind | None = None) -> tuple[str, ...]:
    """Return the names of the shipped presets.

    Parameters
    ----------
    kind : {"recording", "processing"}, optional
        ``recording`` presets have the length of the record and the call, for `Settings.from_preset`. ``processing``
        presets have directions and ranges, for `Processing.from_preset`. All presets by default.

    Raises
    ------
    ArgumentError
        The kind is unknown.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> ertis.presets("processing")[:3]
    ('2d_91_5m', '2d_181_5m', '3d_500_5m')
    """
    if kind is not None:
        checks.choice("kind", kind, tuple(_INSTEAD))
    return tuple(name for name, tables in _shipped().items() if kind in {None, _kind(tables)})


def preset_tables(name: str, kind: PresetKind | None = None) -> dict[str, dict[str, Any]]:
    """Return the tables of a preset, by its name or that of RTIS Dev, such as ``2D_5m_181``; of one kind, or of any."""
    of_rtisdev = {tables["rtisdev"]: own for own, tables in _shipped().items() if "rtisdev" in tables}
    own = of_rtisdev.get(name, name)
    if own not in _shipped():
        if str(own).lower().endswith(".toml"):
            raise ArgumentError(f"preset {own!r} is the name of a file; load it as settings (settings)")
        checks.choice("preset", own, presets(kind))
    tables = _shipped()[own]
    if kind not in {None, _kind(tables)}:
        raise ArgumentError(f"preset is {name!r}, a {_kind(tables)} preset; {_INSTEAD[_kind(tables)].format(own)}")
    return {section: dict(keys) for section, keys in tables.items() if section != "rtisdev"}


def preset_text(name: str) -> str:
    """Return a preset, by its name or that of RTIS Dev, as the text of a settings file."""
    return tomli_w.dumps(preset_tables(name))


PRESETS = presets("recording")
"""Names of the RTIS recording presets: length of the record, and band of the call in kHz."""

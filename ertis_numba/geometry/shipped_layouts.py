"""Layouts that the package contains, as TOML text by name."""

import functools
from importlib import resources
from typing import Final

from ertis_numba.base import checks

__all__ = ["layout_names", "layout_text"]

_FOLDER: Final = resources.files("ertis_numba.geometry").joinpath("shipped")


@functools.cache
def layout_names() -> tuple[str, ...]:
    """Return the names of the shipped layouts in alphabetical order.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> ertis.layout_names()[:3]
    ('eRTIS_v2', 'eRTIS_v2REC', 'eRTIS_v3D1')
    """
    names = (item.name for item in _FOLDER.iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml")))


def layout_text(name: str) -> str:
    """Return the TOML text of a shipped layout, one of `layout_names`."""
    checks.choice("layout", name, layout_names())
    return _FOLDER.joinpath(f"{name}.toml").read_text("utf-8")

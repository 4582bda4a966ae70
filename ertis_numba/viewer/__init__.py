"""Live view in the browser; the only package that imports viser.

A source provides images or acoustic maps: `Live` those of a central node, `Playback` those of a file. `ViewedScene` and
`ViewedMaps` compute the drawn objects from them, without a browser. `Viewer` shows these on the page and applies the
choices made there. `view` shows the page in a notebook.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ertis_numba.base.extras import extra
from ertis_numba.viewer._acoustic_maps import ViewedMaps
from ertis_numba.viewer._choices import COLOURS, Choices
from ertis_numba.viewer._polar import Polar
from ertis_numba.viewer._scene import ViewedScene
from ertis_numba.viewer._shapes import BandLevel, Dome, Drawn, DrawnFrame, LevelScale, Pose, ReceivedImage, Sector

if TYPE_CHECKING:
    from ertis_numba.viewer._inline import InlineView, view
    from ertis_numba.viewer._live import Live
    from ertis_numba.viewer._playback import Playback
    from ertis_numba.viewer._view import Viewer

__all__ = [
    "COLOURS",
    "BandLevel",
    "Choices",
    "Dome",
    "Drawn",
    "DrawnFrame",
    "InlineView",
    "LevelScale",
    "Live",
    "Playback",
    "Polar",
    "Pose",
    "ReceivedImage",
    "Sector",
    "ViewedMaps",
    "ViewedScene",
    "Viewer",
    "view",
]

_HOMES = {"InlineView": "_inline", "view": "_inline", "Live": "_live", "Playback": "_playback", "Viewer": "_view"}


def __getattr__(name: str) -> Any:
    """Import modules that load HDF5, ZeroMQ or viser on first access (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with extra("view", "the live view needs viser and websockets"):
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)

"""Live view in the browser. The only door to viser.

A source has images: `Live` those that a central node publishes, `Playback` those of a file. `ViewedScene` makes of them what is
to be drawn, without a browser. `Viewer` hands that to the page and does what is chosen there.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ertis_numba.extras import extra
from ertis_numba.viewer._choices import COLOURS, Choices
from ertis_numba.viewer._polar import Polar
from ertis_numba.viewer._scene import ViewedScene
from ertis_numba.viewer._shapes import Dome, Drawn, DrawnFrame, Pose, ReceivedImage, Sector

if TYPE_CHECKING:
    from ertis_numba.viewer._live import Live
    from ertis_numba.viewer._playback import Playback
    from ertis_numba.viewer._view import Viewer

__all__ = [
    "COLOURS",
    "Choices",
    "Dome",
    "Drawn",
    "DrawnFrame",
    "Live",
    "Playback",
    "Polar",
    "Pose",
    "ReceivedImage",
    "Sector",
    "ViewedScene",
    "Viewer",
]

_HOMES = {"Film": "_film", "Live": "_live", "View": "_view"}


def __getattr__(name: str) -> Any:
    """Load what brings HDF5, ZeroMQ or viser when it is asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with extra("view", "the live view needs viser and websockets"):
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)

"""Live view in the browser. The only door to viser.

A source has images: `Live` those that a central node publishes, `Film` those of a file. `Scene` makes of them what is
to be drawn, without a browser. `View` hands that to the page and does what is chosen there.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ertis_numba.extras import extra
from ertis_numba.viewer._choices import COLOURS, Choices
from ertis_numba.viewer._polar import Polar
from ertis_numba.viewer._scene import Scene
from ertis_numba.viewer._shapes import Dome, Drawn, Frame, Pose, Sector, Taken

if TYPE_CHECKING:
    from ertis_numba.viewer._film import Film
    from ertis_numba.viewer._live import Live
    from ertis_numba.viewer._view import View

__all__ = [
    "COLOURS",
    "Choices",
    "Dome",
    "Drawn",
    "Film",
    "Frame",
    "Live",
    "Polar",
    "Pose",
    "Scene",
    "Sector",
    "Taken",
    "View",
]

_HOMES = {"Film": "_film", "Live": "_live", "View": "_view"}


def __getattr__(name: str) -> Any:
    """Load what brings HDF5, ZeroMQ or viser when it is asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with extra("view", "the live view needs viser and websockets"):
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)

"""Scenes with known truth, rendered to the words of their sensors.

`render` and `Simulator` are reached as ``ertis_numba.simulation.render``; they bring the compiled kernels in,
which the description of a scene does not need.
"""

from ertis_numba.simulation.scene import Scene, load_scene
from ertis_numba.simulation.sensors import Electronics, Emitter, Sensor
from ertis_numba.simulation.sources import Ambient, Noise, Sonar, Tone
from ertis_numba.simulation.targets import Box, Point, Sphere, Wall

__all__ = [
    "Ambient",
    "Box",
    "Electronics",
    "Emitter",
    "Noise",
    "Point",
    "Scene",
    "Sensor",
    "Sonar",
    "Sphere",
    "Tone",
    "Wall",
    "load_scene",
]

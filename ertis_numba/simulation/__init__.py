"""Scenes with known ground truth, and their rendering to raw samples.

Import `render` and `Simulator` from ``ertis_numba.simulation.render``, which loads the compiled kernels.
"""

from ertis_numba.simulation.platform import Platform
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
    "Platform",
    "Point",
    "Scene",
    "Sensor",
    "Sonar",
    "Sphere",
    "Tone",
    "Wall",
    "load_scene",
]

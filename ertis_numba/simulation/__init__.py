"""Scenes with known truth, rendered to the PDM words of a sensor.

`render` is reached as ``ertis_numba.simulation.render.render``; it brings the compiled kernels in,
which the description of a scene does not need.
"""

from ertis_numba.simulation.arrivals import Arrivals, arrivals, true_peaks
from ertis_numba.simulation.scene import DirectSound, Electronics, Point, Scene, load_scene

__all__ = ["Arrivals", "DirectSound", "Electronics", "Point", "Scene", "arrivals", "load_scene", "true_peaks"]

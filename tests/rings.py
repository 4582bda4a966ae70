"""A ring of PCM microphones, and its simulated measurement of two points."""

import numpy as np

from ertis_numba.settings import Array, Processing, Recording, Settings
from ertis_numba.simulation import Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator

__all__ = ["PCM", "POINTS", "RATE_HZ", "RING", "heard", "scene_of", "sensor_of"]

RING = Array(
    layout="ring", positions_m=tuple((0.0, 0.02 * np.cos(a), 0.02 * np.sin(a)) for a in np.arange(8) * np.pi / 4)
)
RATE_HZ = 192_000
PCM = Settings(
    array=RING,
    recording=Recording(sample_rate_hz=RATE_HZ, n_samples=3_000, encoding="int16"),
    processing=Processing(directions="2d:61", range_m=(0.4, 2.0), range_decimation=4),
)
POINTS = (
    Point(azimuth_deg=24.0, elevation_deg=0.0, range_m=0.9),
    Point(azimuth_deg=-30.0, elevation_deg=0.0, range_m=1.6),
)


def sensor_of(settings, **more):
    """A sensor of a scene with the given settings."""
    fields = {name: getattr(settings, name) for name in settings.__struct_fields__}
    return Sensor(**fields, **more)


def scene_of(settings, **more):
    return Scene(seed=4, sensors=(sensor_of(settings, **more),), points=POINTS)


def heard(settings, **more):
    return Simulator(scene_of(settings, **more)).render()

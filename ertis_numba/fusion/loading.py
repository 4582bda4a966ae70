"""Loading of all kernels of fusion before they are needed."""

import numpy as np

from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.fusion.fuser import Fuser
from ertis_numba.settings import Processing, Settings

__all__ = ["load_kernels"]

_AHEAD = (0.0, 0.0, 0.0, 1.0)


def load_kernels() -> None:
    """Fuse two small images, so that a later fusion and its points need not load or compile kernels."""
    settings = Settings(processing=Processing(directions="2d:9", range_m=(0.5, 1.0)))
    azimuth_rad, range_m = np.radians(np.linspace(-80.0, 80.0, 9)), np.arange(0.5, 1.0, 0.01)
    amplitude = np.full((9, len(range_m)), 1e-4, dtype=np.float32)
    amplitude[4, 20:23] = 1.0, 2.0, 1.0
    images = [
        Energyscape(amplitude, azimuth_rad, np.zeros(9), range_m, settings, Stamp(sensor=name))
        for name in ("left", "right")
    ]
    fuser = Fuser({"left": ((0.0, 0.1, 0.0), _AHEAD), "right": ((0.0, -0.1, 0.0), _AHEAD)}, spacing_deg=10.0)
    assert len(fuser(images).points) >= 0  # noqa: S101  points are computed when they are used

"""What a simulated recording should show."""

from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.storage.schema import TRUTH, describe, lay_out

__all__ = ["Truth", "read_truth", "write_truth"]

_ARRAYS = {"azimuth": "azimuth_rad", "elevation": "elevation_rad", "range": "range_m", "level": "level_db"}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Truth:
    """What a simulated recording should show.

    Attributes
    ----------
    scene : str
        The scene as TOML.
    seed : int
    azimuth_rad, elevation_rad, range_m, level_db : (measurement, target) float64
        The reflectors as the sensor sees them; levels below the strongest. NaN where a measurement
        has fewer reflectors than others.
    """

    scene: str
    seed: int
    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    range_m: NDArray[np.float64]
    level_db: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.azimuth_rad.ndim != 2:
            raise ArgumentError(f"azimuth_rad has shape {self.azimuth_rad.shape}; give (measurement, target)")
        for name in _ARRAYS.values():
            checks.shape(name, getattr(self, name).shape, self.azimuth_rad.shape)


def write_truth(file: h5py.File, truth: Truth) -> None:
    """Write what the recording should show."""
    n_measurements, n_targets = truth.azimuth_rad.shape
    group = file.create_group("truth", track_order=True)
    sizes = {"measurement": n_measurements, "target": n_targets}
    lay_out(group, TRUTH, sizes=sizes, texts={"scene": truth.scene})
    describe(group, {"seed": truth.seed})
    for name, field in _ARRAYS.items():
        group[name][:] = getattr(truth, field)


def read_truth(file: h5py.File) -> Truth | None:
    """Return what the recording should show, where it is known."""
    if "truth" not in file:
        return None
    group = file["truth"]
    arrays = {field: np.asarray(group[name][:]) for name, field in _ARRAYS.items()}
    return Truth(scene=group["scene"][()].decode(), seed=int(group.attrs["seed"]), **arrays)

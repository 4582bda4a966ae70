"""Directions and paths of the echoes of all sensors, compared with predicted ones."""

from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels

__all__ = ["NEAREST_M", "EchoPaths"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

NEAREST_M: Final = kernels.NEAREST_M
_FEW: Final = 1024  # Matches that there is space for at first.


class EchoPaths(NamedTuple):
    """Echoes of all receivers, with their ``rows`` by receiver with an image, and the positions and axes of sensors.

    ``flat`` receivers do not distinguish front and back. ``path_m`` (echo, emitter) is that of an echo if the emitter's
    call caused it; NaN for emitters that the receiver does not hear.
    """

    sensor_m: Floats
    ahead: Floats
    rows: Mapping[int, Numbers]
    flat: Collection[int]
    direction: Floats
    path_m: Floats
    power: Floats

    @property
    def is_flat(self) -> NDArray[np.bool_]:
        """True for receivers that do not distinguish front and back: (sensor,) bool."""
        return np.array([number in self.flat for number in range(len(self.sensor_m))], np.bool_)

    @property
    def receiver(self) -> Numbers:
        """Receiver of each echo: (echo,) int64."""
        found = np.zeros(len(self.path_m), np.int64)
        for number, rows in self.rows.items():
            found[rows] = number
        return found

    def arriving(self, origin_m: Floats, sent_m: Floats, within_m: float, within_rad: float) -> Numbers:
        """Return source, emitter and number of the echoes that fit sound from predicted places: (3, match)."""
        echoes = self.is_flat, self.receiver, self.direction, self.path_m
        find_arrivals, count = kernels.load_fusion().find_arrivals, _FEW
        while True:
            found = np.empty((3, count), np.int64)
            n_found = find_arrivals(origin_m, sent_m, self.sensor_m, self.ahead, *echoes, within_m, within_rad, found)
            if n_found <= count:
                return found[:, :n_found]
            count = n_found

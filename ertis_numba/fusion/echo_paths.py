"""Directions and paths of the echoes of all sensors, compared with predicted ones."""

from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["NEAREST_M", "EchoPaths"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

NEAREST_M: Final = 1e-9
_LEAST_COSINE: Final = 0.25  # Directions are less certain beside a flat array, by up to this factor.


class EchoPaths(NamedTuple):
    """Echoes of all receivers, and the geometry of their sensors.

    Attributes
    ----------
    sensor_m, ahead : (sensor, axis) float64
        Positions and axes of the sensors.
    rows : mapping of int to (echo,) int64
        Echoes of each receiver that has an image.
    flat : collection of int
        Receivers that do not distinguish front and back.
    direction : (echo, axis) float64
    path_m : (echo, emitter) float64
        Path of each echo if the emitter's call caused it; NaN for emitters that the receiver does not hear.
    power : (echo,) float64
    """

    sensor_m: Floats
    ahead: Floats
    rows: Mapping[int, Numbers]
    flat: Collection[int]
    direction: Floats
    path_m: Floats
    power: Floats

    def arriving(
        self, receiver: int, origin_m: Floats, sent_m: Floats, within_m: float, within_rad: float
    ) -> tuple[Numbers, Numbers, Numbers]:
        """Return source, emitter and number of the echoes of a receiver that fit sound from predicted places.

        Parameters
        ----------
        receiver : int
        origin_m : (source, emitter, axis) float64
            Place from which the call of each emitter arrives.
        sent_m : (source, emitter) float64
            Path of the call to this place.
        within_m, within_rad : float
            Largest differences of paths, and of directions ahead of the receiver.
        """
        rows = self.rows[receiver]
        to_m = origin_m - self.sensor_m[receiver]
        apart_m = np.maximum(np.linalg.norm(to_m, axis=2), NEAREST_M)
        late_m = self.path_m[rows].T - (apart_m + sent_m)[..., None]
        source, emitter, echo = np.nonzero(np.abs(late_m) < within_m)  # False for NaN.
        toward = to_m[source, emitter] / apart_m[source, emitter, None]
        depth = toward @ self.ahead[receiver]
        seen = toward - 2 * np.minimum(depth, 0.0)[:, None] * self.ahead[receiver]  # See `SeenPlaces.seen`.
        turn = np.linalg.norm(seen - self.direction[rows[echo]], axis=1)  # For small angles, the chord is the angle.
        is_near = turn < within_rad / np.maximum(np.abs(depth), _LEAST_COSINE)
        if receiver not in self.flat:
            is_near &= depth > 0
        return source[is_near], emitter[is_near], rows[echo[is_near]]

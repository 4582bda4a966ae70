"""Places as the sensors of a platform see them: distances, directions, and power of their echoes."""

from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.pairs import AUDIBLE
from ertis_numba.fusion.rig import Emitters, MountedSensor

__all__ = ["SeenPlaces", "Viewers", "mirrored"]

Floats = NDArray[np.float64]

_NEAREST_M: Final = 0.05
_TINY: Final = 1e-30
_BESIDE_DB: Final = (-13.0, -16.0)  # Power of a call to the side from which its path is uncertain, and most uncertain.
_BESIDE_M: Final = 6e-3


class SeenPlaces(NamedTuple):
    """Places seen from all sensors.

    Attributes
    ----------
    apart_m : (place, sensor) float64
        Distances.
    toward : (place, sensor, axis) float64
        Unit vectors to the places.
    depth : (place, sensor) float64
        Cosines of the angles to the axes of the sensors.
    seen : (place, sensor, axis) float64
        Directions in which the echoes appear: a flat array shows those from behind in front.
    radiated : (place, emitter) float64
        Power of each call towards the places, relative to ahead.
    gain : (place, receiver, emitter) float64
        Power of echoes relative to 1 m ahead, 0 where they are inaudible.
    """

    apart_m: Floats
    toward: Floats
    depth: Floats
    seen: Floats
    radiated: Floats
    gain: Floats

    def only(self, number: int) -> "SeenPlaces":
        """Return one of the places."""
        return SeenPlaces._make(each[number : number + 1] for each in self)

    @property
    def beside_m(self) -> Floats:
        """Errors of paths from emitters beside their beams: (place, emitter) float64.

        There, what a piston radiates depends on the frequency, and echoes come early or late.
        """
        power_db = 10 * np.log10(np.maximum(self.radiated, _TINY))
        high_db, low_db = _BESIDE_DB
        return np.asarray(_BESIDE_M * np.clip((power_db - high_db) / (low_db - high_db), 0.0, 1.0))


class Viewers:
    """Sensors of a platform that see places.

    Parameters
    ----------
    sensors : sequence of MountedSensor
    emitters : mapping of int to Emitters
        Model of the emitters in the air of each receiver.
    flat : collection of int
        Receivers that do not distinguish front and back.

    Attributes
    ----------
    sensor_m, ahead : (sensor, axis) float64
        Positions and axes.
    is_flat : (sensor,) bool
    """

    def __init__(
        self, sensors: Sequence[MountedSensor], emitters: Mapping[int, Emitters], flat: Collection[int]
    ) -> None:
        self.sensor_m = np.array([each.translation_m for each in sensors])
        self.ahead = np.array([each.rotation[:, 0] for each in sensors])
        self.is_flat = np.isin(np.arange(len(sensors)), [*flat])
        self._models = [
            (model, [number for number, each in emitters.items() if each is model]) for model in {*emitters.values()}
        ]

    def sight(self, place_m: Floats) -> SeenPlaces:
        """Return how the sensors see places: (place, axis) float64."""
        away_m = place_m[:, None] - self.sensor_m
        apart_m = np.maximum(np.sqrt(np.einsum("psi,psi->ps", away_m, away_m)), _NEAREST_M)
        toward = away_m / apart_m[..., None]
        depth = np.einsum("psi,si->ps", toward, self.ahead)
        seen = toward - 2 * np.where(self.is_flat, np.minimum(depth, 0.0), 0.0)[..., None] * self.ahead
        powers = [model.powers(depth) for model, _ in self._models]
        gain = np.zeros((*apart_m.shape, apart_m.shape[1]))
        for radiated, (model, receivers) in zip(powers, self._models, strict=True):
            spreading = model.spreading(apart_m[:, None], apart_m[:, receivers, None])
            gain[:, receivers] = np.where(radiated > AUDIBLE, radiated, 0)[:, None] * spreading
        return SeenPlaces(apart_m, toward, depth, seen, powers[0], gain)

    def echo_powers(self, sight: SeenPlaces, receiver: NDArray[np.int64]) -> Floats:
        """Return the power of echoes of one place after the matched filter: (echo, emitter), by receiver (echo,)."""
        model = next(model for model, numbers in self._models if receiver[0] in numbers)
        return model.echo_powers(sight.depth[0], sight.apart_m[0], sight.apart_m[0, receiver])


def mirrored(direction: Floats, ahead: Floats) -> Floats:
    """Return directions mirrored at the planes of flat arrays: (..., axis) float64."""
    return np.asarray(direction - 2 * np.einsum("...i,...i->...", direction, ahead)[..., None] * ahead)

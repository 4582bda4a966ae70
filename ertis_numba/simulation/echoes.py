"""Echoes of a scene as its image contains them."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.paths import Paths

__all__ = ["Echoes", "Ways"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Echoes:
    """Echoes in an image, one per path.

    ``gain`` (path, frequency); ``delay_s`` (path,) at the centre of the array; ``direction`` (path, axis) towards the
    source, in the sensor frame; ``coverage`` (path,): gain of the best beam, at most 1; ``power`` (frequency,):
    fraction of the matched call's power.
    """

    names: tuple[str, ...]
    gain: NDArray[np.inexact[Any]]
    delay_s: Floats
    direction: Floats
    coverage: Floats
    power: Floats

    def __len__(self) -> int:
        return len(self.names)

    @functools.cached_property
    def level(self) -> Floats:
        """The amplitude of each echo in the image: (path,) float64."""
        return np.asarray(np.abs(self.gain @ self.power) * self.coverage)

    @classmethod
    def joined(cls, parts: Sequence[Self], power: Floats) -> Self:
        """Return the echoes of all parts."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            names=tuple(name for part in parts for name in part.names),
            gain=np.concatenate([np.zeros((0, len(power))), *(part.gain for part in parts)]),
            delay_s=np.concatenate([np.zeros(0), *(part.delay_s for part in parts)]),
            direction=np.concatenate([np.zeros((0, 3)), *(part.direction for part in parts)]),
            coverage=np.concatenate([np.zeros(0), *(part.coverage for part in parts)]),
            power=power,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Ways:
    """Paths of one emitter's call to the centre of the array; all but ``paths`` are (path, …) as in `Echoes`."""

    paths: list[Paths]
    names: tuple[str, ...]
    delay_s: Floats
    direction: Floats
    coverage: Floats

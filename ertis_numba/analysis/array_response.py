"""Response of delay-and-sum in one direction to a source in another."""

import functools
import math
from collections.abc import Callable
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.point_spread import PointSpread, spread_of
from ertis_numba.geometry import array_weights, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["ArrayAxes", "CallResponse", "Response", "ToneResponse"]

Floats = NDArray[np.float64]

_FAR: Final = 2.0  # Standard deviation of phases in radians beyond which a maximum is a side lobe.
_N_SOURCES: Final = 48
_N_TARGETS: Final = 3072
_LINE: Final = 1e-3  # Largest width of a line of microphones relative to its length.


class Response(Protocol):
    """Response of an array to a kind of sound."""

    axes: "ArrayAxes"
    """Axes of the array, with the weights of its microphones."""

    def __call__(self, sources: Floats, directions: Floats) -> Floats:
        """Return amplitudes (n,) relative to that of a source in the direction, for unit vectors (n, axis)."""

    def side_lobe(self, places: Floats) -> float:
        """Return the highest side lobe in some places of sources in others, 0 to 1; 0 if it does not matter."""


class ArrayAxes:
    """Axes of an array with weights (mic,), its extent along each, and the unit vector ``longest``."""

    def __init__(self, settings: Settings, weights: Floats) -> None:
        places_m, shares = microphones(settings.array).enabled_positions_m, weights / weights.sum()
        places_m = places_m - shares @ places_m
        variance_m2, axes = np.linalg.eigh((places_m * shares[:, None]).T @ places_m)
        self._sizes_m, self._axes = np.sqrt(np.maximum(variance_m2, 0)), axes
        self.longest = np.asarray(axes[:, -1])

    def scaled_m(self, directions: Floats) -> Floats:
        """Return points whose distance is the standard deviation of differences of paths: (n, axis) float64."""
        return np.asarray((directions @ self._axes) * self._sizes_m)

    def apart_rad(self, first: Floats, second: Floats) -> Floats:
        """Return angles (n,) between unit vectors (n, axis), or between their cones around a line of microphones."""
        if self._sizes_m[1] < _LINE * self._sizes_m[2]:
            one, other = (np.arcsin(np.clip(each @ self.longest, -1.0, 1.0)) for each in (first, second))
            return np.asarray(np.abs(one - other))
        return np.asarray(2 * np.arcsin(np.minimum(np.linalg.norm(first - second, axis=1) / 2, 1.0)))

    @property
    def longest_m(self) -> float:
        """Standard deviation of positions along the longest axis in metres."""
        return float(self._sizes_m[-1])


class ToneResponse:
    """Response to a tone; ``delays`` returns those of unit vectors (n, axis) in seconds, (n, mic)."""

    def __init__(self, settings: Settings, frequency_hz: float, delays: Callable[[Floats], Floats]) -> None:
        n_mics = len(microphones(settings.array).enabled_positions_m)
        self.axes, self._delays = ArrayAxes(settings, np.ones(n_mics)), delays
        self._omega_rad_s = 2 * math.pi * frequency_hz
        self._wave_1_m = self._omega_rad_s / sound_speed_m_s(settings.air)

    def __call__(self, sources: Floats, directions: Floats) -> Floats:
        """Return amplitudes of a tone: (n,) float64."""
        phases_rad = self._omega_rad_s * (self._delays(sources) - self._delays(directions))
        return np.asarray(np.abs(np.exp(1j * phases_rad).mean(axis=1)))

    def side_lobe(self, places: Floats) -> float:
        """Return the highest amplitude in some places outside of the main lobes of others; 0 without any."""
        targets = np.random.default_rng(0).permutation(places)[:_N_TARGETS]
        phases_rad = (self._omega_rad_s * self._delays(targets)).astype(np.float32)
        waves = np.empty(phases_rad.shape, np.complex64)
        waves.real, waves.imag = np.cos(phases_rad), np.sin(phases_rad)
        sums = waves[:_N_SOURCES].conj() @ waves.T
        scaled = self._wave_1_m * self.axes.scaled_m(targets)
        squares = (scaled**2).sum(axis=1)
        far = squares[:_N_SOURCES, None] + squares - 2 * scaled[:_N_SOURCES] @ scaled.T > _FAR**2
        power = (sums.real**2 + sums.imag**2).max(initial=0.0, where=far)
        return math.sqrt(float(power)) / len(phases_rad.T)


class CallResponse:
    """Response to an echo of the call, at its range."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.axes = ArrayAxes(settings, array_weights(settings))

    @functools.cached_property
    def _point_spread(self) -> PointSpread:
        return spread_of(self._settings)

    def __call__(self, sources: Floats, directions: Floats) -> Floats:
        """Return amplitudes of an echo: (n,) float64."""
        return self._point_spread(directions - sources, np.zeros(len(sources)))

    def side_lobe(self, places: Floats) -> float:
        """Return 0: side lobes of a call of some bandwidth lie at other ranges, or are low."""
        del places
        return 0.0

"""Decrease of amplitude with distance."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["NEAREST_M", "estimate", "gain", "spreading"]

NEAREST_M = 0.01
"""Distance below which amplitudes no longer grow, because emitters, reflectors and microphones have a finite size."""


def gain(shot: Snapshot, paths: Paths, emitter: Emitter, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the amplitude gain due to geometric spreading, equal at all frequencies: (path, mic, 1) float64."""
    return spreading(paths)[..., None]


def spreading(paths: Paths) -> NDArray[np.float64]:
    """Return the amplitude gain due to geometric spreading: (path, mic)."""
    # Spheres have `1 / √(A B)` with `A = r₁ + r₂ + 2 r₁ r₂ / (a cos θ)` and `B = r₁ + r₂ + 2 r₁ r₂ cos θ / a` for the
    # angle of incidence θ (A. D. Pierce, Acoustics, 1989, chapter 8).
    first_m, second_m = paths.first_m, paths.second_m
    if not len(paths.targets):
        return np.asarray(1 / np.maximum(first_m + second_m, NEAREST_M))
    first_m, second_m = np.maximum(first_m, NEAREST_M), np.maximum(second_m, NEAREST_M)
    amplitude = 1 / (first_m * second_m)
    if not paths.surface:
        return np.asarray(amplitude)
    is_sphere = paths.targets.radius_m > 0
    radius_m = paths.targets.radius_m[is_sphere, None]
    r1, r2 = first_m[is_sphere], second_m[is_sphere]
    # The angle between the two legs is twice the angle of incidence.
    cos_double = -np.sum(paths.leaving[is_sphere] * paths.arriving[is_sphere], axis=-1)
    cos = np.sqrt(np.maximum((1 + cos_double) / 2, 1e-6))
    along, across = r1 + r2 + 2 * r1 * r2 / (radius_m * cos), r1 + r2 + 2 * r1 * r2 * cos / radius_m
    amplitude[is_sphere] = 1 / np.sqrt(along * across)
    return np.asarray(amplitude)


def estimate(sight: Sight) -> Estimate | None:
    """Compare the levels of echoes with those without spreading."""
    if not len(sight.heard):
        return None
    longest_m = float(np.max(sight.heard.delay_s)) * sight.shot.speed_m_s
    return filtered(sight, "spreading", f"on paths of up to {longest_m:.2f} m {{name}} changes by {{change:.1f}} dB")

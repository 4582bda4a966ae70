"""Surfaces of spheres, and size and orientation of discs."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.effects.disc import disc
from ertis_numba.simulation.effects.rigid_sphere import LARGE, rigid_sphere
from ertis_numba.simulation.effects.spreading import NEAREST_M
from ertis_numba.simulation.mirrors import Seen
from ertis_numba.simulation.paths import Paths, turning, unit
from ertis_numba.simulation.snapshot import ReceiverPose, Targets, TransmitterPose

__all__ = ["over_surfaces", "patterns"]

Floats = NDArray[np.float64]


def over_surfaces(
    first: Seen[TransmitterPose], second: Seen[ReceiverPose], targets: Targets, chosen: NDArray[np.intp]
) -> Paths:
    """Return paths that turn on the surface of spheres instead of at their centres.

    The arguments are those of `by_targets`.

    At the mirror point, the surface normal bisects the angle between the legs. The directions from the centre to both
    ends approximate those from the surface. This is exact for equal distances; otherwise the error is of third order in
    radius / distance.
    """
    centre_m = targets.positions_m[chosen, None, :]
    outwards = unit(unit(first.end.position_m - centre_m) + unit(second.end.positions_m - centre_m))
    turns_m = centre_m + targets.radius_m[chosen, None, None] * outwards
    return turning(first, second, targets, chosen, turns_m, surface=True)


def patterns(paths: Paths, frequency_hz: Floats, speed_m_s: float) -> Floats | NDArray[np.complex128]:
    """Return the gain of echoes due to the size of their targets: (path, mic, frequency), 1 for points.

    Spheres of a few wavelengths follow `rigid_sphere`, and larger ones are mirrors. Discs follow `disc`; their echo is
    0 unless emitter and microphone lie in the half space that the disc faces. The type is float64, or complex128 if a
    target shifts the phase.
    """
    wave = 2 * math.pi / speed_m_s * frequency_hz
    targets = paths.targets
    found = np.ones((*paths.second_m.shape, len(wave)), dtype=np.complex128)
    lowest = float(wave.min(initial=math.inf, where=wave > 0))
    small = (targets.radius_m > 0) & (targets.radius_m * lowest < LARGE)
    if small.any():
        cos_turn = np.sum(paths.leaving[small] * paths.arriving[small], axis=-1)
        found[small] = rigid_sphere(targets.radius_m[small, None] * wave, cos_turn)
    is_disc = targets.diameter_m > 0
    if is_disc.any():
        found[is_disc] = _disc_pattern(paths, is_disc, wave)
    return found if found.imag.any() else found.real


def _disc_pattern(paths: Paths, chosen: NDArray[np.bool_], wave: Floats) -> NDArray[np.complex128]:
    """Return the gain of each disc's echo at each microphone: (disc, mic, frequency) complex128."""
    to_receiver, to_transmitter = paths.arriving[chosen], -paths.leaving[chosen]
    normal, radius_m = paths.targets.normals[chosen, None], paths.targets.diameter_m[chosen, None] / 2
    both = to_receiver + to_transmitter
    aside = np.linalg.norm(both - np.sum(both * normal, axis=-1, keepdims=True) * normal, axis=-1)
    bent_m = 1 / np.maximum(paths.first_m[chosen], NEAREST_M) + 1 / np.maximum(paths.second_m[chosen], NEAREST_M)
    pattern = disc((radius_m * aside)[..., None] * wave, (radius_m**2 * bent_m)[..., None] * wave)
    seen = (np.sum(to_receiver * normal, axis=-1) > 0) & (np.sum(to_transmitter * normal, axis=-1) > 0)
    return np.where(seen[..., None], pattern, 0.0)

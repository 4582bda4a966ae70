"""Surfaces of spheres, and size and orientation of discs."""

import functools
import math

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.simulation.effects._piston import piston
from ertis_numba.simulation.effects.spreading import NEAREST_M
from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.mirrors import Seen
from ertis_numba.simulation.paths import Paths, by_targets, turning, unit
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import Receivers, Snapshot, Targets, Transmitters

__all__ = ["estimate", "gain", "turns"]

Floats = NDArray[np.float64]
_LARGE = 60.0  # k a, circumference in wavelengths, above which a sphere is a mirror; in backscatter they differ by 2 %
_FADES = 40.0  # between this value and `_LARGE`, the series blends into the mirror
_ORDERS = np.arange(int(_LARGE) + 15)  # beyond k a the terms fall faster than exponentially
_FAR = 0.02  # below this u, the far field of a disc is accurate to a few thousandths


def turns(first: Seen[Transmitters], second: Seen[Receivers], targets: Targets) -> Paths:
    """Return paths that turn on the surface of spheres instead of at their centres."""
    # The normal bisects the angle between the legs. Directions from the centre approximate those from the surface.
    if not np.any(targets.radius_m):
        return by_targets(first, second, targets)
    centre_m = targets.positions_m[first.place, None, :]
    outwards = unit(unit(first.images.position_m[:, None] - centre_m) + unit(second.images.positions_m - centre_m))
    turns_m = centre_m + targets.radius_m[first.place, None, None] * outwards
    return turning(first, second, targets, turns_m, surface=True)


def gain(
    shot: Snapshot, paths: Paths, emitter: Emitter, frequency_hz: Floats
) -> Floats | NDArray[np.complex128] | float:
    """Return the gain of echoes due to the size of their targets: (path, mic, frequency), 1 for points."""
    # Spheres follow `_rigid_sphere`, or are mirrors if large. Discs follow `_disc`, on the side that they face.
    targets = paths.targets
    if not len(targets):
        return 1.0
    wave = 2 * math.pi / shot.speed_m_s * frequency_hz
    found = np.ones((*paths.second_m.shape, len(wave)), dtype=np.complex128)
    lowest = float(wave.min(initial=math.inf, where=wave > 0))
    small = (targets.radius_m > 0) & (targets.radius_m * lowest < _LARGE)
    if small.any():
        cos_turn = np.sum(paths.leaving[small] * paths.arriving[small], axis=-1)
        found[small] = _rigid_sphere(targets.radius_m[small], wave, cos_turn)
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
    pattern = _disc((radius_m * aside)[..., None] * wave, (radius_m**2 * bent_m)[..., None] * wave)
    seen = (np.sum(to_receiver * normal, axis=-1) > 0) & (np.sum(to_transmitter * normal, axis=-1) > 0)
    return np.where(seen[..., None], pattern, 0.0)


def _disc(tilt: Floats, nearness: Floats) -> NDArray[np.complex128]:
    """Return the echo relative to the far-field echo along the normal, ``∫₀¹ J₀(v √t) exp(-j u t / 2) dt``."""
    # Kirchhoff's integral in Fresnel's approximation (M. Born, E. Wolf, section 8.8). `tilt` is `v = k a |s|` for the
    # component s in the plane of the sum of unit vectors; `nearness` is `u = k a² (1 / r₁ + 1 / r₂)`.
    found = piston(tilt).astype(np.complex128)
    near = nearness > _FAR
    if near.any():
        v, u = tilt[near], nearness[near]
        turns = (float(u.max()) / 2 + float(v.max())) / (2 * math.pi)
        places, weights = _nodes(16 + 8 * math.ceil(turns / 2))  # four per turn, and some for the ends
        total = np.zeros(len(v), dtype=np.complex128)
        for place, weight in zip((places + 1) / 2, weights / 2, strict=True):
            total += weight * scipy.special.j0(v * math.sqrt(place)) * np.exp(-0.5j * u * place)
        found[near] = total
    return found


@functools.lru_cache(maxsize=16)
def _nodes(count: int) -> tuple[Floats, Floats]:
    places, weights = np.polynomial.legendre.leggauss(count)
    return places, weights


def _rigid_sphere(radius_m: Floats, wave: Floats, cos_turn: Floats) -> NDArray[np.complex128]:
    """Return the echo relative to that of a curved mirror: (path, mic, frequency)."""
    # The series is `-(j / k) Σ (2n + 1) jₙ'(ka) / hₙ'(ka) Pₙ(cos Θ)` for `exp(jωt)` (P. M. Morse, K. U. Ingard, 1968,
    # section 8.2), that of the mirror `(a / 2) exp(2 j k a sin(Θ / 2))`. `cos_turn` (path, mic) is -1 for backscatter.
    found = np.empty((*cos_turn.shape, len(wave)), dtype=np.complex128)
    for radius in np.unique(radius_m):
        chosen = radius_m == radius
        size, cos = radius * wave, cos_turn[chosen]
        wanted = (size > 0) & (size < _LARGE)
        safe = np.where(wanted, size, 1.0)
        legendre, terms = _legendre(cos.ravel()), _terms(safe.tobytes())
        # Products of real matrices: a complex one would convert the polynomials.
        series = (legendre.T @ terms.real + 1j * (legendre.T @ terms.imag)).reshape(*cos.shape, -1)
        back = 2 * np.sqrt(np.maximum((1 - cos) / 2, 0.0))  # extra path to the centre, in radii
        ratio = -2j / safe * series * np.exp(-1j * back[..., None] * safe)
        weight = np.where(wanted, np.clip((_LARGE - safe) / (_LARGE - _FADES), 0.0, 1.0), 0.0)
        found[chosen] = 1 + weight * (ratio - 1)
    return found


def _legendre(argument: Floats) -> Floats:
    """Return the Legendre polynomials of all orders: (order, argument) float64."""
    found = np.empty((len(_ORDERS), len(argument)))
    found[0], found[1] = 1.0, argument
    for order in _ORDERS[1:-1]:
        found[order + 1] = ((2 * order + 1) * argument * found[order] - order * found[order - 1]) / (order + 1)
    return found


@functools.lru_cache(maxsize=64)
def _terms(sizes: bytes) -> NDArray[np.complex128]:
    """Return ``(2n + 1) jₙ' / hₙ'`` for sizes given as the bytes of a float64 array: (order, size) complex128."""
    size, orders = np.frombuffer(sizes), _ORDERS[:, None]
    near = scipy.special.spherical_jn(orders, size, derivative=True)
    far = scipy.special.spherical_yn(orders, size, derivative=True)
    # The term is negligible where ``far`` overflows.
    ratio = np.divide(near, near - 1j * far, out=np.zeros(near.shape, dtype=np.complex128), where=np.isfinite(far))
    return np.asarray((2 * orders + 1) * ratio)


def estimate(sight: Sight) -> Estimate | None:
    """Compare echoes from surfaces with those from centres, and echoes of discs with those of points."""
    targets = sight.shot.targets
    if not (np.any(targets.radius_m) or np.any(targets.diameter_m)):
        return None
    return filtered(sight, "target_size", "{name} has a size: its echo changes by {change:.2f} dB")

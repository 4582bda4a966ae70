"""High-resolution CLEAN-SC: separation of sources that lie within one main lobe."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.waves import Waves

__all__ = ["HighResolutionClean"]

Complex = NDArray[np.complex128]
Floats = NDArray[np.float64]
Places = NDArray[np.intp]

_MARKER_POWER: Final = 0.25  # Least power of a source at its marker, relative to its peak (Sijtsma et al., 2017).
_LEAST: Final = 0.01  # Power relative to the strongest source below which a source barely disturbs others.
_MAX_SOURCES: Final = 4  # Sources of a bin; CLEAN-SC finds the others.
_SWEEPS: Final = 5
_HOLLOW_ROUNDS: Final = 12  # Each leaves about a sixteenth of the error, as in CLEAN-SC.


class _Found(NamedTuple):
    """Sources of several bins, each with the same number."""

    bins: Places
    places: Places  # (bin, source) numbers of their directions
    powers: Floats  # (bin, source)
    rest: Complex  # (bin, mic, mic) without their components


class HighResolutionClean:
    """Search for the components of sources in matrices (bin, mic, mic) by markers beside their peaks.

    docs/explanation/acoustic-maps.md has the steps (P. Sijtsma et al., 2017). Sources are added one by one, which needs
    no exact number of them. If ``hollow``, the diagonal of the matrices is left out.
    """

    def __init__(self, matrices: NDArray[np.complexfloating], waves: Waves, *, hollow: bool) -> None:
        n_mics = matrices.shape[1]
        self._kept = 1 - np.eye(n_mics) if hollow else np.ones((n_mics, n_mics))
        self._matrices = matrices.astype(np.complex128) * self._kept
        self._waves, self._hollow = waves, hollow
        self._norm = max(n_mics**2 - n_mics, 1) if hollow else n_mics**2

    def __call__(self) -> tuple[NDArray[np.float32], NDArray[np.complex64]]:
        """Return the powers of sources, (bin, direction), and the matrices without their components."""
        n_bins = len(self._matrices)
        rest = self._matrices.copy()
        found = _Found(np.arange(n_bins), np.zeros((n_bins, 0), np.intp), np.zeros((n_bins, 0)), rest.copy())
        left = self._map(found.rest, found.bins)
        out = np.zeros_like(left)
        while True:
            place, peak = left.argmax(axis=1), left.max(axis=1)
            grows = (peak > 0) & (peak > _LEAST * found.powers.max(axis=1, initial=0))
            grows &= found.places.shape[1] < _MAX_SOURCES
            done = self._converged(_some(found, ~grows))
            rest[done.bins] = done.rest
            np.add.at(out, (done.bins[:, None], done.places), done.powers.astype(np.float32))
            found = _some(found, grows)
            if not len(found.bins):
                return out, rest.astype(np.complex64)
            places = np.concatenate([found.places, place[grows, None]], axis=1)
            powers = np.concatenate([found.powers, peak[grows, None]], axis=1)
            found = self._swept(found._replace(places=places, powers=powers))
            left = self._map(found.rest, found.bins)

    def _converged(self, found: _Found) -> _Found:
        """Return the sources after sweeps that move none of them any more."""
        moving = np.arange(len(found.bins) if found.places.shape[1] > 1 else 0)
        for _ in range(_SWEEPS):
            before = _some(found, moving)
            if not len(moving):
                break
            after = self._swept(before)
            for whole, part in zip(found, after, strict=True):
                whole[moving] = part
            moving = moving[(after.places != before.places).any(axis=1)]
        return found

    def _swept(self, found: _Found) -> _Found:
        """Return the sources with new components, the strongest first."""
        rows = np.arange(len(found.bins))
        rest = self._matrices[found.bins]
        places, powers = found.places.copy(), np.zeros_like(found.powers)
        order = np.argsort(-found.powers, axis=1, kind="stable")
        every = self._waves.vectors(found.bins[:, None], found.places)
        for rank in range(order.shape[1]):
            sources = order[:, rank]
            markers = self._markers(found, every, sources)
            shared = self._shared(rest, self._waves.vectors(found.bins, markers))
            power = self._map(shared, found.bins)
            places[rows, sources] = power.argmax(axis=1)
            powers[rows, sources] = np.maximum(power.max(axis=1), 0)
            rest -= shared
        return _Found(found.bins, places, powers, rest)

    def _markers(self, found: _Found, every: Complex, sources: Places) -> Places:
        """Return the marker of one source of each bin: (bin,) intp."""
        rows = np.arange(len(sources))
        here, strongest = found.places[rows, sources], found.powers.max(axis=1, initial=0)
        weights = found.powers / np.maximum(strongest, np.finfo(float).tiny)[:, None]
        weights[rows, sources] = 0
        own = every[rows, sources]
        others = np.einsum("ns,nsi,nsj->nij", weights, every, every.conj())
        disturbed = weights.any(axis=1)
        if not disturbed.any():
            return here
        disturbance = self._waves.steer((others @ others).astype(np.complex64), found.bins)
        outer = own[:, :, None] * own[:, None].conj()
        seen = self._waves.steer(outer.astype(np.complex64), found.bins)
        is_near = seen >= _MARKER_POWER * own.shape[1] ** 2
        share = np.where(is_near, disturbance / np.where(is_near, seen, 1), np.inf)
        return np.where(disturbed, share.argmin(axis=1), here)

    def _shared(self, rest: Complex, markers: Complex) -> Complex:
        """Return the part of matrices that is coherent with the waves of markers: (bin, mic, mic)."""
        weights = markers / np.sqrt(self._norm)
        sound = np.einsum("nij,nj->ni", rest, weights)
        power = np.maximum(np.einsum("ni,ni->n", weights.conj(), sound).real, 0)
        seen = sound / np.where(power > 0, power, 1)[:, None]
        component: Complex = seen
        for _ in range(_HOLLOW_ROUNDS if self._hollow else 0):
            own = np.abs(component) ** 2
            component = (seen + own * weights) / np.sqrt(1 + own.sum(axis=1) / self._norm)[:, None]
        product: NDArray[Any] = component[:, :, None] * component[:, None].conj()
        return np.asarray(power[:, None, None] * product * self._kept)

    def _map(self, matrices: Complex, bins: Places) -> NDArray[np.float32]:
        return self._waves.steer(matrices.astype(np.complex64), bins) / np.float32(self._norm)


def _some(found: _Found, chosen: NDArray[Any]) -> _Found:
    return _Found(*(each[chosen] for each in found))

"""Methods of acoustic maps: power from each direction, from cross-spectral matrices.

``v`` is the wave from a direction, whose M elements have a magnitude of 1, and ``C`` the cross-spectral matrix of a
bin. All methods except CLEAN-SC and HR-CLEAN-SC are the quadratic form of a transformed matrix, followed by a scalar
function.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.passive.cross_spectrum import CrossSpectrum
from ertis_numba.passive.high_resolution import HighResolutionClean
from ertis_numba.passive.waves import Waves
from ertis_numba.settings import MapMethodName, Passive

__all__ = ["METHODS", "capon", "clean_sc", "delay_and_sum", "functional", "hr_clean_sc", "in_parts", "music"]

Matrices = NDArray[np.complex64]
Powers = NDArray[np.float32]
Vectors = NDArray[np.complex128]

_LEAST: Final = np.float32(1e-30)
_CANCELLED: Final = 3e-4  # Relative power of a wave below which single precision errs by more than 0.01 dB.

Method = Callable[[CrossSpectrum, Waves, Passive], Powers]


Number = TypeVar("Number", np.complex64, np.complex128)

_MIN_BINS: Final = 8  # Matrices of fewer bins take less time than the start of a thread.


def in_parts(function: Callable[..., NDArray[Number]], *of_bins: NDArray[Any], threads: int) -> NDArray[Number]:
    """Return the rows of a function of bins, called once per thread with a part of each array."""
    # NumPy computes linear algebra without holding the lock of the interpreter.
    n_bins = len(of_bins[0])
    count = max(1, min(threads, n_bins // _MIN_BINS))
    if count == 1:
        return function(*of_bins)
    parts = [np.array_split(each, count) for each in of_bins]
    with ThreadPoolExecutor(count, thread_name_prefix="ertis-bins") as pool:
        return np.concatenate(list(pool.map(function, *parts)))


def delay_and_sum(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return ``v^H C v / M²``, or without the diagonal of C ``v^H C v / (M² − M)``, at least 0."""
    return np.maximum(_steered(spectrum, waves, passive), 0)


def _steered(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return the map of delay-and-sum, which is negative at some directions if the diagonal is left out."""
    n_mics = spectrum.matrix.shape[1]
    if not passive.diagonal_removal:
        return np.asarray(waves.steer(spectrum.matrix) / n_mics**2, np.float32)
    return np.asarray(waves.steer(_hollow(spectrum.matrix)) / max(n_mics**2 - n_mics, 1), np.float32)


def functional(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return ``(v^H C^(1/ν) v / M)^ν / M`` for the order ν (R. P. Dougherty, 2014)."""
    order, n_mics = passive.functional_order, spectrum.matrix.shape[1]

    def roots(matrices: Matrices) -> Matrices:
        values, vectors = _eigen(matrices)
        return _matrices(np.maximum(values, 0) ** (1 / order), vectors)

    powers = waves.steer(in_parts(roots, spectrum.matrix, threads=waves.threads))
    return np.asarray(np.maximum(powers / n_mics, 0) ** order / n_mics, np.float32)


def capon(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return ``1 / (v^H (C + loading · mean power)^−1 v)`` (J. Capon, 1969)."""
    mean = _mean_powers(spectrum.matrix)

    def inverses(matrices: Matrices, mean: NDArray[np.float64]) -> Matrices:
        loading = passive.diagonal_loading * np.eye(matrices.shape[1])
        loaded = matrices.astype(np.complex128) / mean[:, None, None] + loading
        return np.linalg.inv(loaded).astype(np.complex64)

    powers = waves.steer(in_parts(inverses, spectrum.matrix, mean, threads=waves.threads))
    return np.asarray(mean[:, None] / np.maximum(powers, _LEAST), np.float32)


def music(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return ``M / (v^H N N^H v)``, where N holds the eigenvectors beyond those of the sources (R. Schmidt, 1986)."""
    n_mics, n_sources = spectrum.matrix.shape[1], passive.n_sources
    if spectrum.n_blocks <= n_sources:
        raise DataError(
            f"passive.method is 'music' with {n_sources} sources, which needs more than {n_sources} blocks of samples, "
            f"but there are {spectrum.n_blocks}; use a larger passive.averages, or wider bands"
        )

    is_noise = 2 * n_sources > n_mics  # The smaller one of both subspaces takes fewer operations.
    numbers = np.arange(n_mics - n_sources) if is_noise else np.arange(n_mics - n_sources, n_mics)

    def bases(matrices: Matrices) -> Vectors:
        return _eigen(matrices)[1][:, :, numbers].transpose(0, 2, 1)

    vectors = in_parts(bases, spectrum.matrix, threads=waves.threads)
    powers = waves.steer_vectors(vectors.astype(np.complex64)) if is_noise else _powers_outside(vectors, waves)
    return np.asarray(n_mics / np.maximum(powers, 1e-6 * n_mics), np.float32)


def _powers_outside(vectors: Vectors, waves: Waves) -> Powers:
    """Return the power of each wave outside the subspace that orthonormal vectors span: (bin, direction)."""
    n_mics = vectors.shape[2]
    powers: Powers = n_mics - waves.steer_vectors(vectors.astype(np.complex64))
    for k in np.flatnonzero(powers.min(axis=1) < _CANCELLED * n_mics):
        near = np.flatnonzero(powers[k] < _CANCELLED * n_mics)
        inside = waves.vectors(np.full_like(near, k), near) @ vectors[k].conj().T
        powers[k, near] = n_mics - (np.abs(inside) ** 2).sum(axis=1)
    return powers


def clean_sc(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return the powers of sources whose coherent sound is subtracted from the map (P. Sijtsma, 2007)."""
    return waves.clean(spectrum.matrix, _steered(spectrum, waves, passive), hollow=passive.diagonal_removal)


def hr_clean_sc(spectrum: CrossSpectrum, waves: Waves, passive: Passive) -> Powers:
    """Return the powers of sources with markers beside their peaks, and those of CLEAN-SC in the rest."""
    found, rest = HighResolutionClean(spectrum.matrix, waves, hollow=passive.diagonal_removal)()
    left = CrossSpectrum(rest, spectrum.frequency_hz, spectrum.n_blocks)
    return found + clean_sc(left, waves, passive)


def _hollow(matrices: Matrices) -> Matrices:
    out = matrices.copy()
    places = np.arange(matrices.shape[1])
    out[:, places, places] = 0
    return out


def _mean_powers(matrices: Matrices) -> NDArray[np.float64]:
    """Return the mean power of the microphones, (bin,), at least `_LEAST`."""
    means = np.trace(matrices, axis1=1, axis2=2, dtype=np.complex128).real / matrices.shape[1]
    return np.asarray(np.maximum(means, _LEAST))


def _eigen(matrices: Matrices) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Return eigenvalues in ascending order, (bin, mic), and eigenvectors, (bin, mic, number)."""
    values, vectors = np.linalg.eigh(matrices.astype(np.complex128))
    return values, vectors


def _matrices(values: NDArray[Any], vectors: NDArray[np.complex128]) -> Matrices:
    """Return the matrices with given eigenvalues and eigenvectors."""
    product: NDArray[Any] = (vectors * values[:, None, :]) @ vectors.conj().transpose(0, 2, 1)
    return product.astype(np.complex64)


METHODS: Final[dict[MapMethodName, Method]] = {
    "delay_and_sum": delay_and_sum,
    "functional": functional,
    "capon": capon,
    "music": music,
    "clean_sc": clean_sc,
    "hr_clean_sc": hr_clean_sc,
}
"""Function of each method of `Passive`."""

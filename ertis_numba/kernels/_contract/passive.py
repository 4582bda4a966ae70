"""Contracts of passive listening: signals to cross-spectral matrices, and these to the power from each direction."""

from typing import Protocol

from ertis_numba.kernels._contract.arrays import Complex, Real, Turns

__all__ = ["CrossSpectra", "SteerPower"]


class CrossSpectra(Protocol):
    """Sum the products of the spectra of each two microphones over blocks of samples.

    ``out[bin, i, j] = Σ_block spectra[i, block, first + bin] · conj(spectra[j, block, first + bin])``

    Parameters
    ----------
    spectra : (mic, block, bin) complex64
    first : int
        First bin of the matrices.
    out : (bin, mic, mic) complex64
        Hermitian matrices, to within rounding.
    """

    def __call__(self, spectra: Complex, first: int, out: Complex) -> None: ...


class SteerPower(Protocol):
    """Compute the power that Hermitian matrices have for the wave from each direction.

    ``out[k, direction] = Σ_ij conj(v_i) · matrices[k, i, j] · v_j`` with ``v_i = exp(−2πi · bins[k] · steps[i,
    direction] / 2³²)``. Only the real parts of the diagonal and the elements above it are read.

    Parameters
    ----------
    matrices : (bin, mic, mic) complex64
    steps : (mic, direction) uint32
        Phase by which a microphone lags, for each bin, in 2⁻³² of a turn.
    bins : (bin,) uint32
        Number of each matrix's bin: its frequency relative to the spacing of bins.
    out : (bin, direction) float32
    """

    def __call__(self, matrices: Complex, steps: Turns, bins: Turns, out: Real) -> None: ...

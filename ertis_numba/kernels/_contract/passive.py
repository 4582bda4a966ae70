"""Contracts of passive listening: signals to cross-spectral matrices, and these to the power from each direction."""

from typing import Final, Protocol

import numpy as np

from ertis_numba.kernels._contract.arrays import Complex, Real, Turns

__all__ = [
    "CLEAN_GROWTH",
    "CLEAN_HOLLOW_ROUNDS",
    "CLEAN_LOOP_GAIN",
    "CLEAN_ROUNDS_PER_MICROPHONE",
    "CleanSources",
    "CrossSpectra",
    "SteerPower",
    "SteerVectors",
]

CLEAN_LOOP_GAIN: Final = np.float32(0.6)
"""Share of a component that a round of CLEAN-SC subtracts, as in Acoular."""

CLEAN_ROUNDS_PER_MICROPHONE: Final = 2
"""Largest number of rounds of CLEAN-SC, relative to the number of microphones, as in Acoular."""

CLEAN_GROWTH: Final = 3
"""Rounds of CLEAN-SC over which the peak may not grow, as in Acoular."""

CLEAN_HOLLOW_ROUNDS: Final = 12
"""Repetitions that find a component without the diagonal; each leaves about a sixteenth of the error."""


class CrossSpectra(Protocol):
    """Sum the products of the spectra of each two microphones over blocks of samples: (bin, mic, mic), Hermitian.

    ``out[bin, i, j] = Σ_block spectra[i, block, first + bin] · conj(spectra[j, block, first + bin])``
    """

    def __call__(self, spectra: Complex, first: int, out: Complex) -> None: ...


class SteerPower(Protocol):
    """Compute the power that Hermitian matrices have for the wave from each direction.

    ``out[k, direction] = Σ_ij conj(v_i) · matrices[k, i, j] · v_j`` with ``v_i = exp(−2πi · bins[k] · steps[i,
    direction] / 2³²)``. Only the real parts of the diagonal and the elements above it are read. ``steps`` (mic,
    direction) are the phases by which a microphone lags for each bin, and ``bins`` (bin,) the frequencies relative to
    their spacing.
    """

    def __call__(self, matrices: Complex, steps: Turns, bins: Turns, out: Real) -> None: ...


class SteerVectors(Protocol):
    """Compute the power that vectors have for the wave from each direction.

    ``out[k, direction] = Σ_n |Σ_i conj(vectors[k, n, i]) · v_i|²`` with the waves ``v`` of `SteerPower`. This is the
    power of the matrix ``Σ_n x_n x_n^H`` of the vectors ``x_n``, and takes fewer operations if they are few.
    """

    def __call__(self, vectors: Complex, steps: Turns, bins: Turns, out: Real) -> None: ...


class CleanSources(Protocol):
    """Find the sources of each bin, by subtracting all sound that is coherent with the loudest direction.

    This is CLEAN-SC (P. Sijtsma, CLEAN based on spatial source coherence, 2007). With the waves ``v`` of `SteerPower`
    and M microphones, ``norm`` is M², or M² − M if the diagonal is left out (``hollow``); ``powers`` is the map ``v^H
    matrix v / norm``. Each round takes the first direction with the largest power P, adds ``CLEAN_LOOP_GAIN · P`` to
    its element of ``out``, and subtracts a component c from matrix and powers: ``matrix −= CLEAN_LOOP_GAIN · P · c
    c^H`` and ``powers −= CLEAN_LOOP_GAIN · P · |v^H c|² / norm``. With ``w = v / sqrt(norm)``, the component is
    ``matrix · w / P``. If the diagonal is left out, it is the solution of ``c = (matrix · w / P + |c|² w) / sqrt(1 + Σ
    |w|² |c|²)``, and ``|v^H c|² − Σ |c|²`` replaces ``|v^H c|²``. The rounds of a bin end if P is not positive or
    exceeds that of `CLEAN_GROWTH` rounds before, apart from the first rounds, or after `CLEAN_ROUNDS_PER_MICROPHONE` ·
    M rounds.
    """

    def __call__(
        self,
        matrices: Complex,
        steps: Turns,
        bins: Turns,
        powers: Real,
        hollow: bool,  # noqa: FBT001 - kernels have no keywords
        out: Real,
    ) -> None: ...

"""From analytic signals to envelopes of other beamformers."""

from typing import Protocol

from ertis_numba.kernels._contract.arrays import Complex, Index, Real

__all__ = ["CombineCapon", "CombineCoherence", "CombineDmas"]


class CombineCoherence(Protocol):
    """Delay-and-sum times the coherence factor of Mallart and Fink (1994), which tells how well microphones agree.

    With ``y = weights[direction, mic] · signals.flat[offsets[direction, mic] + range]``,
    ``out[direction, range] = |Σ y| · |Σ y|² / (M Σ |y|²)`` over the M microphones, and 0 where all are silent.

    Parameters
    ----------
    signals, offsets, weights
        As in `DelayAndSum`.
    out : (direction, range) float32
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, out: Real) -> None: ...


class CombineDmas(Protocol):
    """Delay-multiply-and-sum: sum the products of the roots of all choices of ``order`` microphones.

    ``out[direction, range] = |e_order(z)|``, the elementary symmetric polynomial of all microphones' z =
    ``weights[direction, mic] · root(signals.flat[offsets[direction, mic] + range])`` with
    ``root(x) = x / |x|^(1 − 1 / order)`` and ``root(0) = 0``.

    It is built up microphone by microphone, ``e_k += z e_(k−1)``, and errs by rounding of ``e_order(|z|)`` at most.
    Power sums and Newton's identities, the other way, subtract what nearly cancels where one microphone is much
    louder than all others.

    Parameters
    ----------
    signals, offsets
        As in `DelayAndSum`.
    weights : (direction, mic) complex64
        Of roots.
    order : int
        At least 2, and at most the number of microphones.
    out : (direction, range) float32
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, order: int, out: Real) -> None: ...


class CombineCapon(Protocol):
    """Combine the microphones with the weights that let a beam's own sound pass and all other sound least.

    With y as in `CombineCoherence`, its covariance R over the ``n_snapshots`` ranges about a range (near the ends
    of the image, the nearest that are in it) and M microphones, ``w = R'⁻¹ 1 / (1ᵀ R'⁻¹ 1)`` with
    ``R' = R + loading · trace(R) / M · I`` and ``out[direction, range] = |wᴴ y|``; 0 where all are silent.

    Parameters
    ----------
    signals, offsets, weights
        As in `DelayAndSum`, but weights of magnitude 1 make ``out`` an amplitude: w adds up to 1.
    n_snapshots : int
        At least 1; more than there are ranges count as all ranges.
    loading : float
        Above 0.
    out : (direction, range) float32
    """

    def __call__(
        self, signals: Complex, offsets: Index, weights: Complex, n_snapshots: int, loading: float, out: Real
    ) -> None: ...

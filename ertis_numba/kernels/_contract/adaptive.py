"""Contracts of adaptive beamformers and weightings: analytic signals to envelopes."""

from dataclasses import dataclass
from typing import Protocol

from ertis_numba.kernels._contract.arrays import Complex, ComplexOrDouble, Index, Real

__all__ = ["AdaptiveKernels"]


class WeightCoherence(Protocol):
    """Multiply amplitudes by the coherence factor of Mallart and Fink (1994), which measures agreement.

    With ``y = weights[direction, mic] · signals.flat[offsets[direction, mic] + range]``, the factor is
    ``|Σ y|² / (M Σ |y|²)`` over the M microphones, and 0 if all are silent.

    Parameters
    ----------
    signals, offsets, weights
        As in `DelayAndSum`.
    out : (direction, range) float32
        Amplitudes, which the kernel replaces by their products with the factor.
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, out: Real) -> None: ...


class CombineDmas(Protocol):
    """Delay-multiply-and-sum: sum the products of the roots of all combinations of ``order`` microphones.

    ``out[direction, range] = |e_order(z)|``, the elementary symmetric polynomial of all microphones'
    ``z = weights[direction, mic] · root(signals.flat[offsets[direction, mic] + range])``. Here
    ``root(x) = x / |x|^(1 − 1 / order)`` and ``root(0) = 0``.

    The recursion ``e_k += z e_(k−1)`` adds one microphone at a time. Its error is at most the rounding of
    ``e_order(|z|)``. The alternative, power sums and Newton's identities, suffers from cancellation if one microphone
    is much louder than all others.

    Parameters
    ----------
    signals, offsets
        As in `DelayAndSum`.
    weights : (direction, mic) complex64
        Weights of the roots.
    order : int
        At least 2, at most the number of microphones.
    out : (direction, range) float32
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, order: int, out: Real) -> None: ...


class CombineCapon(Protocol):
    """Combine the microphones with the Capon (minimum-variance distortionless response) weights.

    Let y be as in `WeightCoherence`, and R its covariance over the ``n_snapshots`` ranges around a range. Near the
    ends of the image, R uses the nearest ranges inside it. With M microphones and
    ``R' = R + loading · trace(R) / M · I``, the weights are ``w = R'⁻¹ 1 / (1ᵀ R'⁻¹ 1)``. The result is
    ``out[direction, range] = |wᴴ y|``, and 0 if all microphones are silent.

    Parameters
    ----------
    signals, offsets
        As in `DelayAndSum`.
    weights : (direction, mic) complex64 or complex128
        As in `DelayAndSum`; those of magnitude 1 make ``out`` an amplitude, because w adds up to 1. Their type selects
        single or double precision. In single precision, the relative error is about 10⁻⁷ M / loading at most.
    n_snapshots : int
        At least 1; a value above the number of ranges means all ranges.
    loading : float
        Diagonal loading relative to the mean microphone power, above 0.
    out : (direction, range) float32
    """

    def __call__(
        self, signals: Complex, offsets: Index, weights: ComplexOrDouble, n_snapshots: int, loading: float, out: Real
    ) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptiveKernels:
    """Kernels of adaptive beamformers and weightings, as attributes of a `KernelSet`."""

    combine_dmas: CombineDmas
    combine_capon: CombineCapon
    weight_coherence: WeightCoherence

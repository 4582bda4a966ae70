"""Contracts of adaptive beamformers and weightings: analytic signals to envelopes."""

from dataclasses import dataclass
from typing import Protocol

from ertis_numba.kernels._contract.arrays import Complex, ComplexOrDouble, Index, Real

__all__ = ["AdaptiveKernels"]


class WeightCoherence(Protocol):
    """Multiply amplitudes by the coherence factor of Mallart and Fink (1994), which measures agreement.

    With ``y = weights[direction, mic] · signals.flat[offsets[direction, mic] + range]``, the factor is ``|Σ y|² / (M Σ
    |y|²)`` over the M microphones, and 0 if all are silent. ``out`` (direction, range) changes in place.
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, out: Real) -> None: ...


class CombineDmas(Protocol):
    """Delay-multiply-and-sum: sum the products of the roots of all combinations of ``order`` (≥ 2) microphones.

    ``out[direction, range] = |e_order(z)|``, the elementary symmetric polynomial of all microphones' ``z =
    weights[direction, mic] · root(signals.flat[offsets[direction, mic] + range])``, with ``root(x) = x / |x|^(1 − 1 /
    order)``. The recursion ``e_k += z e_(k−1)`` adds one microphone at a time. Its error is at most the rounding of
    ``e_order(|z|)``. Power sums and Newton's identities would suffer from cancellation if one microphone is much louder
    than all others.
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, order: int, out: Real) -> None: ...


class CombineCapon(Protocol):
    """Combine the microphones with the Capon (minimum-variance distortionless response) weights.

    Let y be as in `WeightCoherence`, and R its covariance over the ``n_snapshots`` ranges around a range, or the
    nearest ones inside the image, at most all. With M microphones and ``R' = R + loading · trace(R) / M · I``, the
    weights are ``w = R'⁻¹ 1 / (1ᵀ R'⁻¹ 1)``, and ``out[direction, range] = |wᴴ y|``, 0 if all microphones are silent.
    Steering weights of magnitude 1 make it an amplitude, because w adds up to 1. Their type, complex64 or complex128,
    selects the precision. In single precision, the relative error is about 10⁻⁷ M / loading at most.
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

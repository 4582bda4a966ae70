"""Contracts of delay-and-sum: analytic signals to envelopes."""

from typing import Protocol

import numpy as np

from ertis_numba.kernels._contract.arrays import Complex, Index, Real, Short

__all__ = [
    "CombineDelayed",
    "DelayAndSum",
    "DelayAndSumEnvelope",
    "DelayAndSumEnvelopeInt16",
    "Envelope",
    "InterpolatedBeamsEnvelope",
    "InterpolatedBeamsEnvelopeInt16",
    "QuantiseTiles",
    "RectifyAndDecimate",
    "SumDelayedInt16",
]


class DelayAndSum(Protocol):
    """Sum the delayed and weighted signals (mic, phase, sample) of all microphones for every direction and range.

    ``out[direction, range] = Σ_mic weights[direction, mic] · signals.flat[offsets[direction, mic] + range]``. The
    offset selects microphone, phase and first sample at once. The weight corrects the phase of the carrier for the
    rounding of the delay.
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, out: Complex) -> None: ...


class Envelope(Protocol):
    """Compute the magnitude of every ``step``-th sample of analytic beams: ``out[:, n] = |beams[:, n · step]|``."""

    def __call__(self, beams: Complex, step: int, out: Real) -> None: ...


class DelayAndSumEnvelope(Protocol):
    """`DelayAndSum` and `Envelope` in one pass over ranges ``first … stop - 1``, without writing beams to memory.

    ``out[direction, range] = |Σ_term weights[direction, term] · signals.flat[offsets[direction, term] + range]|``.
    A term is one sample of one microphone. If delays are interpolated, each microphone has several terms.
    """

    def __call__(
        self, signals: Complex, offsets: Index, weights: Complex, first: int, stop: int, out: Real
    ) -> None: ...


class InterpolatedBeamsEnvelope(Protocol):
    """Compute beams on a coarse beam grid, interpolate the beams of all directions, and take their envelopes.

    ``grid[point, range] = Σ_term weights[point, term] · signals.flat[offsets[point, term] + range]`` and
    ``out[rows[direction], range] = |Σ_pair,k tap_weights[direction, pair, k] · beam|`` with the beam
    ``grid[places[direction, pair] + k, range]``, for k = 0 and 1. Directions that share grid points should be adjacent.
    Several blocks of directions, ``n_blocks``, are useful if there are more threads than tiles of ranges. ``out`` needs
    at least 64 ranges, because signals are read that far.
    """

    def __call__(
        self,
        signals: Complex,
        offsets: Index,
        weights: Complex,
        places: Index,
        tap_weights: Real,
        rows: Index,
        first: int,
        stop: int,
        n_blocks: int,
        out: Real,
    ) -> None: ...


class QuantiseTiles(Protocol):
    """Split analytic signals into tiles of ranges, and store each in 16 bits with its own scale.

    ``tiles[tile, mic, phase, k] ≈ signals[mic, phase, starts[tile] + k] / scales[tile]``, rounded, as pairs of real and
    imaginary part. The largest magnitude of a tile becomes ``limit``. Beyond the end of the signals, tiles are 0. A
    tile spans decimetres, so an echo keeps its 16 bits regardless of stronger reflectors at other ranges.
    """

    def __call__(self, signals: Complex, starts: Index, limit: np.float32, tiles: Short, scales: Real) -> None: ...


class DelayAndSumEnvelopeInt16(Protocol):
    """`DelayAndSumEnvelope` on the tiles of `QuantiseTiles`, with integer sums, for ranges below ``stop``.

    ``out[direction, starts[tile] + k] = scales[tile] · weight_scale · |Σ_term w · x|`` with ``x =
    tiles[tile].flat[offsets[direction, term] + k]``, for k below the device's ``tile_ranges``, by which starts are
    apart. ``weights`` (direction, term, 2, 2) are ``((re w, −im w), (im w, re w))``.
    """

    def __call__(
        self,
        tiles: Short,
        scales: Real,
        starts: Index,
        stop: int,
        offsets: Index,
        weights: Short,
        weight_scale: np.float32,
        out: Real,
    ) -> None: ...


class InterpolatedBeamsEnvelopeInt16(Protocol):
    """`InterpolatedBeamsEnvelope` on the tiles of `QuantiseTiles`, with integer sums as in `DelayAndSumEnvelopeInt16`.

    Beams on the grid keep the upper 16 bits of their sums, rounded: ``(sum + 2¹⁵) >> 16``. ``weight_scale`` is the
    value of 1 in the interpolated sums, in units of the tile's scale.
    """

    def __call__(
        self,
        tiles: Short,
        scales: Real,
        starts: Index,
        stop: int,
        offsets: Index,
        weights: Short,
        places: Index,
        tap_weights: Short,
        rows: Index,
        weight_scale: np.float32,
        n_blocks: int,
        out: Real,
    ) -> None: ...


class CombineDelayed(Protocol):
    """Combine the delayed real signals of all microphones for every direction and sample.

    For order 1, ``out[direction, n] = Σ x`` over the microphones, with
    ``x = signals[mic, first + n + delays[direction, mic]]``. For orders up to 5, it is the sum of the products of all
    combinations of ``order`` values of ``roots``, delayed alike. With ``coherent``, the result is multiplied by
    ``(Σ x)² / (n_mics Σ x²)``, or by 0 where all x are 0.
    """

    def __call__(
        self, signals: Real, roots: Real, delays: Index, order: int, coherent: int, first: int, out: Real
    ) -> None: ...


class SumDelayedInt16(Protocol):
    """Sum the delayed 16-bit signals of all microphones; the sums fit into 16 bits.

    ``out[direction, tile · size + n] = units[tile] · Σ_mic tiles[tile, mic, delays[direction, mic] + n]`` for n below
    ``size``, the number of samples of ``out`` divided by the number of tiles, whose delayed signals are longer.
    """

    def __call__(self, tiles: Short, units: Real, delays: Index, out: Real) -> None: ...


class RectifyAndDecimate(Protocol):
    """Rectify real beams, filter them, and keep every factor-th sample.

    ``out[direction, r] = scale · Σ_t taps[t] · |beams[direction, first + r · factor + t]|``. The CPU rounds magnitudes
    to 15 bits of the largest one in 2048 samples. Pairs of taps have four classes: the number of a pair modulo 4. In
    each, the sum of the magnitudes is at most 65,535, so that sums of products fit into 32 bits on every processor.
    """

    def __call__(self, beams: Real, taps: Short, scale: float, factor: int, first: int, out: Real) -> None: ...

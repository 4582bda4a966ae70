"""Contracts of adaptive beamformers from delay-and-sums of streams: analytic signals to envelopes.

A stream is ``|x|^power · exp(i turns φ)`` of the samples ``x = |x| exp(iφ)`` of analytic signals. Sums of few delayed
streams over the microphones determine DMAS and the coherence factor.
"""

from typing import Protocol

from ertis_numba.kernels._contract.arrays import Complex, Index, Real, Short

__all__ = ["CombineStreamsInt16", "QuantiseStreams"]


class QuantiseStreams(Protocol):
    """Compute streams ``first … stop - 1`` of analytic signals, and store them like `QuantiseTiles`.

    ``tiles[tile, stream, mic, phase, k] ≈ y · units[stream] / scales[tile, stream]``, rounded, as pairs of real and
    imaginary part. y is the stream ``|x|^powers[stream] · exp(i turns[stream] φ)`` of the sample
    ``x = signals[mic, phase, starts[tile] + k]``, and 0 for x = 0. The largest magnitude X of a tile becomes
    ``limits[stream]``. Beyond the end of the signals, tiles are 0.
    A stream without turns is real. Its imaginary part is ``limits[stream] · (|x| / X)^(power / 2)``, so that weak
    signals also have some digits.
    """

    def __call__(
        self,
        signals: Complex,
        starts: Index,
        limits: Real,
        units: Real,
        powers: Real,
        turns: Index,
        first: int,
        stop: int,
        tiles: Short,
        scales: Real,
    ) -> None: ...


class CombineStreamsInt16(Protocol):
    """Compute amplitudes from delay-and-sums of streams on the tiles of `QuantiseStreams`, with integer sums.

    The sums are those of the tiles times their scales. Let ``p_i`` be the sum of stream i − 1, and 0 for i above the
    number of power sums. The amplitude is ``|e_order|`` from Newton's identities,
    ``k e_k = Σ_i (−1)^(i − 1) e_(k − i) p_i`` with ``e_0 = 1``. It is multiplied by the coherence factor
    ``|b|² / (M s)``, at most 1, with the sum b of one stream, the real part s of the sum of another, and M microphones.
    In 16 bits, s is coarse for weak signals. It is therefore at least ``M t² / (bound · scale)`` with the imaginary
    part t of that sum, by the inequality of Cauchy and Schwarz for weights with a sum of 1 / M.

    A stream is summed as in `DelayAndSumEnvelopeInt16` or, with pairs, in `InterpolatedBeamsEnvelopeInt16`. Tables of
    all streams follow one another in flat arrays. ``shapes`` (stream, 3), always in the memory of the host: numbers of
    points, of terms of each point, and of pairs of each direction. ``recipe``: number of power sums, order of the
    product, streams of b and s (−1 for no coherence factor), and the limit of the stream of s relative to its unit.
    """

    def __call__(
        self,
        tiles: Short,
        scales: Real,
        starts: Index,
        stop: int,
        shapes: Index,
        offsets: Index,
        weights: Short,
        places: Index,
        tap_weights: Short,
        rows: Index,
        recipe: tuple[int, int, int, int, float],
        out: Real,
    ) -> None: ...

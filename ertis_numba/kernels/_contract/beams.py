"""From analytic signals to envelopes of delay-and-sum."""

from typing import Protocol

import numpy as np

from ertis_numba.kernels._contract.arrays import Complex, Index, Real, Short

__all__ = [
    "DelayAndSum",
    "DelayAndSumEnvelope",
    "DelayAndSumEnvelopeInt16",
    "Envelope",
    "InterpolatedBeamsEnvelope",
    "InterpolatedBeamsEnvelopeInt16",
    "QuantiseTiles",
]


class DelayAndSum(Protocol):
    """Sum the delayed and weighted signals of all microphones for every direction and range.

    ``out[direction, range] = Σ_mic weights[direction, mic] · signals.flat[offsets[direction, mic] + range]``.
    The offset names microphone, phase and first sample at once; the weight corrects the carrier's
    phase for what the rounding of the delay left over.

    Parameters
    ----------
    signals : (mic, phase, sample) complex64
    offsets : (direction, mic) int32
    weights : (direction, mic) complex64
    out : (direction, range) complex64
    """

    def __call__(self, signals: Complex, offsets: Index, weights: Complex, out: Complex) -> None: ...


class Envelope(Protocol):
    """Take the magnitude of analytic beams.

    Parameters
    ----------
    beams : (direction, range) complex64
    out : (direction, range) float32
    """

    def __call__(self, beams: Complex, out: Real) -> None: ...


class DelayAndSumEnvelope(Protocol):
    """`DelayAndSum` and `Envelope` in one pass over some ranges, so that no beam is written to memory.

    ``out[direction, range] = |Σ_term weights[direction, term] · signals.flat[offsets[direction, term] + range]|``.
    A term is one sample of one microphone: where delays are interpolated, each microphone has several.

    Parameters
    ----------
    signals : (mic, phase, sample) complex64
    offsets : (direction, term) int32
    weights : (direction, term) complex64
    first, stop : int
        Ranges to fill.
    out : (direction, range) float32
    """

    def __call__(
        self, signals: Complex, offsets: Index, weights: Complex, first: int, stop: int, out: Real
    ) -> None: ...


class InterpolatedBeamsEnvelope(Protocol):
    """Beams of few nodes, from those the beams of all directions, and their envelopes.

    ``nodes[node, range] = Σ_term weights[node, term] · signals.flat[offsets[node, term] + range]`` and
    ``out[rows[direction], range] = |Σ_pair,k tap_weights[direction, pair, k] · node|`` with the node
    ``nodes[places[direction, pair] + k, range]``, for k = 0 and 1.

    Parameters
    ----------
    signals : (mic, phase, sample) complex64
    offsets : (node, term) int32
    weights : (node, term) complex64
    places : (direction, pair) int32
        The lower node of each pair.
    tap_weights : (direction, pair, 2) float32
    rows : (direction,) int32
        Where each direction belongs in ``out``: those that share nodes should follow each other here.
    first, stop : int
        Ranges to fill.
    n_blocks : int
        Into how many parts directions are cut, where there are more threads than tiles of ranges.
    out : (direction, range) float32
        At least 64 ranges, which is how far signals are read.
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
    """Cut analytic signals into tiles of ranges and store each in 16 bits under its own scale.

    ``tiles[tile, mic, phase, k] ≈ signals[mic, phase, starts[tile] + k] / scales[tile]``, rounded, as pairs of
    real and imaginary part; the largest magnitude of a tile becomes ``limit``. Past the end of the signals
    tiles are 0. A tile spans decimetres, so an echo keeps its 16 bits however much stronger the
    reflectors at other ranges are.

    Parameters
    ----------
    signals : (mic, phase, sample) complex64
    starts : (tile,) int32
    limit : float32
    tiles : (tile, mic, phase, k, 2) int16
    scales : (tile,) float32
    """

    def __call__(self, signals: Complex, starts: Index, limit: np.float32, tiles: Short, scales: Real) -> None: ...


class DelayAndSumEnvelopeInt16(Protocol):
    """`DelayAndSumEnvelope` on the tiles of `QuantiseTiles`, with integer sums.

    ``out[direction, starts[tile] + k] = scales[tile] · weight_scale · |Σ_term w · x|`` with
    ``x = tiles[tile].flat[offsets[direction, term] + k]``, for k below the device's ``tile_ranges``.

    Parameters
    ----------
    tiles, scales, starts
        As in `QuantiseTiles`, ``tile_ranges`` apart.
    stop : int
        Ranges from here on are not written.
    offsets : (direction, term) int32
        Into one tile, in complex samples.
    weights : (direction, term, 2, 2) int16
        ``((re w, −im w), (im w, re w))``.
    weight_scale : float32
        Worth of a weight of 1.
    out : (direction, range) float32
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
    """`InterpolatedBeamsEnvelope` on the tiles of `QuantiseTiles`, with integer sums.

    Of the sums that are beams of nodes the upper 16 bits are kept, rounded: ``(sum + 2¹⁵) >> 16``.

    Parameters
    ----------
    tiles, scales, starts, stop
        As in `DelayAndSumEnvelopeInt16`.
    offsets : (node, term) int32
    weights : (node, term, 2, 2) int16
        As there, of nodes.
    places : (direction, pair) int32
    tap_weights : (direction, pair, 2) int16
    rows : (direction,) int32
    weight_scale : float32
        Worth of 1 in the sums over nodes, in units of the tile's scale.
    n_blocks : int
    out : (direction, range) float32
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

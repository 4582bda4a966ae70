"""What every kernel does, whatever device it runs on: the one docstring of each.

Arrays come first, then numbers, then ``out``, which the kernel fills. Nothing is returned and nothing
is checked: shapes and bounds are the business of the stages, which know them when they are made.
Arrays are C-contiguous. Axes are named in this order: mic, phase, sample; direction, range.
"""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "AddPaths",
    "CombineCapon",
    "CombineCoherence",
    "CombineDmas",
    "Complex",
    "Decimate",
    "DelayAndSum",
    "DelayAndSumEnvelope",
    "DelayAndSumEnvelopeInt16",
    "DemodulateWords",
    "Envelope",
    "Index",
    "InterpolatedBeamsEnvelope",
    "InterpolatedBeamsEnvelopeInt16",
    "ModulatePdm",
    "MultiplyAndFold",
    "MultiplySpectra",
    "QuantiseTiles",
    "Real",
    "RemoveGroupDelay",
    "Short",
    "Taps",
    "UnpackBits",
    "Words",
]

Words = NDArray[np.unsignedinteger[Any]]
Real = NDArray[np.float32]
Complex = NDArray[np.complex64]
Index = NDArray[np.int32]
Short = NDArray[np.int16]
Taps = NDArray[np.int16] | NDArray[np.int32]


class UnpackBits(Protocol):
    """Turn the bits of PDM words into signals of +1 and −1.

    Parameters
    ----------
    words : (sample, word) uint8, uint16, uint32 or uint64
        Channel m is bit ``m % word_bits`` (least significant first) of word ``m // word_bits``.
    channels : (mic,) int32
        Channel of each microphone.
    out : (mic, sample) float32
    """

    def __call__(self, words: Words, channels: Index, out: Real) -> None: ...


class Decimate(Protocol):
    """Filter signals and keep every ``factor``-th sample.

    ``out[mic, n] = Σ_t taps[t] · signals[mic, n · factor + t − (n_taps − 1)]``; samples before the
    first are 0. The result is late by the group delay of the taps, ``(n_taps − 1) / 2`` input samples.

    Parameters
    ----------
    signals : (mic, sample) float32
    taps : (tap,) float32
        Symmetric.
    factor : int
    out : (mic, n) float32
    """

    def __call__(self, signals: Real, taps: Real, factor: int, out: Real) -> None: ...


class RemoveGroupDelay(Protocol):
    """Move signals ahead in time: ``out[mic, n] = signals[mic, n + delay]``, 0 past the end.

    Parameters
    ----------
    signals : (mic, sample) float32
    delay : int
        In samples, at least 0.
    out : (mic, n) float32
    """

    def __call__(self, signals: Real, delay: int, out: Real) -> None: ...


class DemodulateWords(Protocol):
    """Unpack, decimate and remove the group delay in one pass over the words.

    ``out[mic, n] = scale · Σ_t taps[t] · x[mic, (first + n) · factor + t − (n_taps − 1) / 2]`` with x = ±1
    from the bits, 0 outside the record. Samples of ``out`` past ``n_outputs`` are set to 0. The sum is one of
    integers, so every device gives the same bits.

    Parameters
    ----------
    words, channels
        As in `UnpackBits`.
    taps : (tap,) int16 or int32
        Symmetric, an odd number; their magnitudes add up to the largest number of their type at most.
    scale : float32
    factor, first, n_outputs : int
    out : (mic, sample) float32
    """

    def __call__(
        self,
        words: Words,
        channels: Index,
        taps: Taps,
        scale: np.float32,
        factor: int,
        first: int,
        n_outputs: int,
        out: Real,
    ) -> None: ...


class MultiplySpectra(Protocol):
    """Multiply the spectrum of each microphone by a filter: ``out[mic, bin] = spectra · response``.

    Parameters
    ----------
    spectra : (mic, bin) complex64
    response : (bin,) complex64
    out : (mic, bin) complex64
    """

    def __call__(self, spectra: Complex, response: Complex, out: Complex) -> None: ...


class MultiplyAndFold(Protocol):
    """Multiply spectra by one filter per phase and fold each product to the length of ``out``.

    ``out[mic, phase, k] = Σ spectra[mic, first_bin + b] · responses[mic, phase, b]`` over all b with
    ``(first_bin + b) mod n_out = k``. An inverse transform of ``n_out`` points then samples the
    filtered signal at the output rate, once per phase: the polyphase form of one long transform.

    Parameters
    ----------
    spectra : (mic, bin) complex64
    responses : (mic, phase, b) or (1, phase, b) complex64
        Each microphone's own, or one for all.
    first_bin : int
    out : (mic, phase, k) complex64
    """

    def __call__(self, spectra: Complex, responses: Complex, first_bin: int, out: Complex) -> None: ...


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


class AddPaths(Protocol):
    """Add delayed and filtered copies of a call to the spectrum of each microphone.

    ``out[mic, k] += Σ_path a · call[k] · exp(-2πi turns[path, mic] (first_bin + k))``, with ``a`` interpolated
    straight between the nodes of ``amplitude[path, mic]``, the first of which lies at bin 0.

    Parameters
    ----------
    call : (1, bin) or (mic, bin) complex128
        One for all microphones, or one each.
    turns : (path, mic) float64
        Delay in turns per bin: seconds times the spacing of the bins in hertz.
    amplitude : (path, mic, node) float64
    first_bin : int
    nodes_per_bin : float
        Spacing of the bins by that of the nodes. Beyond the last node its amplitude holds.
    out : (mic, bin) complex128
    """

    def __call__(
        self,
        call: NDArray[np.complex128],
        turns: NDArray[np.float64],
        amplitude: NDArray[np.float64],
        first_bin: int,
        nodes_per_bin: float,
        out: NDArray[np.complex128],
    ) -> None: ...


class ModulatePdm(Protocol):
    """Modulate a block of signals with a loop of up to four integrators, and pack the bits into PDM words.

    Per sample, with the quantiser's output v = ±1 and the error d = u − v::

        u  = signal + noise, rounded to a multiple of 2⁻²⁰ (of two as near, to the even one)
        v  = sign(u + dither + s1 + s2 + s3 + s4)
        s1 += c1 d − r1 s2,  s2 += c2 s1,  s3 += c3 s2 − r2 s4,  s4 += c4 s3

    Every integrator stops at ±limit, which is what lets the loop return from overload. The grid hides the last
    digits of the signals, in which processors differ, under −131 dB of noise.

    Noise and dither come from one hash, SplitMix64 of key and sample number: its upper 16 bits k make the
    dither, ``width · ((k + ½) / 2¹⁶ − ½)``, and the four fields of 12 bits below make the noise, their sum less its
    mean of 8190 and over its rms, ``√((2²⁴ − 1) / 3)``: nearly Gaussian, and never beyond 3.5 times its rms.

    Parameters
    ----------
    signals : (mic, sample) float64
        Full scale 1; finite, and below 2³¹. At least as long as ``out``; what is over is not used.
    mics : (octet, 8) int32
        Row of ``signals`` that each bit of the words follows, least significant first; −1 for a bit that stays 0.
        No row may stand in two places.
    keys : (mic,) uint64
        Seed of each microphone's noise and dither.
    noise_rms : (mic,) float64
        Full scale 1. Where all are 0, noise costs nothing.
    states : (mic, 4) float64
        The integrators s1 to s4, carried from block to block.
    loop : (8,) float64
        c1, c2, c3, c4, r1, r2, the width of the dither and the limit.
    first : int
        Number of the block's first sample.
    out : (sample, octet) uint8
        The bytes of little-endian PDM words; a bit is 1 where v is +1.
    """

    def __call__(
        self,
        signals: NDArray[np.float64],
        mics: Index,
        keys: NDArray[np.uint64],
        noise_rms: NDArray[np.float64],
        states: NDArray[np.float64],
        loop: NDArray[np.float64],
        first: int,
        out: NDArray[np.uint8],
    ) -> None: ...

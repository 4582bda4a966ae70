"""Contracts of the front end: raw samples to analytic signals, or to beams by phase shifts of spectra."""

from typing import Protocol

import numpy as np

from ertis_numba.kernels._contract.arrays import Complex, Index, Pcm, Real, Taps, Turns, Words

__all__ = [
    "Decimate",
    "DemodulateWords",
    "EnvelopeRows",
    "MultiplyAndFold",
    "MultiplySpectra",
    "RemoveGroupDelay",
    "SumSpectra",
    "UnpackBits",
    "UnpackPcm",
]


class UnpackBits(Protocol):
    """Convert the bits of PDM words to signals of +1 and −1: (mic, sample).

    Channel m is bit ``m % word_bits`` (least significant first) of word ``m // word_bits``.
    """

    def __call__(self, words: Words, channels: Index, out: Real) -> None: ...


class UnpackPcm(Protocol):
    """Convert PCM samples to signals: ``out[mic, n] = scale · words[first + n, channels[mic]]``, 0 elsewhere.

    ``first`` may be negative. Samples with a magnitude below ``silence`` become 0 first, because arithmetic with
    denormal numbers is slow.
    """

    def __call__(
        self, words: Pcm, channels: Index, scale: np.float32, silence: np.float32, first: int, out: Real
    ) -> None: ...


class Decimate(Protocol):
    """Filter signals with symmetric taps and keep every ``factor``-th sample.

    ``out[mic, n] = Σ_t taps[t] · signals[mic, n · factor + t − (n_taps − 1)]``; samples before the first are 0. The
    result is delayed by the group delay of the taps, ``(n_taps − 1) / 2`` input samples.
    """

    def __call__(self, signals: Real, taps: Real, factor: int, out: Real) -> None: ...


class RemoveGroupDelay(Protocol):
    """Advance signals in time: ``out[mic, n] = signals[mic, n + delay]``, 0 beyond the end."""

    def __call__(self, signals: Real, delay: int, out: Real) -> None: ...


class DemodulateWords(Protocol):
    """Unpack, decimate and remove the group delay in one pass over the words.

    ``out[mic, n] = scale · Σ_t taps[t] · x[mic, (first + n) · factor + t − (n_taps − 1) / 2]``. Here x is ±1 from the
    bits, and 0 outside the record. Samples of ``out`` beyond ``n_outputs`` are set to 0. The sum is over integers, so
    every device yields the same bits. The odd number of taps is symmetric, and the sum of their magnitudes fits their
    type.
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

    Further bins of ``out`` become 0. If these are the negative frequencies, the inverse transform is analytic.
    """

    def __call__(self, spectra: Complex, response: Complex, out: Complex) -> None: ...


class MultiplyAndFold(Protocol):
    """Multiply spectra by one filter per phase and fold each product to the length of ``out``.

    ``out[mic, phase, k] = Σ spectra[mic, first_bin + b] · responses[mic, phase, b]`` over all b with
    ``(first_bin + b) mod n_out = k``. An inverse transform of ``n_out`` points then samples the filtered signal at the
    output rate, once per phase: the polyphase form of one long transform. ``responses`` (1, phase, b) serve all.
    """

    def __call__(self, spectra: Complex, responses: Complex, first_bin: int, out: Complex) -> None: ...


class SumSpectra(Protocol):
    """Delay spectra by phase shifts, and sum them over the microphones: one matrix-vector product per bin.

    ``out[direction, 0, (first_bin + b) mod n_out] = Σ_mic spectra[mic, 0, (first_bin + b) mod n_in] · exp(2πi φ)`` with
    ``φ = (starts[direction, mic] + b · steps[direction, mic]) / 2³²``, for b below ``n_bins``. Bins that share a place
    of ``out`` are added, and places without a bin become 0. Integer phases wrap around, as turns do. n_in is n_out or a
    multiple, and at least ``n_bins``; places of ``spectra`` without a bin hold 0.
    """

    def __call__(
        self, spectra: Complex, starts: Turns, steps: Turns, first_bin: int, n_bins: int, out: Complex
    ) -> None: ...


class EnvelopeRows(Protocol):
    """Compute the magnitude of successive samples: ``out[row, range] = |beams[row, 0, lead + range]|``."""

    def __call__(self, beams: Complex, lead: int, first: int, stop: int, out: Real) -> None: ...

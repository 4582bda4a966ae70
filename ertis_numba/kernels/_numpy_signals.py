"""Kernels of signals in plain NumPy: unpacking, decimation, spectra and envelopes."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract import Complex, Index, Pcm, Real, Taps, Turns, Words

__all__ = [
    "decimate",
    "demodulate_words",
    "envelope_rows",
    "multiply_and_fold",
    "multiply_spectra",
    "remove_group_delay",
    "sum_spectra",
    "unpack_bits",
    "unpack_pcm",
]

Number = TypeVar("Number", np.float32, np.float64)

_MICS = 4  # microphones demodulated at a time, because their undecimated signals need much memory


def unpack_bits(words: Words, channels: Index, out: Real) -> None:
    """Convert the bits of PDM words to signals of +1 and −1."""
    octets = words.view(np.uint8).reshape(len(words), words.shape[1] * words.itemsize)
    for signal, channel in zip(out, channels, strict=True):
        signal[:] = octets[:, channel // 8] >> np.uint8(channel % 8) & np.uint8(1)
    out *= np.float32(2)
    out -= np.float32(1)


def unpack_pcm(words: Pcm, channels: Index, scale: np.float32, silence: np.float32, first: int, out: Real) -> None:
    """Convert PCM samples to signals: ``out[mic, n] = scale · words[first + n, channels[mic]]``, 0 elsewhere."""
    start, stop = max(first, 0), min(first + out.shape[1], len(words))
    out[:] = 0
    if start < stop:
        heard = words[start:stop, channels].T.astype(np.float32)
        heard[np.abs(heard) < silence] = 0
        np.multiply(heard, scale, out=out[:, start - first : stop - first])


def decimate(signals: Real, taps: Real, factor: int, out: Real) -> None:
    """Filter signals and keep every ``factor``-th sample."""
    out[:] = _filtered(signals, taps, factor, 1 - len(taps), out.shape[1])


def remove_group_delay(signals: Real, delay: int, out: Real) -> None:
    """Advance signals in time: ``out[mic, n] = signals[mic, n + delay]``, 0 beyond the end."""
    moved = signals[:, delay : delay + out.shape[1]]
    out[:, : moved.shape[1]] = moved
    out[:, moved.shape[1] :] = 0


def demodulate_words(
    words: Words,
    channels: Index,
    taps: Taps,
    scale: np.float32,
    factor: int,
    first: int,
    n_outputs: int,
    out: Real,
) -> None:
    """Unpack, decimate and remove the group delay in one pass over the words."""
    half = len(taps) // 2
    start = max(first * factor - half, 0)
    stop = min((first + n_outputs - 1) * factor + half + 1, len(words))
    begin = first * factor - half - start
    # Sums of integers below 2^24 are exact in float32 in any order; 32-bit taps need float64.
    exact = taps.astype(np.float32 if taps.dtype == np.int16 else np.float64)
    for mic in range(0, len(channels), _MICS):
        few = channels[mic : mic + _MICS]
        signals = np.empty((len(few), max(stop - start, 0)), dtype=np.float32)
        unpack_bits(words[start : start + signals.shape[1]], few, signals)
        out[mic : mic + _MICS, :n_outputs] = _filtered(
            signals.astype(exact.dtype, copy=False), exact, factor, begin, n_outputs
        )
    out *= scale
    out[:, n_outputs:] = 0


def _filtered(
    signals: NDArray[Number], taps: NDArray[Number], factor: int, start: int, n_outputs: int
) -> NDArray[Number]:
    """Return filtered and decimated signals; the first tap of output 0 is at sample ``start``. Other samples are 0."""
    needed = (n_outputs - 1) * factor + len(taps)
    padded = np.zeros((len(signals), needed + factor), dtype=signals.dtype)
    source = signals[:, max(start, 0) : max(start + needed, 0)]
    padded[:, max(-start, 0) :][:, : source.shape[1]] = source
    # The taps are split into blocks of ``factor``: n_taps / factor matrix products over views of the signal.
    total = np.zeros((len(signals), n_outputs), dtype=signals.dtype)
    for tap in range(0, len(taps), factor):
        part = taps[tap : tap + factor]
        blocks = padded[:, tap : tap + n_outputs * factor]
        if blocks.shape[1] < n_outputs * factor:
            blocks = np.pad(blocks, ((0, 0), (0, n_outputs * factor - blocks.shape[1])))
        with np.errstate(invalid="ignore"):  # BLAS may set the flag for lanes that it discards; the results are finite
            total += blocks.reshape(len(signals), n_outputs, factor)[:, :, : len(part)] @ part
    return total


def multiply_spectra(spectra: Complex, response: Complex, out: Complex) -> None:
    """Multiply the spectrum of each microphone by a filter: ``out[mic, bin] = spectra · response``."""
    n_bins = spectra.shape[1]
    np.multiply(spectra, response, out=out[:, :n_bins])
    out[:, n_bins:] = 0


def multiply_and_fold(spectra: Complex, responses: Complex, first_bin: int, out: Complex) -> None:
    """Multiply spectra by one filter per phase and fold each product to the length of ``out``."""
    n_bins, n_out = responses.shape[2], out.shape[2]
    out[:] = 0
    done = 0
    while done < n_bins:
        place = (first_bin + done) % n_out
        run = min(n_bins - done, n_out - place)
        part = spectra[:, None, first_bin + done : first_bin + done + run]
        out[:, :, place : place + run] += part * responses[:, :, done : done + run]
        done += run


def sum_spectra(spectra: Complex, starts: Turns, steps: Turns, first_bin: int, n_bins: int, out: Complex) -> None:
    """Delay spectra by phase shifts, and sum them over the microphones: one matrix-vector product per bin."""
    bins = np.arange(n_bins, dtype=np.uint32)
    heard = spectra[:, 0, (first_bin + np.arange(n_bins)) % spectra.shape[2]]
    places = (first_bin + np.arange(n_bins)) % out.shape[2]
    out[:] = 0
    for direction, (start, step) in enumerate(zip(starts, steps, strict=True)):
        turns = (start[:, None] + step[:, None] * bins).view(np.int32)
        shifts = np.exp(np.float32(2 * np.pi / 2**32) * turns * np.complex64(1j))
        np.add.at(out[direction, 0], places, np.einsum("mb,mb->b", heard, shifts))


def envelope_rows(beams: Complex, lead: int, first: int, stop: int, out: Real) -> None:
    """Compute the magnitude of successive samples: ``out[row, range] = |beams[row, 0, lead + range]|``."""
    np.abs(beams[: len(out), 0, lead + first : lead + stop], out=out[:, first:stop])

"""The kernels in plain NumPy: what the compiled ones are compared with in speed."""

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.kernels._contract import Complex, Index, KernelSet, Real, Short, Words

__all__ = ["KERNELS"]

_TILE_RANGES = 96  # as many as the compiled kernel has with AVX-512
_NOISE_UNIT = 1 / math.sqrt((2.0**24 - 1) / 3)  # 1 / rms of a sum of four numbers from 0 to 4095


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """See `Threads`."""
    checks.whole("threads", count, 1, 1)
    yield


def unpack_bits(words: Words, channels: Index, out: Real) -> None:
    """See `UnpackBits`."""
    octets = words.view(np.uint8).reshape(len(words), words.shape[1] * words.itemsize)
    out[:] = np.unpackbits(octets, axis=1, bitorder="little")[:, channels].T
    out *= np.float32(2)
    out -= np.float32(1)


def decimate(signals: Real, taps: Real, factor: int, out: Real) -> None:
    """See `Decimate`."""
    out[:] = _filtered(signals, taps, factor, 1 - len(taps), out.shape[1])


def remove_group_delay(signals: Real, delay: int, out: Real) -> None:
    """See `RemoveGroupDelay`."""
    moved = signals[:, delay : delay + out.shape[1]]
    out[:, : moved.shape[1]] = moved
    out[:, moved.shape[1] :] = 0


def demodulate_words(
    words: Words,
    channels: Index,
    taps: Short,
    scale: np.float32,
    factor: int,
    first: int,
    n_outputs: int,
    out: Real,
) -> None:
    """See `DemodulateWords`."""
    half = len(taps) // 2
    start = max(first * factor - half, 0)
    stop = min((first + n_outputs - 1) * factor + half + 1, len(words))
    signals = np.empty((len(channels), max(stop - start, 0)), dtype=np.float32)
    unpack_bits(words[start : start + signals.shape[1]], channels, signals)
    # Sums of whole numbers below 2^24 are exact in float32, in whatever order.
    out[:, :n_outputs] = _filtered(signals, taps.astype(np.float32), factor, first * factor - half - start, n_outputs)
    out *= scale
    out[:, n_outputs:] = 0


def _filtered(signals: Real, taps: Real, factor: int, start: int, n_outputs: int) -> NDArray[np.float32]:
    """Filter with the first tap of output 0 at sample ``start``; samples outside the signals are 0."""
    needed = (n_outputs - 1) * factor + len(taps)
    padded = np.zeros((len(signals), needed + factor), dtype=np.float32)
    source = signals[:, max(start, 0) : max(start + needed, 0)]
    padded[:, max(-start, 0) :][:, : source.shape[1]] = source
    # The taps cut into rows of one output each: n_taps / factor matrix products over views of the signal.
    total = np.zeros((len(signals), n_outputs), dtype=np.float32)
    for tap in range(0, len(taps), factor):
        part = taps[tap : tap + factor]
        blocks = padded[:, tap : tap + n_outputs * factor]
        if blocks.shape[1] < n_outputs * factor:
            blocks = np.pad(blocks, ((0, 0), (0, n_outputs * factor - blocks.shape[1])))
        total += blocks.reshape(len(signals), n_outputs, factor)[:, :, : len(part)] @ part
    return total


def multiply_spectra(spectra: Complex, response: Complex, out: Complex) -> None:
    """See `MultiplySpectra`."""
    np.multiply(spectra, response, out=out)


def multiply_and_fold(spectra: Complex, responses: Complex, first_bin: int, out: Complex) -> None:
    """See `MultiplyAndFold`."""
    n_bins, n_out = responses.shape[1], out.shape[2]
    out[:] = 0
    done = 0
    while done < n_bins:
        place = (first_bin + done) % n_out
        run = min(n_bins - done, n_out - place)
        part = spectra[:, None, first_bin + done : first_bin + done + run]
        out[:, :, place : place + run] += part * responses[:, done : done + run]
        done += run


def delay_and_sum(signals: Complex, offsets: Index, weights: Complex, out: Complex) -> None:
    """See `DelayAndSum`."""
    flat = signals.reshape(-1)
    n_ranges = out.shape[1]
    for direction in range(len(out)):
        # One gathered (mic, range) block and one matrix product beat a loop over microphones by about 2.
        rows = np.lib.stride_tricks.sliding_window_view(flat, n_ranges)[offsets[direction]]
        np.matmul(weights[direction], rows, out=out[direction])


def envelope(beams: Complex, out: Real) -> None:
    """See `Envelope`."""
    np.abs(beams, out=out)


def delay_and_sum_envelope(signals: Complex, offsets: Index, weights: Complex, out: Real) -> None:
    """See `DelayAndSumEnvelope`."""
    beams: NDArray[Any] = np.empty(out.shape, dtype=np.complex64)
    delay_and_sum(signals, offsets, weights, beams)
    envelope(beams, out)


def quantise_tiles(signals: Complex, starts: Index, limit: np.float32, tiles: Short, scales: Real) -> None:
    """See `QuantiseTiles`."""
    tiles[:] = 0
    for tile, start in enumerate(starts):
        part = np.ascontiguousarray(signals[:, :, start : start + tiles.shape[3]])
        parts = part.view(np.float32).reshape(*part.shape, 2)
        largest = np.max(np.abs(parts), initial=0)
        scales[tile] = largest / limit
        if largest:
            tiles[tile, :, :, : part.shape[2]] = np.rint(parts * (limit / largest))


def delay_and_sum_envelope_int16(
    tiles: Short, scales: Real, starts: Index, offsets: Index, weights: Short, weight_scale: np.float32, out: Real
) -> None:
    """See `DelayAndSumEnvelopeInt16`."""
    for tile, start in enumerate(starts):
        n_ranges = min(_TILE_RANGES, out.shape[1] - start)
        flat = tiles[tile].reshape(-1, 2).astype(np.int32)
        for direction, places in enumerate(offsets):
            samples = flat[places[:, None] + np.arange(n_ranges)]  # (mic, range, 2)
            real, imag = np.einsum("mrc,mpc->pr", samples, weights[direction].astype(np.int32)).astype(np.float32)
            level = np.sqrt(real * real + imag * imag)
            out[direction, start : start + n_ranges] = level * (scales[tile] * weight_scale)


def add_paths(
    call: NDArray[np.complex128],
    turns: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    first_bin: int,
    nodes_per_bin: float,
    out: NDArray[np.complex128],
) -> None:
    """See `AddPaths`."""
    bins = first_bin + np.arange(out.shape[1])
    nodes = np.arange(amplitude.shape[2])
    for path in range(len(turns)):
        for mic in range(len(out)):
            gain = np.interp(bins * nodes_per_bin, nodes, amplitude[path, mic])
            turned = np.exp(-2j * np.pi * ((turns[path, mic] * bins) % 1.0))
            out[mic] += gain * call[mic if len(call) > 1 else 0] * turned


def modulate_pdm(
    signals: NDArray[np.float64],
    mics: Index,
    keys: NDArray[np.uint64],
    noise_rms: NDArray[np.float64],
    states: NDArray[np.float64],
    loop: NDArray[np.float64],
    first: int,
    out: NDArray[np.uint8],
) -> None:
    """See `ModulatePdm`; microphones side by side, samples one after the other."""
    c1, c2, c3, c4, r1, r2, width, limit = loop
    signals = signals[:, : len(out)]
    noise, dither = _noise_and_dither(keys, first, signals.shape[1])
    grid = 2.0**-20
    followed = np.rint((signals + noise_rms[:, None] * _NOISE_UNIT * noise) / grid) * grid
    followed_dithered = followed + width * dither
    s1, s2, s3, s4 = states.T.copy()
    above = np.zeros((len(signals) + 1, signals.shape[1]), dtype=np.bool_)  # the last row is that of no microphone
    for sample, u in enumerate(followed.T):
        bits = followed_dithered[:, sample] + ((s1 + s2) + (s3 + s4)) >= 0
        above[:-1, sample] = bits
        d = u - np.where(bits, 1.0, -1.0)
        s1 = np.clip(s1 + (c1 * d - r1 * s2), -limit, limit)
        s2 = np.clip(s2 + c2 * s1, -limit, limit)
        s3 = np.clip(s3 + (c3 * s2 - r2 * s4), -limit, limit)
        s4 = np.clip(s4 + c4 * s3, -limit, limit)
    states[:] = np.stack([s1, s2, s3, s4], axis=1)
    out[:] = np.packbits(above[mics], axis=1, bitorder="little")[:, 0].T


def _noise_and_dither(
    keys: NDArray[np.uint64], first: int, n_samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sums of 12-bit fields about 0, and numbers within ±½, from SplitMix64: both (mic, sample) float64."""
    z = keys[:, None] + np.arange(first, first + n_samples, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    fields = [(z >> np.uint64(shift)) & np.uint64(0xFFF) for shift in (0, 12, 24, 36)]
    noise = np.sum(fields, axis=0).astype(np.float64) - 8190.0
    dither = ((z >> np.uint64(48)).astype(np.float64) + 0.5) / 2.0**16 - 0.5
    return noise, dither


KERNELS = KernelSet(
    device="numpy",
    max_threads=1,
    tile_ranges=_TILE_RANGES,
    fastest_precision="float32",
    threads=threads,
    unpack_bits=unpack_bits,
    decimate=decimate,
    remove_group_delay=remove_group_delay,
    demodulate_words=demodulate_words,
    multiply_spectra=multiply_spectra,
    multiply_and_fold=multiply_and_fold,
    delay_and_sum=delay_and_sum,
    envelope=envelope,
    delay_and_sum_envelope=delay_and_sum_envelope,
    quantise_tiles=quantise_tiles,
    delay_and_sum_envelope_int16=delay_and_sum_envelope_int16,
    add_paths=add_paths,
    modulate_pdm=modulate_pdm,
)

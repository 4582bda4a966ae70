"""Kernels in plain NumPy, as a reference for the speed of the compiled kernels."""

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.kernels import _numpy_passive, _numpy_signals
from ertis_numba.kernels._contract import Complex, ComplexOrDouble, Index, Real, Short
from ertis_numba.kernels._host import HostMemory
from ertis_numba.kernels._kernel_set import KernelSet

__all__ = ["KERNELS"]


_TILE_RANGES = 96  # as in the compiled kernels
_NOISE_UNIT = 1 / math.sqrt((2.0**24 - 1) / 3)  # 1 / RMS of a sum of four integers from 0 to 4095, without its mean


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Run the enclosed kernels of this Python thread on ``count`` threads."""
    checks.integer("threads", count, 1, 1)
    yield


def combine_delayed(
    signals: Real,
    roots: Real,
    delays: Index,
    order: int,
    coherent: int,
    first: int,
    out: Real,
) -> None:
    """Combine the delayed real signals of all microphones for every direction and sample."""
    mics = np.arange(len(signals))[:, None]
    for direction, delay in enumerate(delays):
        places = first + delay[:, None] + np.arange(out.shape[1])
        delayed = signals[mics, places].astype(np.float64)
        if order == 1:
            combined = delayed.sum(axis=0)
        else:
            sums = np.zeros((order + 1, out.shape[1]))
            sums[0] = 1
            for root in roots[mics, places].astype(np.float64):
                for k in range(order, 0, -1):
                    sums[k] += sums[k - 1] * root
            combined = sums[order]
        if coherent:
            total = len(signals) * (delayed**2).sum(axis=0)
            agreement = delayed.sum(axis=0) ** 2
            combined *= np.divide(agreement, total, out=np.zeros_like(agreement), where=total != 0)
        out[direction] = combined


def sum_delayed_int16(tiles: Short, units: Real, delays: Index, out: Real) -> None:
    """Sum the delayed 16-bit signals of all microphones for every direction and sample."""
    mics, size = np.arange(tiles.shape[1])[:, None], out.shape[1] // len(tiles)
    for direction, delay in enumerate(delays):
        delayed = tiles[:, mics, delay[:, None] + np.arange(size)]
        out[direction] = (units[:, None] * delayed.sum(axis=1)).reshape(-1)


def rectify_and_decimate(beams: Real, taps: Short, scale: float, factor: int, first: int, out: Real) -> None:
    """Rectify real beams, filter them, and keep every factor-th sample."""
    windows = np.lib.stride_tricks.sliding_window_view(np.abs(beams[:, first:]), len(taps), axis=1)
    out[:] = scale * (windows[: len(out), : (out.shape[1] - 1) * factor + 1 : factor] @ taps.astype(np.float64))


def delay_and_sum(signals: Complex, offsets: Index, weights: Complex, out: Complex) -> None:
    """Sum the delayed and weighted signals of all microphones for every direction and range."""
    flat = signals.reshape(-1)
    n_ranges = out.shape[1]
    for direction in range(len(out)):
        # One gathered (mic, range) block and one matrix product are about twice as fast as a loop over microphones.
        rows = np.lib.stride_tricks.sliding_window_view(flat, n_ranges)[offsets[direction]]
        np.matmul(weights[direction], rows, out=out[direction])


def envelope(beams: Complex, step: int, out: Real) -> None:
    """Compute the magnitude of every ``step``-th sample of analytic beams."""
    np.abs(beams[:, : (out.shape[1] - 1) * step + 1 : step], out=out)


def delay_and_sum_envelope(
    signals: Complex, offsets: Index, weights: Complex, first: int, stop: int, out: Real
) -> None:
    """`DelayAndSum` and `Envelope` in one pass over some ranges, without writing beams to memory."""
    beams: NDArray[Any] = np.empty((len(out), stop - first), dtype=np.complex64)
    delay_and_sum(signals, offsets + np.int32(first), weights, beams)
    envelope(beams, 1, out[:, first:stop])


def interpolated_beams_envelope(
    signals: Complex,
    offsets: Index,
    weights: Complex,
    places: Index,
    tap_weights: Real,
    rows: Index,
    first: int,
    stop: int,
    n_blocks: int,  # noqa: ARG001
    out: Real,
) -> None:
    """Compute beams on a coarse beam grid, interpolate the beams of all directions, and take their envelopes."""
    nodes: NDArray[Any] = np.empty((len(offsets), stop - first), dtype=np.complex64)
    delay_and_sum(signals, offsets + np.int32(first), weights, nodes)
    # The weights are real, so a matrix product of floats takes half of the operations.
    for direction, pairs in enumerate(places):
        near = np.stack([pairs, pairs + 1], axis=1).reshape(-1)
        beam = tap_weights[direction].reshape(-1) @ nodes[near].view(np.float32)
        np.abs(beam.view(np.complex64), out=out[rows[direction], first:stop])


def quantise_tiles(signals: Complex, starts: Index, limit: np.float32, tiles: Short, scales: Real) -> None:
    """Split analytic signals into tiles of ranges, and store each in 16 bits with its own scale."""
    tiles[:] = 0
    for tile, start in enumerate(starts):
        part = np.ascontiguousarray(signals[:, :, start : start + tiles.shape[3]])
        parts = part.view(np.float32).reshape(*part.shape, 2)
        largest = np.sqrt(np.max(np.sum(np.square(parts), axis=-1), initial=0))
        scales[tile] = largest / limit
        if largest:
            tiles[tile, :, :, : part.shape[2]] = np.rint(parts * (limit / largest))


def delay_and_sum_envelope_int16(
    tiles: Short,
    scales: Real,
    starts: Index,
    stop: int,
    offsets: Index,
    weights: Short,
    weight_scale: np.float32,
    out: Real,
) -> None:
    """`DelayAndSumEnvelope` on the tiles of `QuantiseTiles`, with integer sums."""
    for tile, start in enumerate(starts):
        n_ranges = min(_TILE_RANGES, stop - start)
        for direction in range(len(offsets)):
            parts = _whole_beam(tiles[tile], offsets[direction], weights[direction])[:, :n_ranges]
            out[direction, start : start + n_ranges] = _level(parts, scales[tile] * weight_scale)


def interpolated_beams_envelope_int16(
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
    n_blocks: int,  # noqa: ARG001
    out: Real,
) -> None:
    """`InterpolatedBeamsEnvelope` on the tiles of `QuantiseTiles`, with integer sums."""
    for tile, start in enumerate(starts):
        n_ranges = min(_TILE_RANGES, stop - start)
        nodes = np.stack([_whole_beam(tiles[tile], *row) for row in zip(offsets, weights, strict=True)])
        nodes = (nodes + (1 << 15)) >> 16
        for direction, pairs in enumerate(places):
            near = nodes[np.stack([pairs, pairs + 1], axis=1)]  # (pair, 2, part, range)
            parts = np.einsum("pktr,pk->tr", near, tap_weights[direction].astype(np.int32))[:, :n_ranges]
            out[rows[direction], start : start + n_ranges] = _level(parts, scales[tile] * weight_scale)


def quantise_streams(
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
) -> None:
    """Compute streams of analytic signals, and store them like `QuantiseTiles`."""
    level = np.abs(signals.astype(np.complex128))
    unit = np.divide(signals, level, out=np.zeros(level.shape, np.complex128), where=level > 0)
    tiles[:, first:stop] = 0
    for stream in range(first, stop):
        power, count = float(powers[stream]), int(turns[stream])
        for tile, start in enumerate(starts):
            here = slice(start, start + tiles.shape[4])
            largest = float(np.max(level[:, :, here], initial=0.0))
            scales[tile, stream] = largest**power / limits[stream] * units[stream]
            if not largest:
                continue
            relative = level[:, :, here] / largest
            part = np.where(relative > 0, relative**power * unit[:, :, here] ** count, 0)
            if count == 0:
                part = part + 1j * np.sqrt(relative**power)
            parts = np.stack([part.real, part.imag], axis=-1)
            tiles[tile, stream, :, :, : part.shape[2]] = np.rint(parts * limits[stream])


def combine_streams_int16(
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
) -> None:
    """Compute amplitudes from delay-and-sums of streams on 16-bit tiles."""
    n_directions, n_mics = len(out), tiles.shape[2]
    n_powers, order, beam, total, bound = recipe
    entries = np.concatenate([[0], np.cumsum(shapes[:, 0].astype(np.int64) * shapes[:, 1])])
    pairs = np.concatenate([[0], np.cumsum(n_directions * shapes[:, 2].astype(np.int64))])
    for tile, start in enumerate(starts):
        n_ranges = min(_TILE_RANGES, stop - start)
        sums: Any = np.zeros((len(shapes), n_directions, n_ranges), dtype=np.complex128)
        for stream, (n_points, n_terms, n_pairs) in enumerate(shapes):
            mine = slice(entries[stream], entries[stream + 1])
            table = zip(
                offsets[mine].reshape(n_points, n_terms), weights[mine].reshape(n_points, n_terms, 2, 2), strict=True
            )
            parts = np.stack([_whole_beam(tiles[tile, stream], *row) for row in table])
            if n_pairs:
                nodes, both = (parts + (1 << 15)) >> 16, slice(pairs[stream], pairs[stream + 1])
                near = places[both].reshape(n_directions, n_pairs)
                taps = tap_weights[both].reshape(n_directions, n_pairs, 2).astype(np.int32)
                parts = sum(np.einsum("dptr,dp->dtr", nodes[near + one], taps[:, :, one]) for one in (0, 1))
            beams = parts[:, 0, :n_ranges] + 1j * parts[:, 1, :n_ranges]
            sums[stream] = beams * float(scales[tile, stream])
        levels = np.abs(_elementary(sums[:n_powers], order))
        if total >= 0:
            unit = float(scales[tile, total]) * bound
            least = n_mics * sums[total].imag ** 2 / unit if unit else 0.0
            coherent, whole = np.abs(sums[beam]) ** 2, n_mics * np.maximum(sums[total].real, least)
            share = np.maximum(whole, coherent)
            levels *= np.divide(coherent, share, out=np.zeros_like(coherent), where=coherent > 0)
        out[rows, start : start + n_ranges] = levels


def _elementary(powers: NDArray[np.complex128], order: int) -> NDArray[np.complex128]:
    """Return the elementary symmetric polynomial from power sums, by Newton's identities; missing sums are 0."""
    found = [np.ones(powers.shape[1:], dtype=np.complex128)]
    for k in range(1, order + 1):
        terms = [(-1) ** (i - 1) * found[k - i] * powers[i - 1] for i in range(1, min(k, len(powers)) + 1)]
        found.append(np.sum(terms, axis=0) / k)
    return found[order]


def _whole_beam(tile: Short, offsets: Index, weights: Short) -> NDArray[np.int32]:
    """Return the beam of one direction in integers: (part, range) int32."""
    flat = tile.reshape(-1, 2).astype(np.int32)
    samples = flat[offsets[:, None] + np.arange(_TILE_RANGES)]  # (term, range, 2)
    return np.asarray(np.einsum("trc,tpc->pr", samples, weights.astype(np.int32)))


def _level(parts: NDArray[np.int32], scale: np.float32) -> NDArray[np.float32]:
    real, imag = parts.astype(np.float32)
    return np.asarray(np.sqrt(real * real + imag * imag) * scale)


def _delayed(
    signals: Complex, offsets: Index, weights: ComplexOrDouble, n_ranges: int
) -> Iterator[tuple[int, NDArray[np.complex128]]]:
    """Yield each direction with its delayed and weighted signals, (mic, range) complex128."""
    windows = np.lib.stride_tricks.sliding_window_view(signals.reshape(-1), n_ranges)
    for direction, places in enumerate(offsets):
        yield direction, windows[places] * weights[direction].astype(np.complex128)[:, None]


def weight_coherence(signals: Complex, offsets: Index, weights: Complex, out: Real) -> None:
    """Multiply amplitudes by the coherence factor of Mallart and Fink (1994), which measures agreement."""
    for direction, y in _delayed(signals, offsets, weights, out.shape[1]):
        coherent = np.abs(y.sum(axis=0)) ** 2
        total = len(y) * (y.real**2 + y.imag**2).sum(axis=0)
        out[direction] *= np.divide(coherent, total, out=np.zeros_like(coherent), where=total != 0)


def combine_dmas(signals: Complex, offsets: Index, weights: Complex, order: int, out: Real) -> None:
    """Delay-multiply-and-sum: sum the products of the roots of all combinations of ``order`` microphones."""
    level = np.abs(signals.astype(np.complex128))
    roots = signals * np.power(level, 1 / order - 1, out=np.zeros_like(level), where=level != 0)
    for direction, z in _delayed(roots, offsets, weights, out.shape[1]):
        sums = np.zeros((order + 1, out.shape[1]), dtype=np.complex128)
        sums[0] = 1
        for mic in range(len(z)):
            sums[1:] += z[mic] * sums[:-1]  # the right side is computed first, from sums without this microphone
        out[direction] = np.abs(sums[order])


def combine_capon(
    signals: Complex, offsets: Index, weights: ComplexOrDouble, n_snapshots: int, loading: float, out: Real
) -> None:
    """See `CombineCapon`; the linear system has the size of the number of snapshots, as in the compiled kernel."""
    n_ranges = out.shape[1]
    n_snapshots = min(n_snapshots, n_ranges)
    ranges = np.arange(n_ranges)
    first = np.clip(ranges - n_snapshots // 2, 0, n_ranges - n_snapshots)
    for direction, y in _delayed(signals, offsets, weights, n_ranges):
        places = first[:, None] + np.arange(n_snapshots)
        means = y.mean(axis=0)
        samples = (y - means)[:, places].transpose(1, 0, 2)  # (range, mic, snapshot)
        power = (np.abs(y) ** 2).mean(axis=0)[places].sum(axis=1)
        added = np.where(power == 0, 1.0, loading * power)[:, None, None]
        matrix = samples.conj().transpose(0, 2, 1) @ samples + added * np.eye(n_snapshots)
        solved = np.linalg.solve(matrix, added * means.conj()[places][:, :, None])[:, :, 0]
        out[direction] = np.abs(solved[ranges, ranges - first])


def add_paths(
    call: NDArray[np.complex128],
    turns: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    first_bin: int,
    nodes_per_bin: float,
    out: NDArray[np.complex128],
) -> None:
    """Add delayed and filtered copies of a call to the spectrum of each microphone."""
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
    """See `ModulatePdm`; the loop runs over samples, and vectors over microphones."""
    c1, c2, c3, c4, r1, r2, width, limit = loop
    signals = signals[:, : len(out)]
    noise, dither = _noise_and_dither(keys, first, signals.shape[1])
    grid, least, most = 2.0**-20, np.minimum, np.maximum
    followed = np.rint((signals + noise_rms[:, None] * _NOISE_UNIT * noise) / grid) * grid
    followed_dithered = followed + width * dither
    s1, s2, s3, s4 = states.T.copy()
    above = np.zeros((len(signals) + 1, signals.shape[1]), dtype=np.bool_)  # last row: bits without a microphone
    for sample, u in enumerate(followed.T):
        bits = followed_dithered[:, sample] + ((s1 + s2) + (s3 + s4)) >= 0
        above[:-1, sample] = bits
        d = u - np.where(bits, 1.0, -1.0)
        s1 = least(most(s1 + (c1 * d - r1 * s2), -limit), limit)  # np.clip takes three times as long for few numbers
        s2 = least(most(s2 + c2 * s1, -limit), limit)
        s3 = least(most(s3 + (c3 * s2 - r2 * s4), -limit), limit)
        s4 = least(most(s4 + c4 * s3, -limit), limit)
    states[:] = np.stack([s1, s2, s3, s4], axis=1)
    out[:] = np.packbits(above[mics], axis=1, bitorder="little")[:, 0].T


def _noise_and_dither(
    keys: NDArray[np.uint64], first: int, n_samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return zero-mean sums of 12-bit fields, and numbers within ±½, from SplitMix64: both (mic, sample) float64."""
    z = keys[:, None] + np.arange(first, first + n_samples, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    fields = [(z >> np.uint64(shift)) & np.uint64(0xFFF) for shift in (0, 12, 24, 36)]
    noise = np.sum(fields, axis=0).astype(np.float64) - 8190.0
    dither = ((z >> np.uint64(48)).astype(np.float64) + 0.5) / 2.0**16 - 0.5
    return noise, dither


KERNELS = KernelSet.of(
    {**vars(_numpy_signals), **vars(_numpy_passive), **vars()},
    device="numpy",
    hardware="",
    transforms="scipy",
    simulated=False,
    memory=HostMemory,
    max_threads=1,
    tile_ranges=_TILE_RANGES,
    instruction_set="",
    threads=threads,
)

"""Delay-and-sum beamforming of analytic signals, with the envelopes of the beams."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beam_grid import FEWEST_RANGES, BeamGrid
from ertis_numba.chain.delays import DelayTable, Zone
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.kernels import KernelSet, Memory

__all__ = [
    "Beamform",
    "BeamformFloat32",
    "BeamformInt16",
    "Buffers",
    "WholeWeights",
    "beamform",
    "whole_limits",
]

_WEIGHT_BITS = 12  # With 32 microphones, 13 bits remain for samples. Both then have errors of about -85 dB.
_TAP_BITS = 15  # Bits of the weights of grid points, before their sum is taken into account.
_SAFE = 0.98  # Share of the largest integer in use. Rounding must not exceed the largest integer.

Buffers = tuple[NDArray[Any], ...]
"""Work arrays of one call: tiles and their scales; empty if samples stay in float32."""


class Beamform(Protocol):
    """Beamformer: computes the amplitude of every direction and range from analytic signals."""

    def new_buffers(self) -> Buffers:
        """Return new work arrays for one call at a time."""
        ...

    def __call__(self, analytic: NDArray[np.complex64], buffers: Buffers, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        ...


def beamform(
    precision: str,
    kernels: KernelSet,
    memory: Memory,
    window: TimeWindow,
    zones: Sequence[Zone],
    nodes: BeamGrid | None,
    *,
    n_phases: int,
    threads: int,
    last_sample: int | None = None,
) -> "BeamformFloat32 | BeamformInt16":
    """Return the delay-and-sum beamformer of a plan in float32 or int16; ``last_sample`` sizes the tiles of int16."""
    if precision == "float32":
        return BeamformFloat32(kernels, memory, window, zones, nodes, threads=threads)
    return BeamformInt16(kernels, memory, zones, nodes, n_phases=n_phases, threads=threads, last_sample=last_sample)


class _NodeTables:
    """Beam-grid tables in device memory; ``weights`` have the data type of the precision."""

    def __init__(self, memory: Memory, nodes: BeamGrid, weights: NDArray[Any]) -> None:
        self.places, self.rows = memory.table(nodes.places), memory.table(nodes.rows)
        self.weights = memory.table(weights)


class BeamformFloat32:
    """Delay-and-sum beamformer on float32 samples; implements `Beamform`."""

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        window: TimeWindow,
        zones: Sequence[Zone],
        nodes: BeamGrid | None,
        *,
        threads: int,
    ) -> None:
        self._kernels, self._threads = kernels, threads
        self._zones = [
            (
                zone.first,
                zone.stop,
                memory.table(zone.table.offsets(window.n_outputs)),
                memory.table(np.ascontiguousarray(zone.table.weights, np.complex64)),
            )
            for zone in zones
        ]
        self._nodes = None if nodes is None else _NodeTables(memory, nodes, nodes.weights.astype(np.float32))

    def new_buffers(self) -> Buffers:
        """Return no work arrays, since float32 samples need none."""
        return ()

    def __call__(
        self,
        analytic: NDArray[np.complex64],
        buffers: Buffers,  # noqa: ARG002
        out: NDArray[np.float32],
    ) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        for first, stop, offsets, weights in self._zones:
            if self._nodes is None:
                self._kernels.delay_and_sum_envelope(analytic, offsets, weights, first, stop, out)
            else:
                self._kernels.interpolated_beams_envelope(
                    analytic,
                    offsets,
                    weights,
                    self._nodes.places,
                    self._nodes.weights,
                    self._nodes.rows,
                    first,
                    stop,
                    _blocks(self._threads, (stop - first) // FEWEST_RANGES),
                    out,
                )


def whole_limits(sum_of_weights: float) -> tuple[int, int]:
    """Return the largest integers of weights and of samples, by a beam's sum of weights relative to the largest one."""
    bits = math.log2(_SAFE) + 31 - math.log2(sum_of_weights)
    # A sample has at most 15 bits. With few microphones, the remaining bits go to the weights.
    weight_bits = min(max(_WEIGHT_BITS, math.floor(bits) - 15), math.floor(bits / 2), 15)
    # Subtracting 1 allows for rounding.
    return 2**weight_bits - 1, math.floor(min(2.0 ** (bits - weight_bits), 2.0**15)) - 1


class WholeWeights:
    """Weights of delay-and-sum in 16 bits; ``last_sample`` is the largest index of a sample at the first range.

    ``weights`` (beam, term, 2, 2) of each table are ``((re w, −im w), (im w, re w))``; ``tap_weights`` (direction,
    pair, 2) are empty without a beam grid. ``limit`` is the largest magnitude of samples for which no sum overflows,
    and ``unit`` the value of 1 in the sums, relative to that of a sample.
    """

    def __init__(self, tables: Sequence[DelayTable], nodes: BeamGrid | None) -> None:
        sizes = [np.abs(table.weights) for table in tables]
        largest = max(float(size.max()) for size in sizes)
        weight_limit, limit = whole_limits(max(float(size.sum(axis=1).max()) for size in sizes) / largest)
        unit = largest / weight_limit
        self.limit = np.float32(limit)
        self.weights = [_pairs(table.weights / np.float32(unit)) for table in tables]
        for pairs in self.weights:
            # Rounding may have increased a sum of many small weights.
            real, imaginary = pairs[:, :, 0, 0].astype(np.float64), pairs[:, :, 1, 0].astype(np.float64)
            sums = np.sqrt(real**2 + imaginary**2).sum(axis=1)
            self.limit = min(self.limit, np.float32(_SAFE * 2**31 / max(1.0, float(sums.max())) - 1))
        self.unit = np.float32(unit)
        self.last_sample = max(int(table.samples.max()) for table in tables)
        self.tap_weights: NDArray[np.int16] = np.empty((0, 0, 2), dtype=np.int16)
        if nodes is not None:
            most = float(np.max(np.abs(nodes.weights).sum(axis=(1, 2))))
            scale = min(_SAFE * 2**_TAP_BITS / float(np.max(np.abs(nodes.weights))), _SAFE * 2**16 / most)
            self.tap_weights = np.rint(nodes.weights * scale).astype(np.int16)
            self.unit = np.float32(self.unit * 2**16 / scale)


@dataclass(frozen=True, slots=True, eq=False)
class _WholeZone:
    """Focal zone with integer weights, and the slice of its tiles."""

    tiles: slice
    starts: NDArray[np.int32]
    stop: int
    offsets: NDArray[np.int32]
    weights: NDArray[np.int16]


class BeamformInt16:
    """Delay-and-sum beamformer on 16-bit samples, scaled for each tile of ranges; signals begin at range ``origin``."""

    # Weights get 12 bits of a product, or half if there are fewer than 24, so that `x · Σ|w| ≤ 2³¹`.

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        zones: Sequence[Zone],
        nodes: BeamGrid | None,
        *,
        n_phases: int,
        threads: int,
        last_sample: int | None = None,
        origin: int = 0,
    ) -> None:
        whole = WholeWeights([zone.table for zone in zones], nodes)
        self._limit, self._weight_scale = whole.limit, whole.unit
        self._kernels, self._memory, self._threads = kernels, memory, threads
        width = kernels.tile_ranges + (whole.last_sample if last_sample is None else last_sample) + 1
        starts: list[int] = []
        self._zones: list[_WholeZone] = []
        for zone, weights in zip(zones, whole.weights, strict=True):
            mine = range(zone.first, zone.stop, kernels.tile_ranges)
            self._zones.append(
                _WholeZone(
                    slice(len(starts), len(starts) + len(mine)),
                    memory.table(np.array(mine, dtype=np.int32)),
                    zone.stop,
                    memory.table(zone.table.offsets(width)),
                    memory.table(weights),
                )
            )
            starts += mine
        self._starts = memory.table(np.array(starts, dtype=np.int32) - np.int32(origin))
        n_mics = 1 + int(zones[0].table.rows.max()) // n_phases
        self._shape = (len(starts), n_mics, n_phases, width, 2)
        self._nodes = None if nodes is None else _NodeTables(memory, nodes, whole.tap_weights)

    def new_buffers(self) -> Buffers:
        """Return the tiles and their scales for one call at a time."""
        return self._memory.zeros(self._shape, np.int16), self._memory.zeros(self._shape[:1], np.float32)

    def __call__(self, analytic: NDArray[np.complex64], buffers: Buffers, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        tiles, scales = buffers
        self._kernels.quantise_tiles(analytic, self._starts, self._limit, tiles, scales)
        for zone in self._zones:
            if self._nodes is None:
                self._kernels.delay_and_sum_envelope_int16(
                    tiles[zone.tiles],
                    scales[zone.tiles],
                    zone.starts,
                    zone.stop,
                    zone.offsets,
                    zone.weights,
                    self._weight_scale,
                    out,
                )
            else:
                self._kernels.interpolated_beams_envelope_int16(
                    tiles[zone.tiles],
                    scales[zone.tiles],
                    zone.starts,
                    zone.stop,
                    zone.offsets,
                    zone.weights,
                    self._nodes.places,
                    self._nodes.weights,
                    self._nodes.rows,
                    self._weight_scale,
                    _blocks(self._threads, len(zone.starts)),
                    out,
                )


def _pairs(weights: NDArray[np.complex128]) -> NDArray[np.int16]:
    """Return ``((re w, −im w), (im w, re w))`` of each weight, rounded: (beam, term, 2, 2) int16."""
    pairs = np.empty((*weights.shape, 2, 2), np.int16)
    pairs[:, :, 0, 0] = pairs[:, :, 1, 1] = np.rint(weights.real)
    pairs[:, :, 1, 0] = whole = np.rint(weights.imag)
    pairs[:, :, 0, 1] = -whole
    return pairs


def _blocks(threads: int, n_tiles: int) -> int:
    """Return the number of blocks of directions such that every thread has about two tiles of a block."""
    return max(1, round(2 * threads / max(1, n_tiles)))

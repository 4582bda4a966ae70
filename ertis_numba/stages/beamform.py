"""From analytic signals to the envelopes of beams, by delay-and-sum."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import DeviceError
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.stages.beam_grid import FEWEST_RANGES, BeamNodes
from ertis_numba.stages.delays import Zone
from ertis_numba.stages.window import TimeWindow

__all__ = ["Beamform", "BeamformFloat32", "BeamformInt16", "Buffers", "beamform", "require_int16", "whole_limits"]

_WEIGHT_BITS = 12  # leave the samples 13 bits with 32 microphones: both err by about -85 dB then
_TAP_BITS = 15  # of the weights of nodes, less what their sum needs
_SAFE = 0.98  # of the largest whole number: rounding must not go beyond it

Buffers = tuple[NDArray[Any], ...]
"""What a call writes to on its way: tiles and their scales, nothing where samples stay in float32."""


class Beamform(Protocol):
    """Analytic signals to the energy of every direction and range."""

    def new_buffers(self) -> Buffers:
        """Return what one call needs to write to."""
        ...

    def __call__(self, analytic: NDArray[np.complex64], buffers: Buffers, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        ...


def require_int16(kernels: KernelSet) -> None:
    """Refuse a device without 16-bit dot products.

    Raises
    ------
    DeviceError
    """
    if not kernels.tile_ranges:
        raise DeviceError(
            "accuracy.precision is 'int16', but this processor has no 16-bit dot product (AVX-512 VNNI or AVX-VNNI); "
            "give 'float32' or 'auto'"
        )


def beamform(
    precision: str,
    kernels: KernelSet,
    memory: Memory,
    window: TimeWindow,
    zones: Sequence[Zone],
    nodes: BeamNodes | None,
    *,
    n_phases: int,
    threads: int,
) -> "BeamformFloat32 | BeamformInt16":
    """Return the beamformer of a plan; parameters as for `BeamformFloat32`.

    Raises
    ------
    DeviceError
        The device has no 16-bit dot product.
    """
    if precision == "float32":
        return BeamformFloat32(kernels, memory, window, zones, nodes, threads=threads)
    require_int16(kernels)
    return BeamformInt16(kernels, memory, zones, nodes, n_phases=n_phases, threads=threads)


class _NodeTables:
    """The nodes of directions where kernels read them; ``weights`` are those of the precision."""

    def __init__(self, memory: Memory, nodes: BeamNodes, weights: NDArray[Any]) -> None:
        self.places, self.rows = memory.table(nodes.places), memory.table(nodes.rows)
        self.weights = memory.table(weights)


class BeamformFloat32:
    """See `Beamform`; samples stay in single precision.

    Parameters
    ----------
    kernels, memory, window
    zones : sequence of Zone
        Together the whole range axis; of the beams of all directions, or of the nodes.
    nodes : BeamNodes, optional
        The zones' beams are those of nodes, and others are interpolated from them.
    threads : int
    """

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        window: TimeWindow,
        zones: Sequence[Zone],
        nodes: BeamNodes | None,
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
        """See `Beamform`."""
        return ()

    def __call__(
        self,
        analytic: NDArray[np.complex64],
        buffers: Buffers,  # noqa: ARG002
        out: NDArray[np.float32],
    ) -> None:
        """See `Beamform`."""
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
    """Return the largest whole numbers of weights and of samples, for a sum of weights by the largest of them."""
    bits = math.log2(_SAFE) + 31 - math.log2(sum_of_weights)
    # A sample has 15 bits at most: what few microphones leave over goes to the weights.
    weight_bits = min(max(_WEIGHT_BITS, math.floor(bits) - 15), math.floor(bits / 2), 15)
    # One off for rounding.
    return 2**weight_bits - 1, math.floor(min(2.0 ** (bits - weight_bits), 2.0**15)) - 1


@dataclass(frozen=True, slots=True, eq=False)
class _WholeZone:
    """A zone in whole numbers, and which of all tiles are its own."""

    tiles: slice
    starts: NDArray[np.int32]
    stop: int
    offsets: NDArray[np.int32]
    weights: NDArray[np.int16]


class BeamformInt16:
    """See `Beamform`; samples go through 16 bits, scaled tile by tile of ranges.

    The 32-bit sums must hold all terms at full scale: for weights w and samples of magnitudes up to x, that is
    ``x · Σ|w| ≤ 2³¹``. Weights get 12 bits of it, or half where there is less. Of the beams of nodes the upper
    16 bits are kept, so that they fill them where the sums fill their 32.
    """

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        zones: Sequence[Zone],
        nodes: BeamNodes | None,
        *,
        n_phases: int,
        threads: int,
    ) -> None:
        tables = [zone.table for zone in zones]
        largest = max(float(np.max(np.abs(table.weights))) for table in tables)
        weight_limit, limit = whole_limits(
            max(float(np.max(np.abs(table.weights).sum(axis=1))) for table in tables) / largest
        )
        self._limit = np.float32(limit)
        self._weight_scale = np.float32(largest / weight_limit)
        self._kernels, self._memory, self._threads = kernels, memory, threads
        width = kernels.tile_ranges + max(int(table.samples.max()) for table in tables) + 1
        starts: list[int] = []
        self._zones: list[_WholeZone] = []
        for zone in zones:
            mine = range(zone.first, zone.stop, kernels.tile_ranges)
            offsets, weights = zone.table.offsets(width), _pairs(zone.table.weights / self._weight_scale)
            # Rounding may have added to them, where there are many small ones.
            sums = np.hypot(weights[:, :, 0, 0], weights[:, :, 1, 0], dtype=np.float64).sum(axis=1)
            self._limit = min(self._limit, np.float32(_SAFE * 2**31 / max(1.0, float(sums.max())) - 1))
            self._zones.append(
                _WholeZone(
                    slice(len(starts), len(starts) + len(mine)),
                    memory.table(np.array(mine, dtype=np.int32)),
                    zone.stop,
                    memory.table(offsets),
                    memory.table(weights),
                )
            )
            starts += mine
        self._starts = memory.table(np.array(starts, dtype=np.int32))
        n_mics = 1 + int(tables[0].rows.max()) // n_phases
        self._shape = (len(starts), n_mics, n_phases, width, 2)
        self._nodes = None
        if nodes is not None:
            sums = float(np.max(np.abs(nodes.weights).sum(axis=(1, 2))))
            scale = min(_SAFE * 2**_TAP_BITS / float(np.max(np.abs(nodes.weights))), _SAFE * 2**16 / sums)
            self._nodes = _NodeTables(memory, nodes, np.rint(nodes.weights * scale).astype(np.int16))
            self._weight_scale = np.float32(self._weight_scale * 2**16 / scale)

    def new_buffers(self) -> Buffers:
        """See `Beamform`."""
        return self._memory.zeros(self._shape, np.int16), self._memory.zeros(self._shape[:1], np.float32)

    def __call__(self, analytic: NDArray[np.complex64], buffers: Buffers, out: NDArray[np.float32]) -> None:
        """See `Beamform`."""
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
    pairs = np.array([[weights.real, -weights.imag], [weights.imag, weights.real]])
    return np.ascontiguousarray(np.rint(np.moveaxis(pairs, (0, 1), (2, 3)))).astype(np.int16)


def _blocks(threads: int, n_tiles: int) -> int:
    """Return into how many parts to cut directions: every thread should have two tiles of a part."""
    return max(1, round(2 * threads / max(1, n_tiles)))

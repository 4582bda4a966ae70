"""Adaptive beamformers from delay-and-sums of streams, on 16-bit samples."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beam_grid import BeamGrid
from ertis_numba.chain.beamform import Buffers, WholeWeights
from ertis_numba.chain.delays import DelayTable
from ertis_numba.chain.planned_streams import PlannedStreams
from ertis_numba.chain.stream_recipe import LINEAR, Recipe
from ertis_numba.kernels import KernelSet, Memory

__all__ = ["StreamBeamform", "StreamTables", "amplitudes_of_stream"]


class StreamTables(NamedTuple):
    """Tables of one stream: its beam grid, or None, and a delay table for each focal zone."""

    nodes: BeamGrid | None
    tables: list[DelayTable]


def amplitudes_of_stream(recipe: Recipe, place: int, n_mics: int) -> NDArray[np.float64]:
    """Return microphone weights (mic,) in a stream's sum; division by the number of products avoids overflow."""
    stream = recipe.streams[place]
    number = math.comb(n_mics, recipe.order) ** (1 / recipe.order) if place < recipe.order else n_mics
    return np.full(n_mics, float(number) ** -(stream.turns if place < recipe.order else stream.power))


@dataclass(frozen=True, slots=True, eq=False)
class _Zone:
    """Focal zone: the slice of its tiles, its first ranges and the flat tables of all streams."""

    tiles: slice
    starts: NDArray[np.int32]
    stop: int
    offsets: NDArray[np.int32]
    weights: NDArray[np.int16]


class StreamBeamform:
    """Adaptive beamformer on 16-bit streams, with tables for each; implements `Beamform`.

    Tables without a beam grid have the directions in the order of ``rows`` (direction,). ``zones`` are (first, stop) of
    ranges. ``linear`` is the index of the stream of the signals themselves, to which a filter may apply gains; −1 for
    none.
    """

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        recipe: Recipe,
        planned: PlannedStreams,
        tables: Sequence[StreamTables],
        rows: NDArray[np.int32],
        zones: Sequence[tuple[int, int]],
        *,
        n_phases: int,
        last_sample: int | None = None,
    ) -> None:
        self._kernels, self._memory = kernels, memory
        whole = [WholeWeights(stream.tables, stream.nodes) for stream in tables]
        if last_sample is None:
            last_sample = max(each.last_sample for each in whole)
        width = kernels.tile_ranges + last_sample + 1
        starts: list[int] = []
        self._zones: list[_Zone] = []
        for k, (first, stop) in enumerate(zones):
            mine = range(first, stop, kernels.tile_ranges)
            offsets = [stream.tables[k].offsets(width).ravel() for stream in tables]
            weights = [each.weights[k].reshape(-1, 2, 2) for each in whole]
            self._zones.append(
                _Zone(
                    slice(len(starts), len(starts) + len(mine)),
                    memory.table(np.array(mine, dtype=np.int32)),
                    stop,
                    memory.table(np.concatenate(offsets)),
                    memory.table(np.concatenate(weights)),
                )
            )
            starts += mine
        self._starts = memory.table(np.array(starts, dtype=np.int32))
        self._rows = memory.table(rows)
        found = [_in_order(stream.nodes, each, rows) for stream, each in zip(tables, whole, strict=True)]
        # A last entry without a use, because a GPU has no empty arrays.
        places = [*(each.ravel() for each, _ in found), np.zeros(1, dtype=np.int32)]
        tap_weights = [*(taps.reshape(-1, 2) for _, taps in found), np.zeros((1, 2), dtype=np.int16)]
        self._places = memory.table(np.concatenate(places))
        self._tap_weights = memory.table(np.concatenate(tap_weights))
        # On the host, because launches on a GPU depend on it.
        self._shapes = np.array(
            [
                (*stream.tables[0].weights.shape, 0 if stream.nodes is None else stream.nodes.places.shape[1])
                for stream in tables
            ],
            dtype=np.int32,
        )
        self._limits = memory.table(np.array([each.limit for each in whole], dtype=np.float32))
        self._units = memory.table(np.array([each.unit for each in whole], dtype=np.float32))
        streams = [each.stream for each in planned.streams]
        self._powers = memory.table(np.array([stream.power for stream in streams], dtype=np.float32))
        self._turns = memory.table(np.array([stream.turns for stream in streams], dtype=np.int32))
        left_out = recipe.order - planned.n_powers
        beam, total = (k - left_out if k >= recipe.order else k for k in (recipe.beam, recipe.total))
        bound = float(whole[total].limit) / float(whole[total].unit) if total >= 0 else 1.0
        self._recipe = (planned.n_powers, recipe.order, beam, total, bound)
        n_mics = 1 + int(tables[0].tables[0].rows.max()) // n_phases
        self._shape = (len(starts), len(streams), n_mics, n_phases, width, 2)
        self.linear = streams.index(LINEAR) if LINEAR in streams else -1

    def new_buffers(self) -> Buffers:
        """Return the tiles and their scales for one call at a time."""
        return self._memory.zeros(self._shape, np.int16), self._memory.zeros(self._shape[:2], np.float32)

    def __call__(self, analytic: NDArray[np.complex64], buffers: Buffers, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        self.take(analytic, buffers)
        self.combine(buffers, out)

    def take(self, analytic: NDArray[np.complex64], buffers: Buffers, first: int = 0, stop: int | None = None) -> None:
        """Compute the streams ``first … stop`` of ``analytic``, all by default."""
        tiles, scales = buffers
        stop = self._shape[1] if stop is None else stop
        self._kernels.quantise_streams(
            *(analytic, self._starts, self._limits, self._units, self._powers, self._turns, first, stop, tiles, scales)
        )

    def combine(self, buffers: Buffers, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from the streams in ``buffers``."""
        tiles, scales = buffers
        for zone in self._zones:
            self._kernels.combine_streams_int16(
                tiles[zone.tiles],
                scales[zone.tiles],
                zone.starts,
                zone.stop,
                self._shapes,
                zone.offsets,
                zone.weights,
                self._places,
                self._tap_weights,
                self._rows,
                self._recipe,
                out,
            )


def _in_order(
    nodes: BeamGrid | None, whole: WholeWeights, rows: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
    """Return the places and weights of a beam grid's points for directions in the order ``rows``."""
    if nodes is None:
        return np.empty(0, dtype=np.int32), np.empty((0, 2), dtype=np.int16)
    order = np.empty(len(rows), dtype=np.intp)
    order[nodes.rows] = np.arange(len(rows))
    return nodes.places[order[rows]], whole.tap_weights[order[rows]]

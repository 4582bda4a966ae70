"""Delay-and-sum in two steps: beams of the rows of a planar array, and beams of the array from these."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.beam_grid import Aperture, BeamGrid
from ertis_numba.chain.beamform import BeamformInt16, Buffers
from ertis_numba.chain.delays import DelayTable, Zone
from ertis_numba.chain.interpolation_fit import DelayFit, Spectrum
from ertis_numba.chain.plan_elements import ahead_of, beam_grid_of, require_rows, row_aperture
from ertis_numba.chain.rows import Rows, seen_from_rows
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.kernels import KernelSet, Memory, load_steering
from ertis_numba.settings import Settings

__all__ = ["RowBeamform", "RowTables", "row_tables"]


def row_tables(
    settings: Settings, aperture: Aperture, nodes: BeamGrid | None, fit: DelayFit, spectrum: Spectrum
) -> "RowTables":
    """Return the tables of a complete plan with beams of rows."""
    rows, speed_m_s = require_rows(settings, aperture), sound_speed_m_s(settings.air)
    if nodes is None:
        raise ArgumentError("accuracy.row_beams is true, which needs accuracy.beam_taps 2, 4 or 6; use 4")
    grid = None
    if settings.processing.wavefront == "spherical":
        grid = beam_grid_of(settings, row_aperture(aperture, rows), spectrum)
    return RowTables(rows, aperture, nodes, grid, fit, speed_m_s)


class _RowZone(NamedTuple):
    """Focal zone: delay tables of the beams of rows and of the array, and the samples of both."""

    first: int
    stop: int
    rows: DelayTable
    beams: DelayTable
    n_beams: int
    lead: int


class RowTables:
    """Delays of beams of rows at points along them, and of the beams of the array at the points of its beam grid.

    For plane waves, rows are summed at the directions of the beam grid along them. Otherwise, `seen_from_rows` lie
    between the points of rows, and ``grid`` interpolates.
    """

    def __init__(
        self, rows: Rows, aperture: Aperture, nodes: BeamGrid, grid: BeamGrid | None, fit: DelayFit, speed_m_s: float
    ) -> None:
        self._rows, self._nodes, self.grid, self._fit, self._speed_m_s = rows, nodes, grid, fit, speed_m_s
        self._along_m = aperture.positions_m[:, rows.along]
        self.late_s = ahead_of(np.ones(len(rows)), fit.step_s)  # Straight ahead, all rows have the same delay.

    def _seen(self, range_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return seen_from_rows(self._nodes.points, self._rows, range_m, sound_speed_m_s=self._speed_m_s)

    def _placed(
        self, range_m: float
    ) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """Return points along rows, each term's point and weight, and its delay in s: (node, row, tap)."""
        seen, delays_s = self._seen(range_m)
        if self.grid is None:
            points, which = np.unique(seen[:, 0], return_inverse=True)
            which = np.repeat(which[:, None, None], seen.shape[1], axis=1)
            return points, which, np.ones((1, 1, 1)), delays_s[:, :, None]
        placed = self.grid.turned(seen.reshape(-1, 1), load_steering("numpy"))
        order = np.argsort(placed.rows)
        which = (placed.places[:, :, None] + np.arange(2)).reshape(len(order), -1)[order].reshape(*seen.shape, -1)
        weights = placed.weights.reshape(len(order), -1)[order].reshape(which.shape)
        return placed.points[:, 0], which, weights, np.repeat(delays_s[:, :, None], which.shape[2], axis=2)

    def _zone(
        self,
        edges: tuple[int, int, float],
        own_s: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        *,
        n_phases: int,
        lead: int,
        rate_hz: float,
    ) -> _RowZone:
        """Return the tables of a focal zone for microphones with own delays (mic,) and amplitudes (mic,)."""
        first, stop, range_m = edges
        points, which, weights, delays_s = self._placed(range_m)
        # Beams of rows begin this many samples before the first range.
        margin_s = (self._fit.n_taps // 2 + 2) * self._fit.step_s
        before = math.ceil((float(np.max(np.abs(delays_s))) + margin_s) * rate_hz)
        found = self._row_table(points, range_m, own_s, amplitudes, n_phases=n_phases, lead=lead + first - before)
        n_nodes, n_rows, _ = delays_s.shape
        flat = (n_nodes, -1)
        late_s = delays_s + self.late_s[:, None]
        table = DelayTable.of(
            late_s.reshape(flat),
            np.broadcast_to(weights, late_s.shape).reshape(flat),
            self._fit,
            n_phases=n_phases,
            lead=before,
        )
        beam = (np.arange(n_rows)[:, None] * len(points) + which).reshape(n_nodes, -1, 1) * n_phases
        phases = table.rows.reshape(n_nodes, -1, self._fit.n_taps) % n_phases
        beams = DelayTable((beam + phases).reshape(table.rows.shape), table.samples, table.weights)
        return _RowZone(first, stop, found, beams, len(points) * n_rows, before)

    def _row_table(
        self,
        points: NDArray[np.float64],
        range_m: float,
        own_s: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        *,
        n_phases: int,
        lead: int,
    ) -> DelayTable:
        """Return the delays of (row, point, phase), with as many terms for each row as the longest one has."""
        most = self._rows.most
        tables = []
        for late_s, mics in zip(self.late_s, self._rows.mics, strict=True):
            line = Aperture(self._along_m[mics, None], points[:, None], self._along_m[mics] ** 2, np.ones((1, 3)))
            waves_s = line.delays_s(points[:, None], sound_speed_m_s=self._speed_m_s, range_m=range_m)
            delays_s = (own_s[mics] - late_s + waves_s)[:, None] + self._fit.step_s * np.arange(n_phases)[:, None]
            delays_s = np.pad(delays_s.reshape(-1, len(mics)), [(0, 0), (0, most - len(mics))], mode="edge")
            used = np.pad(amplitudes[mics], (0, most - len(mics)))
            table = DelayTable.of(delays_s, used, self._fit, n_phases=n_phases, lead=lead)
            number = np.pad(mics, (0, most - len(mics)), mode="edge")[:, None] * n_phases
            rows = number + table.rows.reshape(len(delays_s), most, -1) % n_phases
            tables.append(DelayTable(rows.reshape(table.rows.shape), table.samples, table.weights))
        return DelayTable(
            *(np.concatenate([getattr(each, name) for each in tables]) for name in ("rows", "samples", "weights"))
        )

    def gain(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the gains that complement the second interpolation of delays, and that along rows."""
        gain = self._fit.gain(frequency_hz)
        return gain if self.grid is None else gain * self.grid.gain(frequency_hz)

    def beamform(
        self,
        kernels: KernelSet,
        memory: Memory,
        window: TimeWindow,
        edges: Sequence[tuple[int, int, float]],
        own_s: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        *,
        n_phases: int,
        rate_hz: float,
        threads: int,
    ) -> "RowBeamform":
        """Return the beamformer for microphones with own delays (mic,) and amplitudes (mic,)."""
        zones = [
            self._zone(each, own_s, amplitudes, n_phases=n_phases, lead=window.lead, rate_hz=rate_hz) for each in edges
        ]
        return RowBeamform(
            kernels, memory, zones, self._nodes, n_phases=n_phases, n_samples=window.n_outputs, threads=threads
        )

    def largest_delay_s(self, own_s: NDArray[np.float64], ranges_m: Sequence[float]) -> float:
        """Return an upper limit on the delays of microphones and rows together, for focal zones at given ranges."""
        seen = [self._seen(range_m) for range_m in ranges_m]
        reach = max(float(np.max(np.abs(u))) for u, _ in seen)
        if self.grid is not None:  # Delays of points beyond the unit circle grow faster near the array.
            reach = max(1.0, reach + self.grid.reach - 1)
            reach += math.sqrt(reach**2 - 1)
        along_s = reach * float(np.max(np.abs(self._along_m))) / self._speed_m_s
        across_s = max(float(np.max(np.abs(delays_s))) for _, delays_s in seen)
        return float(np.max(np.abs(own_s))) + along_s + across_s + 2 * self._fit.step_s


class RowBeamform:
    """Delay-and-sum beamformer of the tables of focal zones; implements `Beamform`."""

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        zones: Sequence[_RowZone],
        nodes: BeamGrid,
        *,
        n_phases: int,
        n_samples: int,
        threads: int,
    ) -> None:
        self._kernels, self._memory = kernels, memory
        self._zones = [
            (
                (each.n_beams, n_phases, each.stop - each.first + 2 * each.lead),
                memory.table(each.rows.offsets(n_samples)),
                memory.table(each.rows.weights.astype(np.complex64)),
                BeamformInt16(
                    kernels, memory, [Zone(each.first, each.stop, each.beams)], nodes,
                    n_phases=n_phases, threads=threads, origin=each.first,
                ),
            )
            for each in zones
        ]  # fmt: skip

    def new_buffers(self) -> Buffers:
        """Return the beams of rows, and the tiles of each zone and their scales."""
        beams = self._memory.zeros((max(math.prod(shape) for shape, *_ in self._zones),), np.complex64)
        return beams, *(each for *_, beamform in self._zones for each in beamform.new_buffers())

    def __call__(self, analytic: NDArray[np.complex64], buffers: Buffers, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        for k, ((n_beams, n_phases, n_samples), offsets, weights, beamform) in enumerate(self._zones):
            beams = buffers[0][: n_beams * n_phases * n_samples]
            self._kernels.delay_and_sum(analytic, offsets, weights, beams.reshape(n_beams * n_phases, n_samples))
            signals = beams.reshape(n_beams, n_phases, n_samples)
            beamform(signals, buffers[1 + 2 * k : 3 + 2 * k], out)

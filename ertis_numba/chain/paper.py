"""Method of the 2019 paper on the kernels of a device.

The steps of Jansen, Laurijssen, Kerstens, Daems and Steckel, with filters of linear phase and analytic signals;
`paper_scipy` keeps their recursive filters.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beamform import Buffers
from ertis_numba.chain.demodulate import FilterPcm, Room
from ertis_numba.chain.kernel_chain import KernelChain
from ertis_numba.chain.matched_filter import flat_spectrum
from ertis_numba.chain.paper_scipy import largest_delay, range_axis, whole_delays
from ertis_numba.chain.plan_elements import chain_taps
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry import Grid, array_weights, direction_grid, microphones
from ertis_numba.geometry.waveform import matched_guard_s
from ertis_numba.kernels import KernelSet, Memory, fft
from ertis_numba.settings import Settings

__all__ = ["PaperChain"]

_DIRECTIONS = 64  # in a block, whose beams at the full rate stay in the caches


class PaperChain(KernelChain):
    """Signal chain of the paper's method; parameters, attributes and errors are those of `KernelChain`."""

    def _make(self, settings: Settings) -> None:
        layout, memory, kernels = microphones(settings.array), self._memory, self._kernels
        self.grid = direction_grid(settings.processing)
        n_samples = -(-settings.recording.n_samples // settings.decimation)
        self.range_m, outputs = range_axis(settings, n_samples)
        lead = largest_delay(settings, whole_delays(settings, self.grid))
        taps, channels = chain_taps(settings), np.flatnonzero(layout.enabled).astype(np.int32)
        guard_s = settings.call.end_s + 2 * matched_guard_s(settings)
        n_fft = n_samples + 2 * lead + math.ceil(guard_s * settings.signal_rate_hz) + 1
        n_fft += n_fft % 2
        window, factor = TimeWindow.from_start(n_samples, n_fft=n_fft), settings.decimation
        if settings.recording.is_pdm:
            n_recorded = settings.recording.n_samples
            self._demodulate = _UnpackAndFilter(
                channels, window, kernels, memory, taps=taps, factor=factor, n_recorded=n_recorded
            )
        else:
            scale = settings.recording.full_scale
            self._demodulate = FilterPcm(channels, window, kernels, memory, taps=taps, factor=factor, full_scale=scale)
        self._matched_filter = _MultiplyByTemplate(
            settings, kernels, memory, taps=taps, shape=(len(channels), 1, n_fft), lead=lead
        )
        first = np.arange(len(channels)) * n_fft + lead + outputs.start * settings.output_decimation
        weights = array_weights(settings) / (layout.gain[layout.enabled] * len(channels))
        step, n_ranges = settings.output_decimation, len(self.range_m)

        def turned(grid: Grid) -> _DelayAndSum:
            starts = first + whole_delays(settings, grid)
            return _DelayAndSum(kernels, memory, starts, weights, step=step, n_ranges=n_ranges)

        self._new_beamform = turned
        self._beamform = turned(self.grid)

    def _turned(self, grid: Grid, threads: int) -> "_DelayAndSum":  # noqa: ARG002  NumPy computes its tables.
        return self._new_beamform(grid)


class _UnpackAndFilter:
    """Demodulation of PDM bits in three passes; parameters as for `DemodulatePdm`; implements `Demodulate`."""

    def __init__(
        self,
        channels: NDArray[np.int32],
        window: TimeWindow,
        kernels: KernelSet,
        memory: Memory,
        *,
        taps: NDArray[np.int16] | NDArray[np.int32],
        factor: int,
        n_recorded: int,
    ) -> None:
        self._kernels, self._memory, self._factor, self._n_recorded = kernels, memory, factor, n_recorded
        # Zeros on both sides make the group delay a multiple of the decimation, so that it can be removed exactly.
        self._n_ahead = -(-(len(taps) // 2) // factor)
        padded = np.pad(taps / taps.sum(dtype=np.int64), self._n_ahead * factor - len(taps) // 2)
        self._taps, self._channels = memory.table(padded.astype(np.float32)), memory.table(channels)
        self.shape = (len(channels), window.n_fft)

    def new_room(self) -> Room:
        """Return the arrays of unpacked and of decimated samples for one measurement at a time."""
        n_decimated = -(-self._n_recorded // self._factor) + self._n_ahead
        shapes = (self.shape[0], self._n_recorded), (self.shape[0], n_decimated)
        return tuple(self._memory.zeros(shape, np.float32) for shape in shapes)

    def __call__(self, words: NDArray[np.unsignedinteger], room: Room, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (mic, sample) float32, from ``words``, (sample, word) unsigned integers."""
        unpacked, decimated = room
        self._kernels.unpack_bits(words, self._channels, unpacked)
        self._kernels.decimate(unpacked, self._taps, self._factor, decimated)
        self._kernels.remove_group_delay(decimated, self._n_ahead, out)


class _MultiplyByTemplate:
    """Matched filter at the full signal rate, delayed by ``lead`` samples; implements `Compress`."""

    def __init__(
        self,
        settings: Settings,
        kernels: KernelSet,
        memory: Memory,
        *,
        taps: NDArray[np.int16] | NDArray[np.int32],
        shape: tuple[int, int, int],
        lead: int,
    ) -> None:
        n_fft = shape[2]
        first_bin, _, flat = flat_spectrum(settings, taps, n_fft=n_fft)
        bins = first_bin + np.arange(len(flat))
        template = np.zeros(n_fft // 2 + 1, dtype=np.complex64)
        # Neither transform divides by its length. This division supplies the missing factor.
        template[bins] = flat / n_fft * np.exp(-2j * math.pi * bins * lead / n_fft)
        self._template, self._kernel, self.shape = memory.table(template), kernels.multiply_spectra, shape

    def __call__(self, transforms: fft.Transforms, out: NDArray[np.complex64], *, threads: int) -> None:
        """Fill ``out``, (mic, 1, sample) complex64, with ``transforms`` that were planned for this array."""
        spectra = transforms.forward(threads=threads)
        self._kernel(spectra, self._template, out.reshape(self.shape[0], self.shape[2]))
        transforms.inverse(threads=threads)


class _DelayAndSum:
    """Sums of all samples in the range window, of which the envelope keeps every ``step``-th; implements `Beamform`."""

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        starts: NDArray[np.int64],
        weights: NDArray[np.float64],
        *,
        step: int,
        n_ranges: int,
    ) -> None:
        self._kernels, self._memory, self._step = kernels, memory, step
        self._shape = min(_DIRECTIONS, len(starts)), (n_ranges - 1) * step + 1
        self._starts = memory.table(starts.astype(np.int32))
        self._weights = memory.table(np.broadcast_to(weights, starts.shape).astype(np.complex64))

    def new_buffers(self) -> Buffers:
        """Return the beams of a block of directions for one call at a time."""
        return (self._memory.zeros(self._shape, np.complex64),)

    def __call__(self, analytic: NDArray[np.complex64], buffers: Buffers, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, 1, sample) complex64."""
        (beams,) = buffers
        for first in range(0, len(out), _DIRECTIONS):
            part = slice(first, first + _DIRECTIONS)
            block = beams[: len(out[part])]
            self._kernels.delay_and_sum(analytic, self._starts[part], self._weights[part], block)
            self._kernels.envelope(block, self._step, out[part])

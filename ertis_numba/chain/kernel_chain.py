"""Signal chain of four stages on one device: demodulation, matched filter, beamformer and envelope."""

import functools
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.forks import call_in_forks
from ertis_numba.chain.beamform import Beamform
from ertis_numba.chain.buffer_pool import BufferPool, MeasurementBuffers
from ertis_numba.chain.demodulate import Demodulate, DemodulatePdm
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.chain.phase_shifts import PhaseShifts
from ertis_numba.chain.word_stream import StreamedImage, WordStream, foreign_stream
from ertis_numba.geometry import Grid
from ertis_numba.kernels import KernelSet, fft
from ertis_numba.settings import Settings

__all__ = ["Compress", "KernelChain"]


class Compress(Protocol):
    """Matched-filter stage: computes analytic signals, (mic, phase, sample), from signals."""

    shape: tuple[int, int, int]

    def __call__(self, transforms: fft.Transforms, out: NDArray[np.complex64], *, threads: int) -> None:
        """Fill ``out``, (mic, phase, sample) complex64, with ``transforms`` that were planned for this array."""
        ...


class KernelChain(ABC):
    """Runs the stages, which subclasses create in `_make`, in buffers of its own on lanes; implements `Chain`."""

    grid: Grid
    range_m: NDArray[np.float64]
    _demodulate: Demodulate
    _matched_filter: Compress
    _beamform: Beamform | PhaseShifts

    def __init__(
        self,
        settings: Settings,
        kernels: KernelSet,
        *,
        threads: int,
        graphs: bool | None = None,
    ) -> None:
        self._memory = kernels.memory(graphs=graphs)
        self._pool = BufferPool()
        call_in_forks(self._forget_threads)
        self._kernels, self._threads = kernels, threads
        self._is_turned = settings.processing.level_directions
        with one_thread():
            self._make(settings)

    @abstractmethod
    def _make(self, settings: Settings) -> None:
        """Create the axes and the stages."""

    @abstractmethod
    def _turned(self, grid: Grid, threads: int) -> Beamform | PhaseShifts:
        """Return a beamformer for the same number of other directions; it uses the same buffers."""

    def process(
        self,
        words: NDArray[np.unsignedinteger[Any]],
        out: NDArray[np.float32],
        *,
        threads: int | None = None,
        grid: Grid | None = None,
    ) -> None:
        """Compute the image of one measurement; parameters as for `Chain.process`."""
        threads = self._threads if threads is None else threads
        beamform = self._beamform_for(grid, threads)
        self._finish(self._begin(words, out, threads, beamform))  # `beamform` keeps its tables in memory until then.

    def _beamform_for(self, grid: Grid | None, threads: int) -> Beamform | PhaseShifts | None:
        """Return a beamformer for other directions; None for those of the chain."""
        if grid is None:
            return None
        with one_thread():
            return self._turned(grid, threads)

    def stream(self, words: NDArray[np.unsignedinteger[Any]]) -> WordStream:
        """Return a stream of words; ``words`` is an array for a whole measurement, (sample, word)."""
        if self._kernels.device == "cuda" or not isinstance(self._demodulate, DemodulatePdm):
            return WordStream()
        return WordStream(
            StreamedImage(
                self._demodulate,
                self._image,
                self._kernels,
                self._new_buffers(),
                words,
                self.new_image(),
                is_turned=self._is_turned,
            )
        )

    def process_streamed(
        self,
        stream: WordStream,
        words: NDArray[np.unsignedinteger[Any]],
        out: NDArray[np.float32],
        *,
        threads: int | None = None,
        grid: Grid | None = None,
    ) -> None:
        """Compute the image of a measurement whose words, or some of them, were added to a stream of this chain."""
        if not stream.is_of(self._demodulate):
            raise foreign_stream()
        threads = self._threads if threads is None else threads
        with self._kernels.threads(threads):  # An image that is complete already would need none.
            pass
        beamform = self._beamform_for(grid, threads)
        if not stream.process(words, out, functools.partial(self._image, beamform=beamform), threads=threads):
            self._finish(self._begin(words, out, threads, beamform))

    def process_batch(
        self, words: Iterable[NDArray[np.unsignedinteger[Any]]], outs: Iterable[NDArray[np.float32] | None]
    ) -> None:
        """Process measurements in GPU lanes, or on one thread each."""
        pairs = list(zip(words, outs, strict=True))
        if self._memory.n_lanes == 1:
            self._side_by_side(pairs)
            return
        under_way: deque[MeasurementBuffers] = deque()
        try:
            for each, out in pairs:
                if len(under_way) == self._memory.n_lanes:
                    self._finish(under_way.popleft())
                under_way.append(self._begin(each, out, self._threads))
        finally:
            while under_way:
                self._finish(under_way.popleft())

    def _side_by_side(self, pairs: list[tuple[NDArray[np.unsignedinteger[Any]], NDArray[np.float32] | None]]) -> None:
        """Process each measurement on one thread, because threads of one kernel wait for each other after each stage.

        Threads of one kernel would wait for each other after each stage.
        """
        if len(pairs) < self._threads or self._threads == 1:
            for each, out in pairs:
                self._finish(self._begin(each, out, self._threads))
        else:
            deque(self._executor.map(lambda pair: self._finish(self._begin(pair[0], pair[1], 1)), pairs), maxlen=0)

    @functools.cached_property
    def _executor(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._threads, thread_name_prefix="ertis-batch")

    def _forget_threads(self) -> None:
        self.__dict__.pop("_executor", None)

    def warm_up(self, words: NDArray[np.unsignedinteger[Any]]) -> None:
        """Process ``words`` once in every lane, which compiles kernels and allocates buffers."""
        images = [self.new_image() for _ in range(self._memory.n_lanes)]
        if len(images) == 1:
            self.process(words, images[0])
        else:
            self.process_batch([words] * len(images), images)

    def new_image(self) -> NDArray[np.float32]:
        """Return an uninitialised array for an image: (direction, range) float32."""
        return self._memory.image((len(self.grid), len(self.range_m)))

    def close(self) -> None:
        """Wait for measurements in progress, then free the memory of the device."""
        self._pool.close()
        filters = ("_made_unmodulated", "_made_plain_filter", "_matched_filter")
        for name in ("_demodulate", *filters, "_beamform"):
            self.__dict__.pop(name, None)
        self._memory.close()

    def _begin(
        self,
        words: NDArray[np.unsignedinteger[Any]],
        out: NDArray[np.float32] | None,
        threads: int,
        beamform: Beamform | PhaseShifts | None = None,
    ) -> MeasurementBuffers:
        """Start to process one measurement; its image is in ``out`` once the lane has finished."""
        with self._taken(threads) as buffers:
            here = buffers.lane.send(words)
            image = buffers.lane.target(self._no_image if out is None else out)

            def steps() -> None:
                self._demodulate(here, buffers.room, buffers.signals)
                self._image(buffers, image, threads, beamform)

            buffers.lane.run(steps)
            if out is not None:
                buffers.lane.fetch(image, out)
        return buffers

    def _finish(self, buffers: MeasurementBuffers) -> None:
        try:
            buffers.lane.wait()
        finally:
            self._pool.release(buffers)

    def _image(
        self,
        buffers: MeasurementBuffers,
        out: NDArray[np.float32],
        threads: int,
        beamform: Beamform | PhaseShifts | None = None,
    ) -> None:
        """Compute an image from the signals in buffers, with the beamformer of the chain by default."""
        beamform = beamform or self._beamform
        if isinstance(beamform, PhaseShifts):
            beamform(buffers.transforms, buffers.analytic, buffers.beamform, out, threads=threads)
        else:
            self._matched_filter(buffers.transforms, buffers.analytic, threads=threads)
            beamform(buffers.analytic, buffers.beamform, out)

    @contextmanager
    def _taken(self, threads: int) -> Iterator[MeasurementBuffers]:
        """Run the enclosed kernels on buffers that no other thread uses, until `_finish` releases them."""
        with self._pool.acquired(self._new_buffers) as buffers, self._kernels.threads(threads), buffers.lane.entered():
            yield buffers

    @functools.cached_property
    def _no_image(self) -> NDArray[np.float32]:
        """Zero-stride array in the shape of an image, for images that stay on a GPU."""
        return np.broadcast_to(np.float32(0), (len(self.grid), len(self.range_m)))

    def _new_buffers(self) -> MeasurementBuffers:
        memory, lane = self._memory, self._memory.lane()
        signals = memory.zeros(self._demodulate.shape, np.float32)
        shape = self._beamform.shape if isinstance(self._beamform, PhaseShifts) else self._matched_filter.shape
        analytic = memory.zeros(shape, np.complex64)
        transforms = fft.plan(self._kernels.transforms, signals, analytic, zeros=memory.zeros, stream=lane.stream)
        return MeasurementBuffers(
            lane, self._demodulate.new_room(), signals, analytic, transforms, self._beamform.new_buffers()
        )

"""Processing of a measurement while its words arrive."""

import math
import threading
from collections.abc import Callable
from time import perf_counter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.buffer_pool import MeasurementBuffers
from ertis_numba.chain.demodulate import DemodulatePdm
from ertis_numba.kernels import KernelSet

__all__ = ["StreamedImage", "WordStream", "foreign_stream"]

_STEP = 512  # Signal samples per call of the kernel: 5120 words by default, which arrive in about a millisecond.
# Share of the time until the last word that an image may take on one thread. `StreamedImage.add` runs in the thread
# that reads words, so a longer image would delay them, and other threads could not help with it.
_SHARE: Final = 0.75
_TIMED: Final = 2  # The first image also touches new memory.
_TIMED_AT_MOST: Final = 20
_TIMED_S: Final = 0.05


NewImage = Callable[[MeasurementBuffers, NDArray[np.float32], int], None]


class WordStream:
    """Words of a measurement that has not arrived completely, and the part of its image that depends on these only.

    Create it with `Pipeline.stream`. `Pipeline.process` uses it if the complete measurement begins with the same words.
    The image has the same bits as without a stream, whatever was added. One thread may add words while another
    processes a measurement.

    For GPUs, PCM and the paper's method in NumPy, a stream does nothing.
    """

    def __init__(self, image: "StreamedImage | None" = None) -> None:
        self._lock = threading.Lock()
        self._image = image

    def add(self, first: int, words: NDArray[np.unsignedinteger[Any]]) -> None:
        """Add words as they arrive, and process them on one thread.

        Parameters
        ----------
        first : int
            Number of the first of them in its measurement. With 0, another measurement begins.
        words : (sample,) unsigned integers
        """
        with self._lock:
            if self._image is not None:
                self._image.add(first, words)

    def is_of(self, demodulate: object) -> bool:
        """Return True if it demodulates with a stage, or does nothing."""
        return self._image is None or self._image.demodulate is demodulate

    def process(self, words: NDArray[Any], out: NDArray[np.float32], image: NewImage, *, threads: int) -> bool:
        """Fill ``out`` with the image of a measurement; return False if it begins with other words than were added.

        The function ``image`` computes the image from signals, as for `StreamedImage`.
        """
        with self._lock:
            return self._image is not None and self._image.complete(words, out, image, threads)


def foreign_stream() -> ArgumentError:
    """Return the error of a stream that was given to another pipeline."""
    return ArgumentError("stream belongs to another pipeline; create one with stream() of this pipeline")


class StreamedImage:
    """Image (direction, range) of a measurement whose words (sample, word) arrive in pieces."""

    def __init__(
        self,
        demodulate: DemodulatePdm,
        image: NewImage,
        kernels: KernelSet,
        buffers: MeasurementBuffers,
        words: NDArray[Any],
        amplitude: NDArray[np.float32],
        *,
        is_turned: bool = False,
    ) -> None:
        self.demodulate, self._image, self._kernels = demodulate, image, kernels
        self._buffers, self._words, self._amplitude = buffers, words, amplitude
        self._part = np.empty((demodulate.shape[0], _STEP), np.float32)
        self._n_words = self._n_first = self._n_done = 0
        self._is_done = False
        self._begun_s, self._image_s = 0.0, math.inf if is_turned else self._time_s()

    def add(self, first: int, words: NDArray[Any]) -> None:
        """Copy words, compute signals that depend on no later ones, and the image if it ends before the last words."""
        if first == 0:
            self._n_words = self._n_done = 0
            self._is_done = False
            self._begun_s = perf_counter()
        rows = words.reshape(-1, self._words.shape[1])
        if first != self._n_words or self._n_words + len(rows) > len(self._words):
            return  # Words are missing, so that the measurement is not one that was added from its beginning.
        self._words[first : first + len(rows)] = rows
        self._n_words += len(rows)
        self._n_first = self._n_words if first == 0 else self._n_first
        n_ready = self.demodulate.n_ready(self._n_words)
        if self._is_done or n_ready < min(self._n_done + _STEP, self.demodulate.n_signals):
            return
        with self._kernels.threads(1):  # The words arrive more slowly than one thread processes them.
            self._go_on(n_ready)
            if n_ready == self.demodulate.n_signals and self._image_s < _SHARE * self._left_s():
                self._go_on(self.demodulate.shape[1])
                self._image(self._buffers, self._amplitude, 1)
                self._is_done = True

    def _left_s(self) -> float:
        """Return the time until the last word, at the rate of those that have arrived after the first piece."""
        n_timed = self._n_words - self._n_first
        if not n_timed:
            return 0.0
        return (perf_counter() - self._begun_s) * (len(self._words) - self._n_words) / n_timed

    def _time_s(self) -> float:
        """Return the time of an image on one thread: the shortest of several, because other programs interrupt it."""
        times_s: list[float] = []
        with self._kernels.threads(1):
            while len(times_s) < _TIMED or (len(times_s) < _TIMED_AT_MOST and sum(times_s) < _TIMED_S):
                begun_s = perf_counter()
                self._image(self._buffers, self._amplitude, 1)
                times_s.append(perf_counter() - begun_s)
        return min(times_s)

    def complete(self, words: NDArray[Any], out: NDArray[np.float32], image: NewImage, threads: int) -> bool:
        """Fill ``out`` with the image of a whole measurement; return False if it begins with other words."""
        n_words, self._n_words = self._n_words, -1  # Only a new beginning can follow.
        if n_words <= 0 or not np.array_equal(words[:n_words], self._words[:n_words]):
            return False
        if self._is_done:
            np.copyto(out, self._amplitude)
            return True
        self._words[n_words:] = words[n_words:]
        with self._kernels.threads(threads):
            self._go_on(self.demodulate.shape[1])
            image(self._buffers, out, threads)
        return True

    def _go_on(self, stop: int) -> None:
        """Compute signal samples up to one, in equal steps except at the end."""
        signals = self._buffers.signals
        while self._n_done + _STEP <= stop or self._n_done < stop == signals.shape[1]:
            first, n_samples = self._n_done, min(_STEP, stop - self._n_done)
            self.demodulate.part(self._words, first, self._part)
            signals[:, first : first + n_samples] = self._part[:, :n_samples]
            self._n_done += n_samples

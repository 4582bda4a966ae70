"""A process that makes images: ``python -m ertis_numba.network.processing._worker DESCRIPTOR``."""

import faulthandler
import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from ertis_numba.errors import ArgumentError, DataError, DeviceError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.network.processing.child import pipe_of_child
from ertis_numba.network.processing.notes import (
    Failed,
    Forget,
    FromWorker,
    Made,
    Memory,
    Prepare,
    Prepared,
    Process,
    Ready,
    ToWorker,
    Unusable,
)
from ertis_numba.network.processing.slots import POINTS_BYTES, View
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    from ertis_numba.network.processing.pipe import Pipe
    from ertis_numba.stages.points import PointExtractor

_TIMED: Final = 5  # measurements, whose median counts
_NEGLECTED: Final = 3  # deadlines after which a worker that hangs ends by itself, where nobody is left to kill it


class _Chain:
    """A pipeline, and what goes with it."""

    def __init__(self, settings: str, device: str, dtype: str) -> None:
        from ertis_numba.pipeline import Pipeline  # noqa: PLC0415  in this process alone

        self.settings = Settings.from_toml(settings, "settings of a sensor")
        self.pipeline: Pipeline = Pipeline(self.settings, device=device)
        layout = microphones(self.settings.array)
        self._dtype = np.dtype(f"<u{layout.word_bits // 8}")
        self._words_shape = (self.settings.recording.n_samples, layout.n_words)[: 1 + (layout.n_words > 1)]
        self._image_dtype = dtype
        self.shape = (len(self.pipeline.grid), len(self.pipeline.range_m))
        self._image = None if dtype == "float32" else np.empty(self.shape, np.float32)
        self._extractor: PointExtractor | None = None

    def __call__(self, view: View, order: Process) -> int:
        """Make the image, and the points, of which there are that many."""
        words = view.words(order.words_bytes)
        if len(words) != int(np.prod(self._words_shape)) * self._dtype.itemsize:
            raise DataError(f"a measurement has {len(words)} bytes, which its settings do not say; say Hello again")
        measurement = Measurement(np.frombuffer(words, self._dtype).reshape(self._words_shape), self.pipeline.settings)
        place = view.image_as(self.shape, self._image_dtype)
        image = self.pipeline.process(measurement, place if self._image is None else self._image, threads=order.threads)
        if self._image is not None:
            np.copyto(place, self._image, casting="same_kind")
        if not order.points:
            return 0
        if self._extractor is None:
            from ertis_numba.stages.points import PointExtractor  # noqa: PLC0415  only where somebody wants points

            self._extractor = PointExtractor(self.pipeline.settings)
        cloud = self._extractor(image)
        rows = np.column_stack([cloud.position_m, cloud.energy]).astype("<f4")[: POINTS_BYTES // 16]
        view.points(rows.nbytes)[:] = rows.tobytes()
        return len(rows)

    def times_s(self, threads: int, at_once: int) -> tuple[float, float]:
        """Return how long one measurement takes on all threads, and as one of several at once that share them."""
        silence = Measurement(np.zeros(self._words_shape, self._dtype), self.pipeline.settings)
        out = np.empty(self.shape, np.float32)
        wide_s = _median_s(lambda: self.pipeline.process(silence, out, threads=threads))
        if at_once == 1:
            return wide_s, wide_s
        share = max(1, threads // at_once)
        return wide_s, _median_s(lambda: self.pipeline.process(silence, out, threads=share))

    def prepared(self, order: Prepare, threads: int, at_once: int) -> Prepared:
        """Return what the central node needs to know of it."""
        wide_s, many_s = self.times_s(threads, at_once) if order.measure else (0.0, 0.0)
        axes = (self.pipeline.grid.azimuth_rad, self.pipeline.grid.elevation_rad, self.pipeline.range_m)
        azimuth_rad, elevation_rad, range_m = (axis.astype("<f8").tobytes() for axis in axes)
        return Prepared(
            kind=order.kind,
            settings=self.pipeline.settings.to_toml(),
            azimuth_rad=azimuth_rad,
            elevation_rad=elevation_rad,
            range_m=range_m,
            shape=self.shape,
            wide_s=wide_s,
            many_s=many_s,
        )


def _median_s(work: Callable[[], object]) -> float:
    took_s = []
    for _ in range(_TIMED + 1):
        begun_s = time.perf_counter()
        work()
        took_s.append(time.perf_counter() - begun_s)
    return statistics.median(took_s[1:])


class _Worker:
    def __init__(self, pipe: "Pipe[ToWorker]", arguments: list[str]) -> None:
        self._pipe = pipe
        self._device, self._dtype = arguments[2:4]
        self._threads, self._at_once = int(arguments[4]), int(arguments[5])
        self._deadline_s = float(arguments[6])
        self._views: dict[int, View] = {}
        self._chains: dict[int, _Chain] = {}

    def run(self) -> None:
        from ertis_numba import kernels  # noqa: PLC0415  in this process alone

        try:
            loaded: kernels.KernelSet | None = kernels.load(self._device)
        except DeviceError:  # which making the pipeline says again, then it can be told
            loaded = None
        most = 1 if loaded is None else loaded.max_threads
        self._threads = min(self._threads, most)
        self._pipe.send(Ready(device=self._device if loaded is None else loaded.device, threads=most))
        while not self._pipe.closed:
            self._pipe.wait(None)
            for order in self._pipe.receive():
                self._obey(order)

    def _obey(self, order: ToWorker) -> None:
        match order:
            case Memory():
                descriptor = self._pipe.files.popleft()
                self._views[order.slot] = View(descriptor, order.words_bytes, order.image_bytes)
                os.close(descriptor)
            case Prepare():
                self._pipe.send(self._prepared(order))
            case Forget():
                if (chain := self._chains.pop(order.kind, None)) is not None:
                    chain.pipeline.close()
            case Process():
                self._pipe.send(self._processed(order))

    def _prepared(self, order: Prepare) -> FromWorker:
        try:
            chain = _Chain(order.settings, self._device, self._dtype)
            told = chain.prepared(order, self._threads, self._at_once)
        except (ArgumentError, DataError, DeviceError, MemoryError) as error:
            return Unusable(kind=order.kind, text=str(error) or type(error).__name__)
        self._chains[order.kind] = chain
        return told

    def _processed(self, order: Process) -> FromWorker:
        begun_s = time.perf_counter()
        faulthandler.dump_traceback_later(_NEGLECTED * self._deadline_s, exit=True)
        try:
            n_points = self._chains[order.kind](self._views[order.slot], order)
        except DataError as error:
            return Failed(job=order.job, text=str(error), again=False)
        except Exception as error:  # noqa: BLE001  a mistake in one measurement's way must not end the others'
            return Failed(job=order.job, text=f"{type(error).__name__}: {error}", again=True)
        finally:
            faulthandler.cancel_dump_traceback_later()
        return Made(job=order.job, took_s=time.perf_counter() - begun_s, n_points=n_points)


if __name__ == "__main__":
    _Worker(pipe_of_child(sys.argv, ToWorker), sys.argv).run()

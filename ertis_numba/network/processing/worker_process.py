"""Worker process that makes images; `LocalWorkerPool` starts it."""

import faulthandler
import functools
import os
import signal
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from ertis_numba.base.errors import ArgumentError, DataError, DeviceError
from ertis_numba.frames import Measurement
from ertis_numba.frames.level_codes import LevelCodes, as_dtype
from ertis_numba.network.processing._predictions import Predictions
from ertis_numba.network.processing.pipe_messages import (
    FromWorker,
    JobFailed,
    JobFinished,
    Prepare,
    ProcessJob,
    Ready,
    Release,
    SlotMemory,
    StartWorker,
    ToWorker,
    Unusable,
)
from ertis_numba.network.processing.shared_slots import POINTS_BYTES, SlotView
from ertis_numba.processes import connect

__all__ = ["end_after"]

if TYPE_CHECKING:
    from ertis_numba.network.processing.shared_pipeline import SharedPipeline
    from ertis_numba.processes import Pipe

_DRAIN_S: Final = 0.1
# Number of deadlines after which a hanging worker ends by itself, if no process is left to kill it.
_NEGLECTED: Final = 3


class _ImageWorker:
    def __init__(self, pipe: "Pipe[ToWorker]", given: StartWorker) -> None:
        self._pipe, self._given, self._threads = pipe, given, given.threads
        self._views: dict[int, SlotView] = {}
        self._chains: dict[int, SharedPipeline] = {}
        self._predictions = Predictions(given.device)

    def run(self) -> None:
        # In this process alone, and before it is ready, so that the first sensor does not wait for imports.
        from ertis_numba import kernels  # noqa: PLC0415
        from ertis_numba.kernels.fft import _scipy  # noqa: F401, PLC0415
        from ertis_numba.network.processing import shared_pipeline  # noqa: F401, PLC0415

        try:
            loaded: kernels.KernelSet | None = kernels.load(self._given.device)
        except DeviceError:  # Creating the pipeline raises it again, at a time when it can be reported.
            loaded = None
        largest = 1 if loaded is None else loaded.max_threads
        self._threads = min(self._threads, largest)
        self._pipe.send(Ready(device=self._given.device if loaded is None else loaded.device, threads=largest))
        while not self._pipe.closed:
            self._pipe.wait(_DRAIN_S if self._predictions.busy else None)
            for order in self._pipe.receive():
                self._obey(order)
            for prediction in self._predictions.drain():
                self._pipe.send(prediction)

    def _obey(self, order: ToWorker) -> None:
        match order:
            case SlotMemory():
                descriptor = self._pipe.files.popleft()
                self._views[order.slot] = SlotView(descriptor, order.words_bytes, order.image_bytes)
                os.close(descriptor)
            case Prepare():
                self._pipe.send(self._prepared(order))
            case Release():
                if (chain := self._chains.pop(order.kind, None)) is not None:
                    chain.pipeline.close()
            case ProcessJob():
                self._pipe.send(self._processed(order))

    def _prepared(self, order: Prepare) -> FromWorker:
        from ertis_numba.network.processing.shared_pipeline import SharedPipeline  # noqa: PLC0415  in this process alone

        try:
            chain = SharedPipeline(order.settings, self._given.device, self._given.plan)
            times_s = chain.times_s(self._threads, self._given.at_once) if order.measure else (0.0, 0.0)
            reported = chain.prepared(order.kind, *times_s)
        except (ArgumentError, DataError, DeviceError, MemoryError) as error:
            return Unusable(kind=order.kind, text=str(error) or type(error).__name__)
        self._chains[order.kind] = chain
        return reported

    def _processed(self, order: ProcessJob) -> FromWorker:
        begun_s = time.perf_counter()
        end_after(_NEGLECTED * self._given.deadline_s)
        try:
            n_points, levels = self._made(self._chains[order.kind], self._views[order.slot], order)
        except DataError as error:
            return JobFailed(job=order.job, text=str(error), again=False)
        except Exception as error:  # noqa: BLE001  a mistake in one measurement's way must not end the others'
            return JobFailed(job=order.job, text=f"{type(error).__name__}: {error}", again=True)
        finally:
            end_after(0)
        return JobFinished(job=order.job, took_s=time.perf_counter() - begun_s, n_points=n_points, levels=levels)

    def _made(self, chain: "SharedPipeline", view: SlotView, order: ProcessJob) -> tuple[int, LevelCodes | None]:
        """Make the image in its slot, and the points; return the number of points, and the scale of 8-bit levels."""
        place = view.image_as(chain.shape, self._given.dtype)
        words = view.words(order.words_bytes)
        image = chain.image(words, place if self._given.dtype == "float32" else None, threads=order.threads)
        if order.check_sound:
            measurement, whole = Measurement(chain.format.from_bytes(bytes(words)), image.settings), None
            if order.predict and image.settings.processing.is_cleaned:  # A prediction needs all amplitudes.
                whole = chain.pipeline.process(measurement, clean=False, threads=order.threads)
            elif order.predict:
                whole = image.replace(amplitude=image.amplitude.copy())
            self._predictions.add(order.sensor, whole, measurement)
        levels = None
        if self._given.dtype != "float32":
            stored, levels = as_dtype(image.amplitude, self._given.dtype)
            np.copyto(place, stored)
        if not order.points:
            return 0, levels
        points = chain.points(image, POINTS_BYTES // 16)
        view.points(points.nbytes)[:] = points.tobytes()
        return len(points), levels


def end_after(time_s: float) -> None:
    """End this process after a time, with a traceback on stderr; 0 cancels that."""
    # A timer of the system costs a hundredth of `faulthandler.dump_traceback_later`.
    if hasattr(signal, "setitimer"):
        _arm()
        signal.setitimer(signal.ITIMER_REAL, time_s)
    elif time_s:
        faulthandler.dump_traceback_later(time_s, exit=True)
    else:
        faulthandler.cancel_dump_traceback_later()


@functools.cache
def _arm() -> None:
    """Let the signal of the timer print a traceback and end this process, even if the parent ignores or blocks it."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    faulthandler.register(signal.SIGALRM, chain=True)  # The default action follows, which ends the process.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGALRM})


def _main() -> None:
    pipe: Pipe[ToWorker] = connect(ToWorker)
    given = next(pipe.messages(), None)
    if isinstance(given, StartWorker):
        _ImageWorker(pipe, given).run()


if __name__ == "__main__":
    _main()

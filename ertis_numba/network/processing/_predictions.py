"""Checks of measurements and images in a worker: one thread runs them while the worker makes further images."""

import os
import sys
import threading
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Literal

from ertis_numba.network.processing.pipe_messages import Predicted

if TYPE_CHECKING:
    from ertis_numba.analysis.sound_checks import SoundChecks, Subject
    from ertis_numba.frames import Energyscape, Measurement
    from ertis_numba.settings import Array, Call

__all__ = ["Predictions"]

_EVENTS: Final[dict["Subject", Literal["call_mismatch", "start_mismatch", "layout_mismatch", "sample_fault"]]] = {
    "call": "call_mismatch",
    "start": "start_mismatch",
    "layout": "layout_mismatch",
    "samples": "sample_fault",
}
_NICE: Final = 10  # A tenth of the time of another thread, so that warnings appear even on a busy machine.


class Predictions:
    """Checks of some measurements, one at a time; busy until a prediction is finished and drained."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._waiting: deque[tuple[str, Energyscape | None, Measurement]] = deque()
        self._found: deque[Predicted] = deque()
        self._thread: threading.Thread | None = None
        self._checks: dict[str, tuple[Call, Array, SoundChecks]] = {}

    @property
    def busy(self) -> bool:
        """True while a prediction is not finished, or not yet drained."""
        return bool(self._waiting or self._found or self._thread)

    def add(self, sensor: str, image: "Energyscape | None", measurement: "Measurement") -> None:
        """Check a measurement of a sensor, and predict the error of its image, if any; the arrays must not change."""
        self._waiting.append((sensor, image, measurement))

    def drain(self) -> list[Predicted]:
        """Return finished predictions, and start the next one."""
        if self._thread is not None and not self._thread.is_alive():
            self._thread = None
        if self._thread is None and self._waiting:
            self._thread = threading.Thread(target=self._predict, args=self._waiting.popleft(), daemon=True)
            self._thread.start()
        found = []
        while self._found:
            found.append(self._found.popleft())
        return found

    def _report_sound(self, sensor: str, measurement: "Measurement") -> None:
        """Report sound that contradicts the settings."""
        from ertis_numba.analysis.sound_checks import SoundChecks  # noqa: PLC0415

        try:
            call, array = measurement.settings.call, measurement.settings.array
            known = self._checks.get(sensor)
            if known is None or known[:2] != (call, array):
                known = self._checks[sensor] = (call, array, SoundChecks(thinned=False, live=True))
            for subject, text in known[2].check(measurement):
                self._found.append(Predicted(sensor=sensor, event=_EVENTS[subject], warning=text))
        except Exception as error:  # noqa: BLE001  a failed check must not end a worker that makes images
            text = f"the sound was not compared with the settings: {type(error).__name__}: {error}"
            self._found.append(Predicted(sensor=sensor, event="check_failed", warning=text))

    def _report_grid(self, sensor: str, image: "Energyscape") -> None:
        """Report directions that are too far apart for the array."""
        from ertis_numba.analysis.direction_spacing import spacing_warning  # noqa: PLC0415

        try:
            text = spacing_warning(image.settings, image)
        except Exception as error:  # noqa: BLE001  a failed check must not end a worker that makes images
            text = f"directions were not compared with the array: {type(error).__name__}: {error}"
        if text:
            self._found.append(Predicted(sensor=sensor, event="coarse_grid", warning=text))

    def _predict(self, sensor: str, image: "Energyscape | None", measurement: "Measurement") -> None:
        _yield_to_images()
        if image is not None:
            self._report_grid(sensor, image)
        self._report_sound(sensor, measurement)
        if image is not None:
            self._report_error(sensor, image, measurement)

    def _report_error(self, sensor: str, image: "Energyscape", measurement: "Measurement") -> None:
        """Report an image that may exceed its error budget."""
        if image.settings.processing.method == "paper" or not image.amplitude.any():
            return  # The paper's method has no plan, and silence no relative error.
        from ertis_numba import kernels  # noqa: PLC0415  in a process that has loaded them
        from ertis_numba.pipeline.prediction import MAX_MEMORY_BYTES, memory_bytes, planner_of, predict  # noqa: PLC0415

        try:
            needed = memory_bytes(image)
            if needed > MAX_MEMORY_BYTES:
                text = f"the error of images was not predicted: that would need {needed / 1e6:.0f} MB"
            else:
                text = predict(planner_of(image, measurement, kernels.load(self._device), threads=1), image).warning
        except Exception as error:  # noqa: BLE001  a failed prediction must not end a worker that makes images
            text = f"the error of images was not predicted: {type(error).__name__}: {error}"
        if text:
            self._found.append(Predicted(sensor=sensor, event="error_budget", warning=text))


def _yield_to_images() -> None:
    """Give this thread a low priority: a check takes as much processor time as a hundred images."""
    if sys.platform == "linux":  # Elsewhere, only processes have priorities.
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)

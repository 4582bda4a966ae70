"""Checks of the images of a pipeline: coarse directions, sound that contradicts the settings, and errors."""

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ertis_numba.analysis.direction_spacing import spacing_warning
from ertis_numba.analysis.sound_checks import SoundChecks, Subject
from ertis_numba.base.errors import (
    CallMismatchWarning,
    CoarseGridWarning,
    DeviceError,
    ErrorBudgetWarning,
    LayoutMismatchWarning,
    SampleFaultWarning,
    StartMismatchWarning,
)
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.kernels import KernelSet
from ertis_numba.pipeline.prediction import BudgetMonitor
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    from ertis_numba.pipeline.prediction import Prediction

__all__ = ["ImageChecks"]

_CATEGORIES: Final[dict[Subject, type[UserWarning]]] = {
    "call": CallMismatchWarning,
    "start": StartMismatchWarning,
    "layout": LayoutMismatchWarning,
    "samples": SampleFaultWarning,
}
_CALLER: Final = 5  # Frames from a warning to the caller of `Pipeline.process`.


class ImageChecks:
    """Checks of images, each with at most one warning; none of simulated kernels, whose predictions take minutes."""

    def __init__(self, settings: Settings, kernel_set: KernelSet, *, threads: int) -> None:
        self._settings = settings
        has_budget = settings.processing.method == "fast" and not kernel_set.simulated
        self._monitor = BudgetMonitor(kernel_set, threads) if has_budget else None
        self._warned = False
        self._is_grid_checked = kernel_set.simulated
        self._sound = None if kernel_set.simulated else SoundChecks()

    @property
    def prediction(self) -> "Prediction | None":
        """Latest predicted error and its budget; None before the first image with sound."""
        return None if self._monitor is None else self._monitor.prediction

    def check(self, image: Energyscape, measurement: Measurement) -> None:
        """Check an image, before it is cleaned, its directions, and its measurement."""
        self._check_grid(image)
        self._check_sound(measurement)
        self._check_budget(image, measurement)

    def _check_grid(self, image: Energyscape) -> None:
        """Compare the directions of the first image with the array."""
        if self._is_grid_checked:
            return
        self._is_grid_checked = True
        text = spacing_warning(self._settings, image)
        if text is not None:
            warnings.warn(text, CoarseGridWarning, stacklevel=_CALLER)

    def _check_sound(self, measurement: Measurement) -> None:
        """Compare the sound of a measurement with the settings."""
        if self._sound is None:
            return
        for subject, text in self._sound.check(replace(measurement, settings=self._settings)):
            warnings.warn(text, _CATEGORIES[subject], stacklevel=_CALLER)

    def _check_budget(self, image: Energyscape, measurement: Measurement) -> None:
        """Predict the error of an image if it needs a prediction, and issue the warning once."""
        if self._monitor is None or self._warned:
            return
        try:
            prediction = self._monitor.check(image, measurement)
            text = prediction.warning if prediction else ""
        except DeviceError as error:
            text = f"the error of images cannot be predicted: {error}"
        if text:
            self._warned = True
            warnings.warn(text, ErrorBudgetWarning, stacklevel=_CALLER)

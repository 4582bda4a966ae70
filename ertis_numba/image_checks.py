"""Checks of the images of a pipeline: echoes that do not match the call, and errors beyond the budget."""

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ertis_numba.analysis.call_match import call_match
from ertis_numba.errors import CallMismatchWarning, DeviceError, ErrorBudgetWarning
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.kernels import KernelSet
from ertis_numba.prediction import BudgetMonitor
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    from ertis_numba.prediction import Prediction

__all__ = ["ImageChecks"]

_CALL_CHECKS: Final = 8
_CALLER: Final = 5  # Frames from a warning to the caller of `Pipeline.process`.


class ImageChecks:
    """Checks of the images of one pipeline, each of which issues at most one warning.

    Simulated kernels would take minutes for a prediction, so that their images are not checked.

    Parameters
    ----------
    settings : Settings
        Settings with the complete plan.
    kernel_set : KernelSet
    threads : int
        Number of threads for predictions.
    """

    def __init__(self, settings: Settings, kernel_set: KernelSet, *, threads: int) -> None:
        self._settings = settings
        has_budget = settings.processing.method == "fast" and not kernel_set.simulated
        self._monitor = BudgetMonitor(kernel_set, threads) if has_budget else None
        self._warned = False
        self._remaining_call_checks = 0 if kernel_set.simulated else _CALL_CHECKS

    @property
    def prediction(self) -> "Prediction | None":
        """Latest predicted error and its budget; None before the first image with sound."""
        return None if self._monitor is None else self._monitor.prediction

    def check(self, image: Energyscape, measurement: Measurement) -> None:
        """Check an image, before it is cleaned, and its measurement."""
        self._check_call(measurement)
        self._check_budget(image, measurement)

    def _check_call(self, measurement: Measurement) -> None:
        """Compare echoes with the call in the first measurements, until one has sound above the noise."""
        if self._remaining_call_checks <= 0:
            return
        self._remaining_call_checks -= 1
        match = call_match(replace(measurement, settings=self._settings))
        if match is not None:
            self._remaining_call_checks = 0
            if match.warning:
                warnings.warn(match.warning, CallMismatchWarning, stacklevel=_CALLER)

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

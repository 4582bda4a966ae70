"""Error predicted for a plan from one measurement, and the warning if it may exceed the budget."""

from dataclasses import dataclass
from typing import Final, TypedDict

from ertis_numba.frames import Measurement
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import Settings
from ertis_numba.stages.fast import FastChain
from ertis_numba.stages.planner import Planner
from ertis_numba.stages.sensitivity import Sensitivity
from ertis_numba.stages.texture import texture_of
from ertis_numba.words import word_format

__all__ = ["Noted", "Prediction", "planner_of", "predict"]

UNCERTAINTY_DB: Final = 1.0
"""Largest amount by which a prediction may be too low: see tests/test_accuracy.py."""
ADAPTIVE_UNCERTAINTY_DB: Final = 15.0
"""The same for beamformers that are not linear: too low by up to 13.3 dB over random settings of `ertis bench budgets`.

Errors of delays are alike over range and between directions, so independent errors of weights underestimate them.
"""

_MOST_BEAMS = 128


class Noted(TypedDict):
    """Prediction as files and reports hold it."""

    predicted_error_db: float
    max_error_db: float
    error_warning: str


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted and permitted error of the images of a sensor.

    Attributes
    ----------
    predicted_error_db : float
        Error of the first measurement's image relative to the exact image, by the error model.
    max_error_db : float
        The budget.
    uncertainty_db : float
        Largest amount by which the prediction may be too low.
    """

    predicted_error_db: float
    max_error_db: float
    uncertainty_db: float = UNCERTAINTY_DB

    def as_dict(self) -> Noted:
        """Return the prediction in the form for files and reports."""
        return {
            "predicted_error_db": self.predicted_error_db,
            "max_error_db": self.max_error_db,
            "error_warning": self.warning,
        }

    @property
    def warning(self) -> str:
        """Warning in one line; empty if the budget is kept."""
        if self.predicted_error_db + self.uncertainty_db <= self.max_error_db:
            return ""
        return (
            f"images may exceed the error budget: predicted {self.predicted_error_db:.1f} dB "
            f"(± {self.uncertainty_db:g} dB), accuracy.max_error_db is {self.max_error_db:g} dB; measure the error "
            "with --verify, or give a lower --max-error"
        )


def planner_of(measurement: Measurement, settings: Settings, kernels: KernelSet, *, threads: int) -> Planner:
    """Return a planner with the signal model of a measurement, and with its sensitivity for adaptive beamformers.

    Parameters
    ----------
    measurement : Measurement
    settings : Settings
        A complete plan.
    kernels : KernelSet
    threads : int
    """
    texture = texture_of(measurement, settings, kernels, threads=threads)
    if settings.processing.beamformer == "delay_and_sum":
        return Planner(settings, kernels, threads=threads, texture=texture)
    linear = Planner(settings, kernels, threads=threads, texture=texture, sensitivity=Sensitivity())
    beams = sum(linear.chosen(settings.accuracy).parts.values())
    # A perturbation of weights by this power makes the beams of delay-and-sum err by as much as predicted.
    share = 0.5 if texture.gain <= 1 else 1 - 0.5 / texture.gain
    form = word_format(settings)
    words, _ = form.normalised(form.checked(measurement.words))
    chain = FastChain(settings, kernels, threads=threads)
    try:
        image = chain.sensitivity(words, min(1.0, beams * texture.gain / share), most_beams=_MOST_BEAMS)
    finally:
        chain.close()
    return Planner(settings, kernels, threads=threads, texture=texture, sensitivity=Sensitivity(image / beams))


def predict(planner: Planner, settings: Settings) -> Prediction:
    """Return a planner's prediction for a complete plan, with the budget."""
    adaptive = settings.processing.beamformer != "delay_and_sum"
    return Prediction(
        predicted_error_db=round(planner.chosen(settings.accuracy).error_db, 2),
        max_error_db=settings.accuracy.max_error_db,
        uncertainty_db=ADAPTIVE_UNCERTAINTY_DB if adaptive else UNCERTAINTY_DB,
    )

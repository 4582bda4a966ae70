"""Predicted error of the images of a sensor, and the warning if it may exceed the budget."""

import math
from dataclasses import dataclass, replace
from typing import Final, TypedDict

import numpy as np

from ertis_numba.analysis.noise import threshold_of
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.base.errors import DataError
from ertis_numba.base.forks import ForkSafeLock
from ertis_numba.chain.plan_model import TABLE_BYTES
from ertis_numba.chain.planner import BudgetScope, Planner
from ertis_numba.chain.sensitivity import Sensitivity
from ertis_numba.chain.signal_model import ROUGH_DELAY_TAPS, ROUGH_ZONES, signal_model_of
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.geometry import microphones
from ertis_numba.kernels import KernelSet

__all__ = [
    "MAX_MEMORY_BYTES",
    "BudgetMonitor",
    "BudgetScope",
    "Prediction",
    "PredictionDict",
    "memory_bytes",
    "planner_of",
    "predict",
    "relative_to_exact_db",
]

UNCERTAINTY_DB: Final = 1.0
"""Largest amount by which the prediction for a large image may be too low: see tests/chain/test_accuracy.py."""
ADAPTIVE_UNCERTAINTY_DB: Final = 2.0
"""The same for adaptive beamformers, whose error is measured in a sample of the directions.

From 32 directions, it was too low by up to 1.6 dB over 156 random settings of `ertis bench budgets`.
"""

MAX_MEMORY_BYTES: Final = 2**28
"""Limit on the memory for a prediction of real-time images."""

_MAX_DIRECTIONS: Final = 64
_SPREAD_DB: Final = 0.25  # Smaller effects of the number of image points are within the uncertainty.
_MAX_SHARE: Final = 0.999  # Largest share of the error in the power of an image.
_FAINTER_RATIO: Final = 0.1
_ROWS: Final = 16


class PredictionDict(TypedDict):
    """Prediction as files and reports hold it."""

    predicted_error_db: float
    max_error_db: float
    budget_applies_to: BudgetScope
    error_warning: str


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted error of a measurement's image relative to the exact image, and the budget.

    The error model predicts it for delay-and-sum; for adaptive beamformers, it is measured in a sample of the
    directions. ``uncertainty_db`` is the largest amount by which it may be too low. The budget applies to ``echoes`` if
    images of noise, or of many overlapping echoes, may exceed that of an adaptive beamformer with streams; to ``beams``
    if no plan keeps it for images of one, and the plan keeps it for the delay-and-sum beams of the same signals.
    ``has_echoes`` is False if the budget is exceeded and no echo exceeds the noise of the image.
    """

    predicted_error_db: float
    max_error_db: float
    uncertainty_db: float = UNCERTAINTY_DB
    budget_applies_to: BudgetScope = "image"
    beamformer: str = "delay_and_sum"
    has_echoes: bool = True

    def as_dict(self) -> PredictionDict:
        """Return the prediction in the form for files and reports."""
        return {
            "predicted_error_db": self.predicted_error_db,
            "max_error_db": self.max_error_db,
            "budget_applies_to": self.budget_applies_to,
            "error_warning": self.warning,
        }

    @property
    def warning(self) -> str:
        """Warning in one line; empty if the budget is kept."""
        if self.predicted_error_db + self.uncertainty_db <= self.max_error_db:
            return ""
        highest_db = self.predicted_error_db + self.uncertainty_db
        if not self.has_echoes and highest_db >= 0:
            return "no echo was heard above the noise; most of the image is the error of the plan, not this noise"
        if not self.has_echoes:
            return (
                f"no echo was heard above the noise; the image shows this noise with an error of up to "
                f"{highest_db:.1f} dB relative to it"
            )
        scope = ""
        if self.budget_applies_to == "beams":
            scope = f"; the plan keeps the budget for delay-and-sum beams only, not for images of {self.beamformer}"
        elif self.budget_applies_to == "echoes":
            scope = (
                f"; the plan keeps the budget of {self.beamformer} for separate echoes only, not for noise or dense "
                "echoes"
            )
        return (
            f"images may exceed the error budget: predicted {self.predicted_error_db:.1f} dB "
            f"(up to {self.uncertainty_db:g} dB more), accuracy.max_error_db is {self.max_error_db:g} dB{scope}"
        )


def planner_of(image: Energyscape, measurement: Measurement, kernels: KernelSet, *, threads: int) -> Planner:
    """Return a planner with the signal model of a measurement, and with its sensitivity for adaptive beamformers."""
    # The sensitivity is the measured error power of a sample / that predicted for delay-and-sum beams.
    settings = image.settings
    adaptive = settings.processing.is_adaptive
    amplitude = None if adaptive else image.amplitude
    signal_model = signal_model_of(measurement, settings, kernels, threads=threads, amplitude=amplitude)
    if not adaptive:
        return Planner(settings, kernels, threads=threads, signal_model=signal_model)
    # Imported here because it takes 0.1 s, and other images need none of it.
    from ertis_numba.pipeline.verification import sampled_error_db  # noqa: PLC0415

    beams = Planner(settings, kernels, threads=threads, signal_model=signal_model, sensitivity=Sensitivity())
    try:
        error_db = sampled_error_db(image, measurement, max_directions=_MAX_DIRECTIONS)
    except DataError:  # The exact image has no sound there, so that its error is undefined.
        return beams
    power = sum(beams.parts(settings.accuracy).values())
    sensitivity = Sensitivity(10 ** (error_db / 10) / power)
    return Planner(settings, kernels, threads=threads, signal_model=signal_model, sensitivity=sensitivity)


def predict(planner: Planner, image: Energyscape | None = None) -> Prediction:
    """Return a planner's prediction for its complete plan, with the budget."""
    settings = planner.settings
    processing = settings.processing
    uncertainty_db = ADAPTIVE_UNCERTAINTY_DB
    if not processing.is_adaptive:
        # The mean power of few independent errors differs from its expectation, by up to three standard deviations.
        spread_db = 10 * math.log10(1 + 3 / math.sqrt(planner.n_independent))
        uncertainty_db = UNCERTAINTY_DB + (round(spread_db, 1) if spread_db > _SPREAD_DB else 0.0)
    predicted_db = planner.error_db(settings.accuracy)
    if image is not None and not processing.is_adaptive:
        # The power of the image contains that of its error, which matters for errors above -15 dB.
        highest_db = relative_to_exact_db(predicted_db + uncertainty_db)
        predicted_db = relative_to_exact_db(predicted_db)
        uncertainty_db = round(highest_db - predicted_db, 1)
    weighted = "" if processing.weighting == "none" else f" with {processing.weighting}"
    found = Prediction(
        predicted_error_db=round(predicted_db, 2),
        max_error_db=settings.accuracy.max_error_db,
        uncertainty_db=uncertainty_db,
        budget_applies_to=planner.budget_scope(settings.accuracy),
        beamformer=f"{processing.beamformer}{weighted}",
    )
    if image is None or not found.warning:
        return found
    return replace(found, has_echoes=bool(image.amplitude.max(initial=0.0) > threshold_of(image, FALSE_ALARM)))


def relative_to_exact_db(error_db: float) -> float:
    """Return an error relative to an image without it, from that relative to the image with it."""
    share = min(10 ** (error_db / 10), _MAX_SHARE)
    return 10 * math.log10(share / (1 - share)) if share > 0 else error_db


def memory_bytes(image: Energyscape) -> int:
    """Return an estimate of the memory for a prediction: squares of an image, and tables of a rough one."""
    settings, table = image.settings, 0
    if settings.processing.is_adaptive:
        n_mics = int(microphones(settings.array).enabled.sum())
        n_zones = 1 if settings.processing.wavefront == "plane" else ROUGH_ZONES
        table = TABLE_BYTES * len(image.amplitude) * n_mics * ROUGH_DELAY_TAPS * n_zones
    return table + 20 * image.amplitude.size


class BudgetMonitor:
    """Prediction for the first image, and for each that is 10 dB fainter than all predicted before; thread-safe."""

    # Relative errors grow as images become fainter. `prediction` is None before the first image that is not silent.

    def __init__(self, kernels: KernelSet, threads: int) -> None:
        self._kernels, self._threads = kernels, threads
        self._lock = ForkSafeLock()
        self._faintest = float("inf")
        self.prediction: Prediction | None = None

    def check(self, image: Energyscape, measurement: Measurement) -> Prediction | None:
        """Return a new prediction if the image needs one."""
        rows = image.amplitude[:: max(1, len(image.amplitude) // _ROWS)]
        level = float(np.vdot(rows, rows)) / rows.size
        if not 0 < level < _FAINTER_RATIO * self._faintest or memory_bytes(image) > MAX_MEMORY_BYTES:
            return None
        with self._lock:
            if not level < _FAINTER_RATIO * self._faintest:
                return None
            self._faintest = level
            self.prediction = predict(planner_of(image, measurement, self._kernels, threads=self._threads), image)
            return self.prediction

"""Measured times and levels, and expected deviations: the input of the fits."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Observations", "Tolerances"]


class Tolerances(NamedTuple):
    """Standard deviations that are expected before the calibration."""

    gain_db: float
    delay_s: float
    position_m: float  # along each axis; 0 if the layout is exact
    model_s: float = 0.0  # errors of the model, as by the air, the emitter's place and the reflector's shape
    model_db: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Times of arrival in some recordings; arrays are (record, mic)."""

    time_s: NDArray[np.float64]
    time_sd_s: NDArray[np.float64]  # infinite for values that are left out
    noise_s: NDArray[np.float64]  # (record,), by noise alone, in the median microphone
    level: NDArray[np.float64]  # only ratios within a recording matter
    level_sd: NDArray[np.float64]  # relative; infinite for values that are left out

"""Measured times and levels, and expected deviations: the input of the fits."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Observations", "Tolerances"]


class Tolerances(NamedTuple):
    """Standard deviations that are expected before the calibration.

    Attributes
    ----------
    gain_db : float
        Of gains, in decibels.
    delay_s : float
        Of delays, in seconds.
    position_m : float
        Of positions along each axis, in metres; 0 if the positions of the layout are exact.
    model_s, model_db : float
        Of errors of the model of times and levels, such as by the air, the emitter's place and the reflector's shape.
    """

    gain_db: float
    delay_s: float
    position_m: float
    model_s: float = 0.0
    model_db: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Times of arrival in some recordings.

    Attributes
    ----------
    time_s : (record, mic) float64
    time_sd_s : (record, mic) float64
        Standard deviations; infinite for values that are left out.
    noise_s : (record,) float64
        Standard deviation of the times by noise alone, in the median microphone.
    level : (record, mic) float64
        Amplitudes; only their ratios within a recording matter.
    level_sd : (record, mic) float64
        Relative standard deviations of the amplitudes; infinite for values that are left out.
    """

    time_s: NDArray[np.float64]
    time_sd_s: NDArray[np.float64]
    noise_s: NDArray[np.float64]
    level: NDArray[np.float64]
    level_sd: NDArray[np.float64]

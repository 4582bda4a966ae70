"""Sensitivity of beamformers: error of their images relative to the error of delay-and-sum beams."""

import math
from dataclasses import dataclass
from typing import Self

from ertis_numba.settings import Processing
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS

__all__ = ["Sensitivity"]


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Error power of the image as a function of the error power p of the beams: ``linear · p + (quadratic · p)²``."""

    # 1 and 0 for delay-and-sum; `quadratic` is for Capon, which cancels an echo with delay errors.

    linear: float = 1.0
    quadratic: float = 0.0

    @classmethod
    def of(cls, processing: Processing, n_mics: int) -> Self:
        """Return a safe estimate for any sound, declared in the registry of beamformers and weightings."""
        beamformer = BEAMFORMERS[processing.beamformer]
        linear, quadratic = beamformer.sensitivity(n_mics, *beamformer.values(processing))
        # Beam and factor have errors of the same signals, so that their relative errors add up as amplitudes.
        raised = math.sqrt(linear) + WEIGHTINGS[processing.weighting].sensitivity
        return cls(raised**2, quadratic * raised / math.sqrt(linear))

    def output(self, power: float) -> float:
        """Return the error power of the image for an error power of the beams."""
        return self.linear * power + (self.quadratic * power) ** 2

    def beams(self, power: float) -> float:
        """Return the error power that beams may have for an error power of the image, the inverse of `output`."""
        if not self.quadratic:
            return power / self.linear
        square = self.quadratic**2
        return 2 * power / (self.linear + math.sqrt(self.linear**2 + 4 * square * power))

"""Frequency response and ringing of the emitter's transducer."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.sensors import Emitter

__all__ = ["call_filter", "estimate"]

_RUNG_OUT = 1e-6  # amplitude below which ringing is neglected


def call_filter(emitter: Emitter) -> "_Resonance | None":
    """Return the resonance of an emitter's transducer, or None if its response is flat."""
    return None if emitter.resonance_hz is None else _Resonance(emitter.resonance_hz, emitter.resonance_quality)


@dataclass(frozen=True)
class _Resonance:
    """Transducer with one resonance: `CallFilter` of a resonance f₀ in Hz and a quality factor Q."""

    resonance_hz: float
    quality: float

    def response(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the response ``H(f) = 1 / (1 + j Q (f / f₀ - f₀ / f))``, 1 at the resonance."""
        ratio = frequency_hz / self.resonance_hz
        damped = 1j * ratio / self.quality
        return np.asarray(damped / (1 - ratio**2 + damped))

    @property
    def rings_s(self) -> float:
        """Time until ringing has decayed by 120 dB, in seconds."""
        return -math.log(_RUNG_OUT) * self.quality / (math.pi * self.resonance_hz)


def estimate(sight: Sight) -> Estimate | None:
    """Compare echoes with those of a transducer with a flat frequency response."""
    shot = sight.shot
    emitters = [shot.scene.sensors[number].emitter for number in sight.emitters(sight.active)]
    resonances_hz = [emitter.resonance_hz for emitter in emitters if emitter.resonance_hz is not None]
    if not (resonances_hz and len(sight.heard)):
        return None
    reason = f"a resonance at {resonances_hz[0] / 1000:.3g} kHz changes {{name}} by {{change:.2f}} dB"
    return replace(filtered(sight, "emitter_response", reason), sure=200.0)

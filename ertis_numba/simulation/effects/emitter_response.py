"""Frequency response and ringing of the emitter's transducer."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.sensors import Emitter

__all__ = ["emitter_response", "ringing_s"]

_RUNG_OUT = 1e-6  # amplitude below which ringing is neglected


def emitter_response(emitter: Emitter, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the response of a transducer with one resonance: complex128, shaped like the input, 1 at the resonance.

    The response is ``H(f) = 1 / (1 + j Q (f / f₀ - f₀ / f))``. This is the current in the series branch of the
    Butterworth-Van Dyke circuit (K. S. Van Dyke, The piezo-electric resonator and its equivalent network, Proc. IRE 16,
    1928). Its bandwidth is ``f₀ / Q``; after the call it rings as ``exp(-π f₀ t / Q)``.
    """
    if emitter.resonance_hz is None:
        return np.ones(frequency_hz.shape, dtype=np.complex128)
    ratio = frequency_hz / emitter.resonance_hz
    damped = 1j * ratio / emitter.resonance_quality
    return np.asarray(damped / (1 - ratio**2 + damped))


def ringing_s(emitter: Emitter) -> float:
    """Return the time until ringing has decayed by 120 dB, in seconds."""
    if emitter.resonance_hz is None:
        return 0.0
    return -math.log(_RUNG_OUT) * emitter.resonance_quality / (math.pi * emitter.resonance_hz)

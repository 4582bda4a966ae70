"""Gains and delays that the calibration does not contain."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.estimates import Estimate, unequal
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "microphones"]

Floats = NDArray[np.float64]
_TICK_S = 1e-12
_GAIN_STEP = 2.0**-20


def microphones(shot: Snapshot, gain: Floats, delay_s: Floats) -> tuple[Floats, Floats]:
    """Return sensitivities and delays that include the spread: both (mic,) float64."""
    more, later_s = _spread(shot)
    return gain * more, delay_s + later_s


def _spread(shot: Snapshot) -> tuple[Floats, Floats]:
    """Return the gain and the delay (mic,), normal in dB and in s; the scene's seed and the sensor's name fix them."""
    electronics = shot.sensor.electronics
    name = int.from_bytes(shot.sensor.name.encode(), "little")
    random = np.random.default_rng(np.random.SeedSequence((shot.scene.seed, name)))
    gain_db, delay_s = random.standard_normal((shot.channels[-1] + 1, 2))[shot.channels].T
    gain = 10 ** (electronics.gain_spread_db * gain_db / 20)
    return (
        np.rint(gain / _GAIN_STEP) * _GAIN_STEP,
        np.rint(electronics.delay_spread_s * delay_s / _TICK_S) * _TICK_S,
    )


def estimate(sight: Sight) -> Estimate | None:
    """Compute the change of main lobe and side lobes by uncalibrated gains and delays."""
    electronics = sight.shot.sensor.electronics
    if not (electronics.gain_spread_db or electronics.delay_spread_s):
        return None
    gain, late_s = _spread(sight.shot)
    return unequal(
        sight,
        gain[:, None] * np.exp(-2j * math.pi * late_s[:, None] * sight.frequency_hz),
        f"{electronics.gain_spread_db:g} dB and {1e6 * electronics.delay_spread_s:g} µs between microphones",
    )

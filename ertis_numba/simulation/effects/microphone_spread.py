"""Gains and delays that the calibration does not contain."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["microphone_spread"]

_TICK_S = 1e-12
_GAIN_STEP = 2.0**-20


def microphone_spread(shot: Snapshot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the gain and the delay of each microphone: both (mic,) float64.

    They are normally distributed in decibels and in seconds. The scene's seed and the name of the sensor determine them
    for all measurements.
    """
    electronics = shot.sensor.electronics
    name = int.from_bytes(shot.sensor.name.encode(), "little")
    random = np.random.default_rng(np.random.SeedSequence((shot.scene.seed, name)))
    gain_db, delay_s = random.standard_normal((shot.channels[-1] + 1, 2))[shot.channels].T
    gain = 10 ** (electronics.gain_spread_db * gain_db / 20)
    return (
        np.rint(gain / _GAIN_STEP) * _GAIN_STEP,
        np.rint(electronics.delay_spread_s * delay_s / _TICK_S) * _TICK_S,
    )

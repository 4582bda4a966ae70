"""Dead and stuck microphones."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.estimates import Estimate, unequal
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.sensors import Sensor
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "microphones", "samples"]

Floats = NDArray[np.float64]


def microphones(shot: Snapshot, gain: Floats, delay_s: Floats) -> tuple[Floats, Floats]:
    """Return sensitivities, 0 for faulty microphones, and unchanged delays: both (mic,) float64."""
    return gain * _hears(shot), delay_s


def _hears(shot: Snapshot) -> Floats:
    """Return 0 for faulty microphones and 1 for others: (mic,) float64."""
    return np.where(np.isin(shot.channels, shot.sensor.electronics.faulty_channels), 0.0, 1.0)


def samples(samples: NDArray[Any], sensor: Sensor) -> None:
    """Set the bits of stuck channels, or their PCM samples to either end of the scale, in place: (sample, word)."""
    electronics = sensor.electronics
    if sensor.recording.is_pdm:
        octets = samples.view(np.uint8)
        for channel in electronics.stuck_low:
            octets[:, channel // 8] &= np.uint8(0xFF ^ 1 << channel % 8)
        for channel in electronics.stuck_high:
            octets[:, channel // 8] |= np.uint8(1 << channel % 8)
        return
    full_scale = sensor.recording.full_scale
    samples[:, list(electronics.stuck_low)] = -full_scale
    samples[:, list(electronics.stuck_high)] = full_scale - 1 if samples.dtype.kind == "i" else full_scale


def estimate(sight: Sight) -> Estimate | None:
    """Compute the change of main lobe and side lobes by faulty microphones."""
    faulty = sight.shot.sensor.electronics.faulty_channels
    if not faulty:
        return None
    hears = _hears(sight.shot)
    count = int(np.sum(hears == 0))
    return unequal(
        sight, hears[:, None] + np.zeros(len(sight.power)), f"{count} of {len(hears)} microphones receive no sound"
    )

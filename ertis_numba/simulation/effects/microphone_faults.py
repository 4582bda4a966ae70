"""Dead and stuck microphones."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.sensors import Electronics
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["microphone_faults", "stick", "stick_numbers"]


def microphone_faults(shot: Snapshot) -> NDArray[np.float64]:
    """Return 0 for faulty microphones and 1 for others: (mic,) float64."""
    return np.where(np.isin(shot.channels, shot.sensor.electronics.faulty_channels), 0.0, 1.0)


def stick(octets: NDArray[np.uint8], electronics: Electronics) -> None:
    """Set the bits of stuck channels, in place: (sample, octet) uint8."""
    for channel in electronics.stuck_low:
        octets[:, channel // 8] &= np.uint8(0xFF ^ 1 << channel % 8)
    for channel in electronics.stuck_high:
        octets[:, channel // 8] |= np.uint8(1 << channel % 8)


def stick_numbers(
    numbers: NDArray[np.int16] | NDArray[np.float32], electronics: Electronics, full_scale: float
) -> None:
    """Set stuck PCM channels to either end of the scale, in place: (sample, channel)."""
    largest = full_scale - 1 if numbers.dtype.kind == "i" else full_scale
    numbers[:, list(electronics.stuck_low)] = -full_scale
    numbers[:, list(electronics.stuck_high)] = largest

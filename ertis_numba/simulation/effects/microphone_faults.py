"""Dead and stuck microphones."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.effects._effect import Effect
from ertis_numba.simulation.estimates import Estimate, unequal
from ertis_numba.simulation.sensors import Electronics
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["EFFECT", "microphone_faults", "stick", "stick_numbers"]


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


def _microphones(shot: Snapshot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    hears = microphone_faults(shot)
    return hears, np.zeros(len(hears))


def _estimate(sight: Sight) -> Estimate | None:
    """Compute the change of main lobe and side lobes by faulty microphones."""
    faulty = sight.shot.sensor.electronics.faulty_channels
    if not faulty:
        return None
    hears = microphone_faults(sight.shot)
    count = int(np.sum(hears == 0))
    return unequal(
        sight, hears[:, None] + np.zeros(len(sight.power)), f"{count} of {len(hears)} microphones receive no sound"
    )


EFFECT: Final = Effect(
    name="microphone_faults",
    about="dead and stuck microphones",
    equation="silence; stuck bits",
    needed_if="beams change",
    requested=True,
    estimate=_estimate,
    microphones=_microphones,
)

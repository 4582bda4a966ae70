"""Reasons of gaps in captures that SYNC pulses trigger."""

from typing import Final

from ertis_numba.devices.capture.readers import BlockArrived

__all__ = ["DAMAGED", "DISK_BUSY", "DROPPED", "NOT_TRIGGERED", "gap_reason"]

DAMAGED: Final = "it was damaged on the wire"
DROPPED: Final = "the sensor dropped it, as its buffer was not read in time"
DISK_BUSY: Final = "the sensor dropped it, as a busy disk delayed reading"
NOT_TRIGGERED: Final = "the sensor was not triggered"

# A sensor's buffer holds one or two blocks, so it overflows after about one interval between pulses.
_MIN_BUSY_S = 0.05


def gap_reason(event: BlockArrived) -> str:
    """Return the reason of the gap before a measurement."""
    if event.damaged:
        return DAMAGED
    if not event.skipped:
        return NOT_TRIGGERED
    return DISK_BUSY if event.waited_s > _MIN_BUSY_S else DROPPED

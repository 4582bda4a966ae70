"""Reasons of gaps: where measurements of SYNC pulses were lost."""

from typing import Final

from ertis_numba.capture.readers import Arrived

__all__ = ["DAMAGED", "DISK_BUSY", "DROPPED", "NOT_TRIGGERED", "gap_reason"]

DAMAGED: Final = "it was damaged on the wire"
DROPPED: Final = "the sensor dropped it, as its buffer was not read in time"
DISK_BUSY: Final = "the sensor dropped it, as its buffer was not read while the disk was busy"
NOT_TRIGGERED: Final = "the sensor was not triggered"

_MIN_BUSY_S = 0.05  # a sensor's buffer holds a block or two, so it runs over after about one interval between pulses


def gap_reason(event: Arrived) -> str:
    """Return where the pulses between a measurement and the one before it were lost.

    A sensor counts each measurement that it makes, also one that it drops as its buffer is full. A sensor that does
    not count a pulse, which other sensors have answered, made no measurement.
    """
    if event.damaged:
        return DAMAGED
    if not event.skipped:
        return NOT_TRIGGERED
    return DISK_BUSY if event.waited_s > _MIN_BUSY_S else DROPPED

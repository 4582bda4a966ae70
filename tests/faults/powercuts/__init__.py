"""Power cuts: possible states of disks after one, and recovery from these states."""

from tests.faults.powercuts.trial import SCENARIOS, reason_not_to_try, try_cuts

__all__ = ["SCENARIOS", "reason_not_to_try", "try_cuts"]

"""Power cuts: disks as they may look after one, and what recovery makes of them."""

from ertis_bench.powercuts.trial import SCENARIOS, reason_not_to_try, try_cuts

__all__ = ["SCENARIOS", "reason_not_to_try", "try_cuts"]

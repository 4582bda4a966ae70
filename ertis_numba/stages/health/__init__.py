"""Health of the microphones and of the record, measured on the words alone."""

from ertis_numba.stages.health.examination import health
from ertis_numba.stages.health.report import ChannelHealth, Finding, Health, merge

__all__ = ["ChannelHealth", "Finding", "Health", "health", "merge"]

"""Health of the microphones and of the record, measured on the recorded samples alone."""

from ertis_numba.analysis.health.examination import health
from ertis_numba.analysis.health.report import ChannelHealth, Finding, Health, merge

__all__ = ["ChannelHealth", "Finding", "Health", "health", "merge"]

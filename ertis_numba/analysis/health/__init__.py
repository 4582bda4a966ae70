"""Health of the microphones and of the record, measured on the recorded samples alone."""

from ertis_numba.analysis.health.array_match import ARRAY_FAULTS
from ertis_numba.analysis.health.examination import health
from ertis_numba.analysis.health.not_observable import NotObservable, not_observable_text
from ertis_numba.analysis.health.report import ChannelHealth, Finding, Health, merge

__all__ = [
    "ARRAY_FAULTS",
    "ChannelHealth",
    "Finding",
    "Health",
    "NotObservable",
    "health",
    "merge",
    "not_observable_text",
]

"""Trials of the health checks with healthy arrays of many kinds, and with every kind of fault."""

from ertis_bench.health_trials.campaign import run
from ertis_bench.health_trials.table import health

__all__ = ["FORMS", "run"]

FORMS = {"health": health}

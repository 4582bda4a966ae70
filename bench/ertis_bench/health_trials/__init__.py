"""Trials of the health checks with healthy arrays of many kinds, and with every kind of fault."""

from ertis_bench.health_trials.campaign import run

__all__ = ["run"]

"""Acoustic maps: differences from Acoular, times, and the separation of two sources."""

from ertis_bench.passive.table import form, run

__all__ = ["form", "run"]

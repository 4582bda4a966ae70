"""Acoustic maps: differences from Acoular, times, and the separation of two sources."""

from ertis_bench.passive.table import PARTS, form, run

__all__ = ["FORMS", "PARTS", "form", "run"]

FORMS = {"passive": form}

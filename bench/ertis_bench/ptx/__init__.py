"""Times of the kernels on an H200, predicted from their machine code."""

from ertis_bench.ptx.predictions import GOALS, run
from ertis_bench.ptx.table import ptx

__all__ = ["FORMS", "GOALS", "run"]

FORMS = {"ptx": ptx}

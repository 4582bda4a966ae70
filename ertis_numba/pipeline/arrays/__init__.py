"""Array-level signal processing: demodulation, matched filter and delay-and-sum on plain NumPy arrays.

The functions need no settings and keep no state. They run the same stages and kernels as a `Pipeline`, which is faster
for many measurements because it computes its tables once.
"""

from ertis_numba.pipeline.arrays._beamform import beamform
from ertis_numba.pipeline.arrays._demodulate import demodulate
from ertis_numba.pipeline.arrays._matched_filter import matched_filter

__all__ = ["beamform", "demodulate", "matched_filter"]

"""What every kernel does, whatever device it runs on: the one docstring of each.

Arrays come first, then numbers, then ``out``, which the kernel fills. Nothing is returned and nothing
is checked: shapes and bounds are the business of the stages, which know them when they are made.
Arrays are C-contiguous. Axes are named in this order: mic, phase, sample; direction, range.
"""

from ertis_numba.kernels._contract.adaptive import CombineCapon, CombineCoherence, CombineDmas
from ertis_numba.kernels._contract.arrays import Complex, Index, Pcm, Real, Short, Taps, Words
from ertis_numba.kernels._contract.beams import (
    DelayAndSum,
    DelayAndSumEnvelope,
    DelayAndSumEnvelopeInt16,
    Envelope,
    InterpolatedBeamsEnvelope,
    InterpolatedBeamsEnvelopeInt16,
    QuantiseTiles,
)
from ertis_numba.kernels._contract.scenes import AddPaths, ModulatePdm
from ertis_numba.kernels._contract.signals import (
    Decimate,
    DemodulateWords,
    MultiplyAndFold,
    MultiplySpectra,
    RemoveGroupDelay,
    UnpackBits,
    UnpackPcm,
)

__all__ = [
    "AddPaths",
    "CombineCapon",
    "CombineCoherence",
    "CombineDmas",
    "Complex",
    "Decimate",
    "DelayAndSum",
    "DelayAndSumEnvelope",
    "DelayAndSumEnvelopeInt16",
    "DemodulateWords",
    "Envelope",
    "Index",
    "InterpolatedBeamsEnvelope",
    "InterpolatedBeamsEnvelopeInt16",
    "ModulatePdm",
    "MultiplyAndFold",
    "MultiplySpectra",
    "Pcm",
    "QuantiseTiles",
    "Real",
    "RemoveGroupDelay",
    "Short",
    "Taps",
    "UnpackBits",
    "UnpackPcm",
    "Words",
]

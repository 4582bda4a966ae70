"""Contracts of the kernels, common to all devices; each kernel is documented here once.

Arguments are arrays, then numbers, then the array ``out``, which the kernel fills. Kernels return nothing and check
nothing: stages check shapes and bounds when they are created. Arrays are C-contiguous. Axes are in the order mic,
phase, sample; direction, range.
"""

from ertis_numba.kernels._contract.arrays import Complex, ComplexOrDouble, Index, Pcm, Real, Short, Taps, Turns, Words
from ertis_numba.kernels._contract.beams import (
    CombineDelayed,
    DelayAndSum,
    DelayAndSumEnvelope,
    DelayAndSumEnvelopeInt16,
    Envelope,
    InterpolatedBeamsEnvelope,
    InterpolatedBeamsEnvelopeInt16,
    QuantiseTiles,
    RectifyAndDecimate,
    SumDelayedInt16,
)
from ertis_numba.kernels._contract.passive import CleanSources, CrossSpectra, SteerPower, SteerVectors
from ertis_numba.kernels._contract.scenes import AddPaths, ModulatePdm
from ertis_numba.kernels._contract.signals import (
    Decimate,
    DemodulateWords,
    EnvelopeRows,
    MultiplyAndFold,
    MultiplySpectra,
    RemoveGroupDelay,
    SumSpectra,
    UnpackBits,
    UnpackPcm,
)
from ertis_numba.kernels._contract.streams import CombineStreamsInt16, QuantiseStreams

__all__ = [
    "AddPaths",
    "CleanSources",
    "CombineDelayed",
    "CombineStreamsInt16",
    "Complex",
    "ComplexOrDouble",
    "CrossSpectra",
    "Decimate",
    "DelayAndSum",
    "DelayAndSumEnvelope",
    "DelayAndSumEnvelopeInt16",
    "DemodulateWords",
    "Envelope",
    "EnvelopeRows",
    "Index",
    "InterpolatedBeamsEnvelope",
    "InterpolatedBeamsEnvelopeInt16",
    "ModulatePdm",
    "MultiplyAndFold",
    "MultiplySpectra",
    "Pcm",
    "QuantiseStreams",
    "QuantiseTiles",
    "Real",
    "RectifyAndDecimate",
    "RemoveGroupDelay",
    "Short",
    "SteerPower",
    "SteerVectors",
    "SumDelayedInt16",
    "SumSpectra",
    "Taps",
    "Turns",
    "UnpackBits",
    "UnpackPcm",
    "Words",
]

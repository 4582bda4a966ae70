"""Set of the kernels of one device, and properties of the device."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final, Self

from ertis_numba.kernels import _contract
from ertis_numba.kernels._contract.adaptive import AdaptiveKernels
from ertis_numba.kernels._device_protocols import NewMemory, Threads

__all__ = ["CONTRACTS", "KERNEL_NAMES", "KernelSet", "twins_in"]


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelSet(AdaptiveKernels):
    """Kernels of one device, each documented by its contract, and properties of the device.

    ``hardware`` names the GPU, and ``instruction_set`` the CPU's vector instructions, such as "AVX2"; empty for others.
    ``tile_ranges`` counts the ranges in a tile of the 16-bit kernels. With ``simulated``, the CPU simulates the device,
    which is fast enough only for tests.
    """

    device: str
    hardware: str
    transforms: str
    max_threads: int
    tile_ranges: int
    instruction_set: str
    simulated: bool
    memory: NewMemory
    threads: Threads
    unpack_bits: _contract.UnpackBits
    unpack_pcm: _contract.UnpackPcm
    decimate: _contract.Decimate
    remove_group_delay: _contract.RemoveGroupDelay
    demodulate_words: _contract.DemodulateWords
    multiply_spectra: _contract.MultiplySpectra
    multiply_and_fold: _contract.MultiplyAndFold
    sum_spectra: _contract.SumSpectra
    envelope_rows: _contract.EnvelopeRows
    combine_delayed: _contract.CombineDelayed
    sum_delayed_int16: _contract.SumDelayedInt16
    rectify_and_decimate: _contract.RectifyAndDecimate
    delay_and_sum: _contract.DelayAndSum
    envelope: _contract.Envelope
    delay_and_sum_envelope: _contract.DelayAndSumEnvelope
    interpolated_beams_envelope: _contract.InterpolatedBeamsEnvelope
    quantise_tiles: _contract.QuantiseTiles
    delay_and_sum_envelope_int16: _contract.DelayAndSumEnvelopeInt16
    interpolated_beams_envelope_int16: _contract.InterpolatedBeamsEnvelopeInt16
    quantise_streams: _contract.QuantiseStreams
    combine_streams_int16: _contract.CombineStreamsInt16
    add_paths: _contract.AddPaths
    modulate_pdm: _contract.ModulatePdm
    cross_spectra: _contract.CrossSpectra
    steer_power: _contract.SteerPower
    steer_vectors: _contract.SteerVectors
    clean_sources: _contract.CleanSources

    @classmethod
    def of(cls, twins: Mapping[str, Any], **facts: Any) -> Self:
        """Return the set of the kernels in ``twins``, by name; ``facts`` are the other attributes."""
        return cls(**facts, **{name: twins[name] for name in KERNEL_NAMES})


CONTRACTS: Final = {
    field.name: field.type for field in fields(KernelSet) if field.type.__module__.startswith(_contract.__name__)
}
"""Contracts of the kernels, by the attribute of a `KernelSet`."""

KERNEL_NAMES: Final = tuple(CONTRACTS)
"""Attributes of a `KernelSet` that are kernels, which means that they have a contract."""


def twins_in(package: str) -> dict[str, Any]:
    """Return the kernels of a package with one module per kernel, both of the same name."""
    return {name: getattr(importlib.import_module(f"{package}.{name}"), name) for name in KERNEL_NAMES}

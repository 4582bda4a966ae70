"""Kernels of the signal chain; the only package that imports Numba.

`load` returns the kernels of one device as a `KernelSet`. The package ``_contract`` documents each kernel once;
``_cpu``, ``_cuda`` and ``_numpy`` contain the twins under the same names.
"""

from ertis_numba.kernels._compile_notice import on_compiling
from ertis_numba.kernels._contract.fusion import FusionKernels
from ertis_numba.kernels._contract.mapping import MappingKernels
from ertis_numba.kernels._contract.points import (
    ABSENT,
    N_VALUES,
    BeamErrors,
    EchoSamples,
    PointKernels,
    Pulse,
    Quadrics,
)
from ertis_numba.kernels._contract.reflectors import (
    AUDIBLE,
    DISTURBING,
    LAST_PATH_M,
    NEAREST_M,
    SPREADING_M,
    HeardEchoes,
    SeenPlaces,
    ViewingSensors,
)
from ertis_numba.kernels._contract.steering import SteeringKernels
from ertis_numba.kernels._device_protocols import Lane, Memory
from ertis_numba.kernels._dispatch import (
    DEVICES,
    load,
    load_fusion,
    load_host,
    load_mapping,
    load_points,
    load_steering,
    require_numba,
    usable,
)
from ertis_numba.kernels._kernel_set import KernelSet

__all__ = [
    "ABSENT",
    "AUDIBLE",
    "DEVICES",
    "DISTURBING",
    "LAST_PATH_M",
    "NEAREST_M",
    "N_VALUES",
    "SPREADING_M",
    "BeamErrors",
    "EchoSamples",
    "FusionKernels",
    "HeardEchoes",
    "KernelSet",
    "Lane",
    "MappingKernels",
    "Memory",
    "PointKernels",
    "Pulse",
    "Quadrics",
    "SeenPlaces",
    "SteeringKernels",
    "ViewingSensors",
    "load",
    "load_fusion",
    "load_host",
    "load_mapping",
    "load_points",
    "load_steering",
    "on_compiling",
    "require_numba",
    "usable",
]

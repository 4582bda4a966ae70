"""Fourier transforms, one plan per device behind one protocol."""

from ertis_numba.fft._host import HostTransforms
from ertis_numba.fft._protocol import Transforms

__all__ = ["Transforms", "load"]


def load(device: str) -> Transforms:
    """Return the transforms that go with the kernels of ``device``."""
    return {"cpu": HostTransforms, "numpy": HostTransforms}[device]()

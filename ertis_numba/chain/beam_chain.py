"""Interface of signal chains, and the chain that ends with beams, before their envelope."""

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.chain import planner
from ertis_numba.chain.beamform import Beamform
from ertis_numba.chain.buffer_pool import MeasurementBuffers
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.phase_shifts import PhaseShifts
from ertis_numba.geometry import Grid
from ertis_numba.settings import Accuracy, Settings

__all__ = ["BeamChain", "Chain", "beam_settings"]


def beam_settings(settings: Settings, kernel_set: kernels.KernelSet, *, threads: int) -> Settings:
    """Return settings with a plan of exact delays, which alone computes whole beams, and the same error budget."""
    exact = Accuracy(max_error_db=settings.accuracy.max_error_db, delay_taps=0)
    return planner.complete(settings.replace(accuracy=exact), kernel_set, threads=threads)


class BeamChain(FastChain):
    """Chain of delay-and-sum beams, (direction, range) complex64, on a CPU or GPU, for settings of `beam_settings`."""

    def new_image(self) -> NDArray[Any]:
        """Return an array for beams: (direction, range) complex64."""
        return np.zeros((len(self.grid), len(self.range_m)), dtype=np.complex64)

    def _image(
        self,
        buffers: MeasurementBuffers,
        out: NDArray[Any],
        threads: int,
        beamform: Beamform | PhaseShifts | None = None,
    ) -> None:
        beamform = beamform or self._beamform
        assert isinstance(beamform, PhaseShifts)  # noqa: S101  the settings ask for it
        beamform.fill_beams(buffers.transforms, buffers.analytic, buffers.beamform, out, threads=threads)


class Chain(Protocol):
    """Signal chain. It computes its tables once, and several threads may use it at the same time."""

    @property
    def grid(self) -> Grid:
        """Direction axis of the image."""
        ...

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Range axis of the image in metres: (range,) float64."""
        ...

    def process(
        self,
        words: NDArray[np.unsignedinteger[Any]],
        out: NDArray[np.float32],
        *,
        threads: int | None = None,
        grid: Grid | None = None,
    ) -> None:
        """Compute the image ``out`` (direction, range) of ``words``; ``grid`` has as many directions for level ones."""
        ...

    def process_batch(
        self, words: Iterable[NDArray[np.unsignedinteger[Any]]], outs: Iterable[NDArray[np.float32]]
    ) -> None:
        """Compute the images of several measurements, in parallel if that is faster; parameters as for `process`."""
        ...

    def warm_up(self, words: NDArray[np.unsignedinteger[Any]]) -> None:
        """Compile or load kernels and allocate buffers before a stream starts; ``words`` hold silence."""
        ...

    def new_image(self) -> NDArray[np.float32]:
        """Return an uninitialised array for an image: (direction, range) float32."""
        ...

    def close(self) -> None:
        """Free the memory of the chain on its device."""
        ...

"""Signal chain that ends with beams, before their envelope."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.chain import planner
from ertis_numba.chain.beamform import Beamform
from ertis_numba.chain.buffer_pool import MeasurementBuffers
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.phase_shifts import PhaseShifts
from ertis_numba.settings import Accuracy, Settings

__all__ = ["BeamChain", "beam_settings"]


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

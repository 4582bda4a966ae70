"""The kernels compiled by Numba for NVIDIA's GPUs, or played by its simulator where ``NUMBA_ENABLE_CUDASIM=1``."""

import contextlib
from collections.abc import Iterator

from ertis_numba import checks
from ertis_numba.kernels._contract import KernelSet
from ertis_numba.kernels._cuda.add_paths import add_paths
from ertis_numba.kernels._cuda.combine_capon import combine_capon
from ertis_numba.kernels._cuda.combine_coherence import combine_coherence
from ertis_numba.kernels._cuda.combine_dmas import combine_dmas
from ertis_numba.kernels._cuda.decimate import decimate
from ertis_numba.kernels._cuda.delay_and_sum import delay_and_sum
from ertis_numba.kernels._cuda.delay_and_sum_envelope import delay_and_sum_envelope
from ertis_numba.kernels._cuda.delay_and_sum_envelope_int16 import TILE_RANGES, delay_and_sum_envelope_int16
from ertis_numba.kernels._cuda.demodulate_words import demodulate_words
from ertis_numba.kernels._cuda.envelope import envelope
from ertis_numba.kernels._cuda.interpolated_beams_envelope import interpolated_beams_envelope
from ertis_numba.kernels._cuda.interpolated_beams_envelope_int16 import interpolated_beams_envelope_int16
from ertis_numba.kernels._cuda.lane import SIMULATED
from ertis_numba.kernels._cuda.modulate_pdm import modulate_pdm
from ertis_numba.kernels._cuda.multiply_and_fold import multiply_and_fold
from ertis_numba.kernels._cuda.multiply_spectra import multiply_spectra
from ertis_numba.kernels._cuda.quantise_tiles import quantise_tiles
from ertis_numba.kernels._cuda.remove_group_delay import remove_group_delay
from ertis_numba.kernels._cuda.unpack_bits import unpack_bits
from ertis_numba.kernels._memory import NewMemory

__all__ = ["kernel_set"]


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """See `Threads`; one Python thread launches, and the GPU has its own."""
    checks.whole("threads", count, 1, 1)
    yield


def kernel_set(*, hardware: str, transforms: str, memory: NewMemory) -> KernelSet:
    """Return the kernels, to run on what is called ``hardware``; others as in `KernelSet`."""
    return KernelSet(
        device="cuda",
        hardware=hardware,
        transforms=transforms,
        simulated=SIMULATED,
        memory=memory,
        max_threads=1,
        tile_ranges=TILE_RANGES,
        fastest_precision="float32",
        threads=threads,
        unpack_bits=unpack_bits,
        decimate=decimate,
        remove_group_delay=remove_group_delay,
        demodulate_words=demodulate_words,
        multiply_spectra=multiply_spectra,
        multiply_and_fold=multiply_and_fold,
        delay_and_sum=delay_and_sum,
        envelope=envelope,
        delay_and_sum_envelope=delay_and_sum_envelope,
        interpolated_beams_envelope=interpolated_beams_envelope,
        quantise_tiles=quantise_tiles,
        delay_and_sum_envelope_int16=delay_and_sum_envelope_int16,
        interpolated_beams_envelope_int16=interpolated_beams_envelope_int16,
        combine_coherence=combine_coherence,
        combine_dmas=combine_dmas,
        combine_capon=combine_capon,
        add_paths=add_paths,
        modulate_pdm=modulate_pdm,
    )

"""The kernels compiled by Numba for all cores of the processor."""

import contextlib
import os
import threading
from collections.abc import Iterator

# libgomp's idle threads spin by default and take the cores from SciPy's transforms between two
# kernels: 1.4 times slower on two cores. Sleeping at once costs a wake-up per kernel: 1.06 times slower than
# spinning for some microseconds. It reads these once, when Numba first loads it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import numba

from ertis_numba import checks
from ertis_numba.errors import DeviceError
from ertis_numba.kernels._contract import KernelSet
from ertis_numba.kernels._cpu.add_paths import add_paths
from ertis_numba.kernels._cpu.combine_capon import combine_capon
from ertis_numba.kernels._cpu.combine_coherence import combine_coherence
from ertis_numba.kernels._cpu.combine_dmas import combine_dmas
from ertis_numba.kernels._cpu.decimate import decimate
from ertis_numba.kernels._cpu.delay_and_sum import delay_and_sum
from ertis_numba.kernels._cpu.delay_and_sum_envelope import delay_and_sum_envelope
from ertis_numba.kernels._cpu.delay_and_sum_envelope_int16 import delay_and_sum_envelope_int16
from ertis_numba.kernels._cpu.demodulate_words import demodulate_words
from ertis_numba.kernels._cpu.dot16 import HAS_INT16_DOT, RANGES
from ertis_numba.kernels._cpu.envelope import envelope
from ertis_numba.kernels._cpu.interpolated_beams_envelope import interpolated_beams_envelope
from ertis_numba.kernels._cpu.interpolated_beams_envelope_int16 import interpolated_beams_envelope_int16
from ertis_numba.kernels._cpu.modulate_pdm import modulate_pdm
from ertis_numba.kernels._cpu.multiply_and_fold import multiply_and_fold
from ertis_numba.kernels._cpu.multiply_spectra import multiply_spectra
from ertis_numba.kernels._cpu.quantise_tiles import quantise_tiles
from ertis_numba.kernels._cpu.remove_group_delay import remove_group_delay
from ertis_numba.kernels._cpu.unpack_bits import unpack_bits
from ertis_numba.kernels._host import HostMemory

__all__ = ["KERNELS"]

if numba.config.DISABLE_JIT:
    raise DeviceError(
        "NUMBA_DISABLE_JIT is set, and device 'cpu' is what Numba compiles; unset it or use device 'numpy'"
    )

_MAX_THREADS: int = numba.config.NUMBA_NUM_THREADS
_ONE_AT_A_TIME = threading.RLock()


def _layer_is_reentrant() -> bool:
    """Whether two Python threads may run parallel kernels at a time; unknown counts as no."""
    try:
        return bool(numba.threading_layer() != "workqueue")
    except ValueError:  # no parallel kernel has run yet, so no layer is chosen
        return False


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """See `Threads`.

    Numba's workqueue layer, which it falls back to without OpenMP and TBB, aborts the process when two
    threads meet in it. There, and until the layer is known, one thread runs at a time.
    """
    checks.whole("threads", count, 1, _MAX_THREADS)
    before = numba.get_num_threads()
    with contextlib.nullcontext() if _layer_is_reentrant() else _ONE_AT_A_TIME:
        numba.set_num_threads(count)
        try:
            yield
        finally:
            numba.set_num_threads(before)


KERNELS = KernelSet(
    device="cpu",
    hardware="",
    transforms="scipy",
    simulated=False,
    memory=HostMemory,
    max_threads=_MAX_THREADS,
    tile_ranges=RANGES if HAS_INT16_DOT else 0,
    fastest_precision="int16" if HAS_INT16_DOT else "float32",
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

"""Contracts of the simulation: arrivals to PDM words."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.arrays import Index

__all__ = ["AddPaths", "ModulatePdm"]


class AddPaths(Protocol):
    """Add delayed and filtered copies of a call, (1 or mic, bin), to the spectrum of each microphone.

    ``out[mic, k] += Σ_path a · call[k] · exp(-2πi turns[path, mic] (first_bin + k))``. The gain ``a`` is linearly
    interpolated between the frequencies of ``amplitude[path, mic]``, the first of which is bin 0, and constant above
    the last. ``turns`` are seconds times the spacing of the bins; ``nodes_per_bin`` is that spacing / that of the
    frequencies.
    """

    def __call__(
        self,
        call: NDArray[np.complex128],
        turns: NDArray[np.float64],
        amplitude: NDArray[np.float64],
        first_bin: int,
        nodes_per_bin: float,
        out: NDArray[np.complex128],
    ) -> None: ...


class ModulatePdm(Protocol):
    """Modulate a block of signals with a loop of up to four integrators, and pack the bits into PDM words.

    Per sample, with the quantiser's output v = ±1 and the error d = u − v::

        u  = signal + noise, rounded to a multiple of 2⁻²⁰ (ties to even)
        v  = sign(u + dither + s1 + s2 + s3 + s4)
        s1 += c1 d − r1 s2,  s2 += c2 s1,  s3 += c3 s2 − r2 s4,  s4 += c4 s3

    Every integrator saturates at ±limit, so that the loop recovers from overload. The rounding removes the last digits
    of the signals, which differ between processors. It adds noise of −131 dB.

    Noise and dither come from one hash, SplitMix64 of key and sample index. Its upper 16 bits k yield the dither,
    ``width · ((k + ½) / 2¹⁶ − ½)``. The four 12-bit fields below yield the noise: their sum minus its mean of 8190,
    divided by its RMS of ``√((2²⁴ − 1) / 3)``. The noise is nearly Gaussian, and at most 3.5 times its RMS.

    ``signals`` (mic, sample) have a full scale of 1. ``mics`` (octet, 8): row of each bit, least significant first; −1
    for a bit that stays 0, no row twice. ``noise_rms`` (mic,) takes no time if all are 0. ``states`` (mic, 4) carry
    over. ``loop``: c1, c2, c3, c4, r1, r2, the width of the dither and the limit. ``out`` (sample, octet): a bit is 1
    for v = +1.
    """

    def __call__(
        self,
        signals: NDArray[np.float64],
        mics: Index,
        keys: NDArray[np.uint64],
        noise_rms: NDArray[np.float64],
        states: NDArray[np.float64],
        loop: NDArray[np.float64],
        first: int,
        out: NDArray[np.uint8],
    ) -> None: ...

"""From arrivals to words."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.arrays import Index

__all__ = ["AddPaths", "ModulatePdm"]


class AddPaths(Protocol):
    """Add delayed and filtered copies of a call to the spectrum of each microphone.

    ``out[mic, k] += Σ_path a · call[k] · exp(-2πi turns[path, mic] (first_bin + k))``, with ``a`` interpolated
    straight between the nodes of ``amplitude[path, mic]``, the first of which lies at bin 0.

    Parameters
    ----------
    call : (1, bin) or (mic, bin) complex128
        One for all microphones, or one each.
    turns : (path, mic) float64
        Delay in turns per bin: seconds times the spacing of the bins in hertz.
    amplitude : (path, mic, node) float64
    first_bin : int
    nodes_per_bin : float
        Spacing of the bins by that of the nodes. Beyond the last node its amplitude holds.
    out : (mic, bin) complex128
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

        u  = signal + noise, rounded to a multiple of 2⁻²⁰ (of two as near, to the even one)
        v  = sign(u + dither + s1 + s2 + s3 + s4)
        s1 += c1 d − r1 s2,  s2 += c2 s1,  s3 += c3 s2 − r2 s4,  s4 += c4 s3

    Every integrator stops at ±limit, which is what lets the loop return from overload. The grid hides the last
    digits of the signals, in which processors differ, under −131 dB of noise.

    Noise and dither come from one hash, SplitMix64 of key and sample number: its upper 16 bits k make the
    dither, ``width · ((k + ½) / 2¹⁶ − ½)``, and the four fields of 12 bits below make the noise, their sum less its
    mean of 8190 and over its rms, ``√((2²⁴ − 1) / 3)``: nearly Gaussian, and never beyond 3.5 times its rms.

    Parameters
    ----------
    signals : (mic, sample) float64
        Full scale 1; finite, and below 2³¹. At least as long as ``out``; what is over is not used.
    mics : (octet, 8) int32
        Row of ``signals`` that each bit of the words follows, least significant first; −1 for a bit that stays 0.
        No row may stand in two places.
    keys : (mic,) uint64
        Seed of each microphone's noise and dither.
    noise_rms : (mic,) float64
        Full scale 1. Where all are 0, noise costs nothing.
    states : (mic, 4) float64
        The integrators s1 to s4, carried from block to block.
    loop : (8,) float64
        c1, c2, c3, c4, r1, r2, the width of the dither and the limit.
    first : int
        Number of the block's first sample.
    out : (sample, octet) uint8
        The bytes of little-endian PDM words; a bit is 1 where v is +1.
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

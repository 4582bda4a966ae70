"""Sigma-delta modulators of PDM microphones, from signals to bits."""

import functools
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import checks
from ertis_numba.geometry import Layout

__all__ = ["Modulator", "loop_gains", "noise_transfer"]

_MAX_ORDER = 4
_OUT_OF_BAND_GAIN = 1.5  # Lee's rule of thumb: one-bit loops up to this gain are usually stable, and these are
_LIMIT = 2.0  # integrators reach 1.7 at half scale; with a limit of 8 the loop does not recover from overload
_GAIN_STEP = 2.0**-20  # gains are rounded, so that differences between processors in the last digit change no bit


class Modulator:
    """One modulator per enabled microphone; its state carries over from block to block."""

    # `dither` is the width at the quantiser, `order` 1 to 4, and `band` the edge of low noise in cycles per sample.

    def __init__(
        self,
        layout: Layout,
        keys: NDArray[np.uint64],
        noise_rms: NDArray[np.float64],
        *,
        order: int,
        dither: float,
        band: float,
        threads: int | None = None,
    ) -> None:
        self._mics = _mics_of_bits(layout)
        n_mics = int(layout.enabled.sum())
        checks.shape("keys", keys.shape, (n_mics,))
        checks.shape("noise_rms", noise_rms.shape, (n_mics,))
        self._keys, self._noise_rms = keys, noise_rms
        self._states = np.zeros((n_mics, _MAX_ORDER))
        self._loop = np.array([*loop_gains(order, band), dither, _LIMIT])
        self._first = 0
        self._kernels = kernels.load_host()
        self._threads = self._kernels.max_threads if threads is None else threads

    def process(self, signals: NDArray[np.float64], *, out: NDArray[np.unsignedinteger]) -> None:
        """Write the words of the next block, with 0 for bits without an enabled microphone."""
        # The bits follow signals (mic, sample) up to about 0.6 of full scale, 1; above, the loop overloads and
        # recovers.
        octets = out.view(np.uint8)  # words are little-endian, like the processors that this package supports
        checks.shape("signals", (len(signals), min(signals.shape[1], len(out))), (len(self._states), len(out)))
        checks.shape("out, in bytes,", octets.shape, (len(out), len(self._mics)))
        signals = np.ascontiguousarray(signals, dtype=np.float64)
        with self._kernels.threads(self._threads):
            self._kernels.modulate_pdm(
                signals, self._mics, self._keys, self._noise_rms, self._states, self._loop, self._first, octets
            )
        self._first += len(out)


def _mics_of_bits(layout: Layout) -> NDArray[np.int32]:
    """Return the microphone of each bit of a sample's words, −1 for none: (octet, 8) int32."""
    mics = np.full(layout.n_words * layout.word_bits, -1, dtype=np.int32)
    mics[: len(layout.enabled)][layout.enabled] = np.arange(layout.enabled.sum())
    return mics.reshape(-1, 8)


def noise_transfer(order: int, band: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the numerator and the denominator of the noise transfer function, in powers of 1/z."""
    # It is a Butterworth high pass with zeros at the roots of the Legendre polynomial (R. Schreier, G. C. Temes, 2005).
    checks.integer("order", order, 1, _MAX_ORDER)
    checks.between("band", band, 0.0, 0.25)
    angle = math.pi * (2 * np.arange(order) + order + 1) / (2 * order)
    low, high = 0.0, 2.0
    for _ in range(60):  # bisection: the gain rises with the poles' radius
        radius = (low + high) / 2
        poles = (1 + radius / 2 * np.exp(1j * angle)) / (1 - radius / 2 * np.exp(1j * angle))
        too_high = 2**order / abs(np.prod(1 + poles)) > _OUT_OF_BAND_GAIN
        low, high = (low, radius) if too_high else (radius, high)
    zeros = np.exp(2j * math.pi * band * _legendre_roots(order))
    return np.real(np.poly(zeros)), np.real(np.poly(poles))


@functools.cache
def loop_gains(order: int, band: float) -> tuple[float, float, float, float, float, float]:
    """Return the gains c1 to c4, r1 and r2 of `modulate_pdm` for a noise transfer function."""
    # The quantiser receives the input and all integrators, scaled by their weights (J. Silva et al., 2001).
    zeros, poles = noise_transfer(order, band)
    loop = np.zeros(order + 1)  # impulse response of poles / zeros
    for n in range(order + 1):
        loop[n] = poles[n] - sum(zeros[k] * loop[n - k] for k in range(1, n + 1))
    turn = np.zeros(2)  # one resonator per pair of zeros; a zero at 0 Hz needs none
    turn[: (order + 1) // 2] = 2 * math.pi * band * _legendre_roots(order)[: (order + 1) // 2]
    resonances = 2 - 2 * np.cos(turn)
    weights = np.zeros(_MAX_ORDER)
    weights[:order] = np.linalg.solve(_integrators(order, resonances), loop[1:])
    ratio = [after / before if before else 0.0 for before, after in itertools.pairwise(weights)]
    back = [g / forward if forward else 0.0 for g, forward in zip(resonances, ratio[::2], strict=True)]
    c1, c2, c3, c4, r1, r2 = (round(gain / _GAIN_STEP) * _GAIN_STEP for gain in (weights[0], *ratio, *back))
    return c1, c2, c3, c4, r1, r2


def _legendre_roots(order: int) -> NDArray[np.float64]:
    """Return the roots of the Legendre polynomial, ascending from −1 to 1."""
    roots, _ = np.polynomial.legendre.leggauss(order)
    return np.asarray(roots, dtype=np.float64)


def _integrators(order: int, resonances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the response of the unscaled integrators to a unit error: (sample, integrator) float64."""
    state = np.zeros(_MAX_ORDER)
    response = np.empty((order, order))
    error = 1.0
    for n in range(order):
        state[0] += error - resonances[0] * state[1]
        state[1] += state[0]
        state[2] += state[1] - resonances[1] * state[3]
        state[3] += state[2]
        response[n] = state[:order]
        error = 0.0
    return response

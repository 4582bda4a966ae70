"""Synthesis of the signals at the microphones from arrivals, block by block."""

import functools
import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Call
from ertis_numba.simulation import noise_frames
from ertis_numba.simulation.arrivals import Arrivals
from ertis_numba.simulation.noise_frames import NoiseFrame
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = ["BLOCK", "NODE_HZ", "highest_hz", "node_frequencies", "signals"]

Floats = NDArray[np.float64]

BLOCK = 32_768
"""Samples synthesised at a time, so that memory does not grow with the record."""
NODE_HZ = 1000.0
"""Spacing of the frequencies at which filters are evaluated.

Linear interpolation between them keeps the patterns of 20 cm pistons accurate to 1 %."""
_RING = 2048  # samples that a filter may ring before and after a call
_NODES, _FAR_APART_RAD = 4, 0.6  # from the middle: an error of −103 dB at this limit, for both calls of eRTIS
_STILL = 1e-12  # smaller stretches are invisible in any record
_DEAF = 10 ** (-90 / 20)  # parts of a call's spectrum this far below its maximum are left out


def node_frequencies(top_hz: float) -> Floats:
    """Return the frequencies at which filters are evaluated, starting at 0: (frequency,) float64."""
    return np.asarray(np.arange(math.ceil(top_hz / NODE_HZ) + 1) * NODE_HZ, dtype=np.float64)


def highest_hz(call: Call | NoiseFrame, rate_hz: float) -> float:
    """Return the upper end of a spectrum, 90 dB below its maximum, at most half of the sample rate."""
    if isinstance(call, NoiseFrame):
        return min(noise_frames.top_hz(call.noise), rate_hz / 2)
    return _highest_hz(call, rate_hz)


@functools.cache
def _highest_hz(call: Call, rate_hz: float) -> float:
    n_fft = scipy.fft.next_fast_len(4 * math.ceil(call.end_s * rate_hz), real=True)
    spectrum = np.abs(np.fft.rfft(call_at(call, np.arange(n_fft) / rate_hz)))
    return float(np.flatnonzero(spectrum > _DEAF * spectrum.max())[-1] * rate_hz / n_fft)


def signals(
    arrived: Sequence[Arrivals], *, n_samples: int, rate_hz: float, n_mics: int, threads: int, clock: CostStopwatch
) -> Iterator[Floats]:
    """Yield the signals of the record block by block: (mic, sample)."""
    # The calls that begin in a block are one spectrum, `S(f) Σ a(f) exp(-2πi f τ)`, and their remainders are added to
    # the next ones. Yielded arrays are reused, and may exceed `BLOCK` samples.
    delay_samples = [entry.delay_s * rate_hz for entry in arrived]
    # Sound that begins before the record wraps to the end of the first transform, which is never read.
    before = _RING + max((math.ceil(max(0.0, -delay.min(initial=0.0))) for delay in delay_samples), default=0)
    n_fft = _length(arrived, delay_samples, rate_hz, before)
    first_block = [
        np.maximum(np.floor((delay.min(axis=1) - _RING) / BLOCK), 0.0).astype(int) for delay in delay_samples
    ]
    spectra = np.zeros((n_mics, n_fft // 2 + 1), dtype=np.complex128)
    silence = np.zeros((n_mics, BLOCK))
    rest = silence[:, :0]
    for number in range(-(-n_samples // BLOCK)):
        n_bins = 0
        for entry, delay, blocks in zip(arrived, delay_samples, first_block, strict=True):
            chosen = blocks == number
            if chosen.any():
                with clock("doppler" if entry.stretch is not None else "propagation"):
                    n_bins = max(
                        n_bins, _add(entry, chosen, delay[chosen] - number * BLOCK, rate_hz, n_fft, spectra, threads)
                    )
        with clock("propagation"):
            if n_bins:
                sound = scipy.fft.irfft(spectra, n_fft, workers=threads)
                spectra[:, :n_bins] = 0.0
                sound[:, : rest.shape[1]] += rest
            else:
                sound = silence
                sound[:, :] = 0.0
                sound[:, : rest.shape[1]] = rest[:, :BLOCK]
        over = sound[:, BLOCK:-before] if n_bins else rest[:, BLOCK:]
        yield sound
        rest = over


def _length(arrived: Sequence[Arrivals], delay_samples: Sequence[Floats], rate_hz: float, before: int) -> int:
    """Return the length of a block's transform: the block, its calls and the ringing of filters."""
    call = spread = 0
    step = 1
    for entry, delay in zip(arrived, delay_samples, strict=True):
        stretch = 1.0 if entry.stretch is None else float(entry.stretch.max(initial=1.0))
        call = max(call, math.ceil(stretch * (entry.call.end_s + entry.rings_s) * rate_hz))
        spread = max(spread, math.ceil(np.ptp(delay, axis=1).max(initial=0.0)))
        if entry.stretch is not None:
            step = math.lcm(step, _step(entry.call, rate_hz))
    n_fft = before + 2 * _RING + BLOCK + call + spread
    return step * int(scipy.fft.next_fast_len(-(-n_fft // step), real=True))


def _step(call: Call | NoiseFrame, rate_hz: float) -> int:
    """Return the factor by which a call can be undersampled: a power of two, so that calls share a common multiple."""
    return int(2 ** math.floor(math.log2(max(1.0, rate_hz / (2.2 * highest_hz(call, rate_hz))))))


def _add(
    entry: Arrivals,
    chosen: NDArray[np.bool_],
    delay_samples: Floats,
    rate_hz: float,
    n_fft: int,
    spectra: NDArray[np.complex128],
    threads: int,
) -> int:
    """Add some paths to the spectra of their block, and return the number of bins that they occupy."""
    n_bins: int = min(math.ceil(highest_hz(entry.call, rate_hz) * n_fft / rate_hz) + 1, spectra.shape[1])
    out = np.zeros((len(spectra), n_bins), dtype=np.complex128)
    turns, amplitude = delay_samples / n_fft, np.ascontiguousarray(entry.amplitude[chosen])
    kernel_set, nodes_per_bin = kernels.load_host(), rate_hz / n_fft / NODE_HZ

    def add(call: NDArray[np.complex128], paths: NDArray[np.intp]) -> None:
        """Add some paths. The kernel accepts real amplitudes, so imaginary parts use the call rotated by 90°."""
        turned = paths[amplitude[paths].imag.any(axis=(1, 2))]
        with kernel_set.threads(threads):
            kernel_set.add_paths(call, turns[paths], amplitude[paths].real.copy(), 0, nodes_per_bin, out)
            if len(turned):
                part = amplitude[turned].imag.copy()
                kernel_set.add_paths(1j * call, turns[turned], part, 0, nodes_per_bin, out)

    still = np.ones(len(turns), dtype=np.bool_)
    if entry.stretch is not None:
        stretch = entry.stretch[chosen]
        still = np.abs(stretch - 1).max(axis=1) < _STILL
        for path in np.flatnonzero(~still):
            call = _stretched(entry.call, stretch[path], rate_hz, n_fft, n_bins)
            for each in entry.filters:
                call = call * each.response(np.outer(stretch[path], np.arange(n_bins) * rate_hz / n_fft))
            add(call, np.array([path]))
    if still.any():
        form = entry.call
        # Frames are used once. They would displace the calls from the cache.
        whole = _framed(form, rate_hz, n_fft) if isinstance(form, NoiseFrame) else _spectrum(form, rate_hz, n_fft)
        call = whole[None, :n_bins]
        for each in entry.filters:
            call = call * each.response(np.arange(n_bins) * rate_hz / n_fft)
        add(call, np.flatnonzero(still))
    spectra[:, :n_bins] += out
    return n_bins


@functools.lru_cache(maxsize=8)
def _spectrum(call: Call, rate_hz: float, n_fft: int) -> NDArray[np.complex128]:
    return np.asarray(scipy.fft.rfft(call_at(call, np.arange(n_fft) / rate_hz)))


def _finer(call: Call | NoiseFrame, rate_hz: float) -> int:
    """Return the factor by which a frame is oversampled, so that frequencies above half of the rate do not fold."""
    return math.ceil(2 * noise_frames.top_hz(call.noise) / rate_hz) if isinstance(call, NoiseFrame) else 1


def _framed(frame: NoiseFrame, rate_hz: float, n_fft: int) -> NDArray[np.complex128]:
    finer = _finer(frame, rate_hz)
    fine_hz = finer * rate_hz
    time_s = np.arange(math.ceil(frame.end_s * fine_hz) + 1) / fine_hz
    return np.asarray(scipy.fft.rfft(frame.at(time_s), finer * n_fft)[: n_fft // 2 + 1] / finer)


def _stretched(
    call: Call | NoiseFrame, stretch: Floats, rate_hz: float, n_fft: int, n_bins: int
) -> NDArray[np.complex128]:
    """Return the spectra of a stretched call: (mic, bin)."""
    # If their final phases lie within 1.2 rad, Lagrange interpolation of four spectra has an error of −100 dB.
    middle, half = (stretch.max() + stretch.min()) / 2, np.ptp(stretch) / 2
    apart_rad = 2 * math.pi * call.high_frequency_hz * call.end_s * half
    if len(stretch) <= _NODES or apart_rad > _FAR_APART_RAD:
        return _spectra(call, stretch, rate_hz, n_fft, n_bins)
    nodes = np.cos(math.pi * (np.arange(_NODES) + 0.5) / _NODES)
    places = (stretch - middle) / (half or 1.0)
    weights = np.ones((len(stretch), _NODES))
    for n, other in itertools.permutations(range(_NODES), 2):
        weights[:, n] *= (places - nodes[other]) / (nodes[n] - nodes[other])
    known = _spectra(call, middle + half * nodes, rate_hz, n_fft, n_bins)
    # A product of real matrices: with complex ones BLAS would start its threads, which costs more than it saves.
    return np.asarray((weights @ known.view(np.float64)).view(np.complex128))


def _spectra(
    call: Call | NoiseFrame, stretch: Floats, rate_hz: float, n_fft: int, n_bins: int
) -> NDArray[np.complex128]:
    """Return the spectrum of the call for each stretch, computed at the lowest sample rate that its band allows."""
    step = _step(call, rate_hz) / _finer(call, rate_hz)  # At least one of the two is 1.
    n_samples = math.ceil(call.end_s * stretch.max() * rate_hz / step) + 1
    time_s = np.arange(n_samples) * (step / rate_hz) / stretch[:, None]
    values = call.at(time_s) if isinstance(call, NoiseFrame) else call_at(call, time_s)
    spectra = scipy.fft.rfft(values, round(n_fft / step))
    wide = np.zeros((len(stretch), n_bins), dtype=np.complex128)
    kept = min(n_bins, spectra.shape[1])
    wide[:, :kept] = step * spectra[:, :kept]
    return wide

"""From a scene to the PDM words that its sensor would record."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import Layout, microphones
from ertis_numba.simulation.arrivals import Arrivals, arrivals
from ertis_numba.simulation.modulator import Modulator
from ertis_numba.simulation.scene import Scene
from ertis_numba.waveform import call_at

__all__ = ["received", "render"]

_BLOCK = 32_768  # PDM samples rendered at a time, so that memory does not grow with the record
_SIGNAL_STEP = 2.0**-20  # −131 dBFS of noise, to hide the last digits, in which processors differ


def render(scene: Scene, index: int = 0) -> Measurement:
    """Return measurement ``index`` of a scene; scene and index decide every bit.

    Channels without a microphone hold zeros.
    """
    checks.whole("index", index, 0)
    settings = scene.sensor
    layout = microphones(settings.array)
    words = np.empty((settings.recording.n_samples, layout.n_words), dtype=f"u{layout.word_bits // 8}")
    ways = arrivals(scene)
    seeds = np.random.SeedSequence((scene.seed, index)).spawn(int(layout.enabled.sum()))
    noises = [np.random.default_rng(seed) for seed in seeds]
    modulator = Modulator(
        np.array([seed.generate_state(1, np.uint64)[0] for seed in seeds]),
        order=scene.electronics.modulator_order,
        dither=scene.electronics.dither,
        band=min(settings.call.high_frequency_hz / settings.recording.pdm_rate_hz, 0.25),
    )
    for first in range(0, len(words), _BLOCK):
        block = words[first : first + _BLOCK]
        signals = received(scene, ways, first, first + len(block))
        if scene.electronics.noise_dbfs is not None:
            _add_noise(signals, noises, 10 ** (scene.electronics.noise_dbfs / 20))
        block[:] = _packed(modulator.process(np.rint(signals / _SIGNAL_STEP) * _SIGNAL_STEP), layout)
    stamp = Stamp(sequence=index, sync_count=index, timestamp_ns=round(index * 1e9 / scene.rate_hz))
    return Measurement(words if layout.n_words > 1 else words[:, 0], settings, stamp)


def received(scene: Scene, ways: Arrivals, first: int, stop: int) -> NDArray[np.float64]:
    """Return what the microphones hear in PDM samples ``first`` to ``stop``: (mic, sample) float64.

    The call is evaluated in closed form at ``n / pdm_rate − delay``: delays are exact, nothing is
    interpolated. Half of the PDM rate is so far above a call of 80 kHz that what aliases of it stays
    190 dB below its spectrum's top.
    """
    call, rate_hz = scene.sensor.call, scene.sensor.recording.pdm_rate_hz
    signals = np.zeros((ways.delay_s.shape[1], stop - first))
    for delay_s, amplitude in zip(ways.delay_s, ways.amplitude, strict=True):
        begin = max(first, math.floor(delay_s.min() * rate_hz))
        end = min(stop, math.ceil((delay_s.max() + call.duration_s) * rate_hz) + 1)
        if begin < end:
            time_s = np.arange(begin, end) / rate_hz - delay_s[:, None]
            signals[:, begin - first : end - first] += amplitude[:, None] * call_at(call, time_s)
    return signals


def _add_noise(signals: NDArray[np.float64], noises: list[np.random.Generator], rms: float) -> None:
    for signal, noise in zip(signals, noises, strict=True):
        signal += rms * noise.standard_normal(signal.size)  # noqa: PLW2901 - a row, changed in place


def _packed(bits: NDArray[np.uint8], layout: Layout) -> NDArray[np.unsignedinteger]:
    """Put the bits of the enabled microphones into words: (mic, sample) to (sample, word)."""
    channels = np.zeros((layout.n_words * layout.word_bits, bits.shape[1]), dtype=np.uint8)
    channels[: len(layout.enabled)][layout.enabled] = bits
    octets = np.ascontiguousarray(np.packbits(channels, axis=0, bitorder="little").T)
    return octets.view(f"<u{layout.word_bits // 8}")

"""Times and levels at which one sound arrives at each microphone."""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.health.arrival import Compressed
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Call

__all__ = ["SoundArrival", "measure_arrival"]

_GATE_S = 250e-6  # Half of the gate around an arrival. Echoes that are 4 cm farther away lie outside.
_TAPER = 0.3  # Share of the gate over which it fades.
_LAGS_S = np.arange(-20e-6, 20.1e-6, 0.5e-6)  # Lags to search; half a period of the carrier is 13 µs.
_SEARCHES = 2
_MAX_STEP_S = 2e-6
_MIN_EVIDENCE = 20.0  # Logarithm of the likelihood of the other polarity.
_MEDIAN_OF_SQUARE = 0.455  # of a normal variable with unit variance
_NOISE_IN_HALVES = 4.0  # Variance of the difference of two halves, relative to the variance in the whole band.
_ROUNDS = 6  # Rounds of estimating the common pulse from the microphones, and the microphones from the pulse.
_LEAST_SPECTRUM = 0.05  # Magnitude of the call's spectrum, relative to its maximum, up to which noise is whitened.


@dataclass(frozen=True, slots=True, eq=False)
class SoundArrival:
    """Times and levels of one sound at each microphone; arrays are (mic,)."""

    time_s: NDArray[np.float64]  # from the start of the record
    time_sd_s: NDArray[np.float64]  # by noise alone
    level: NDArray[np.float64]  # amplitude relative to the mean pulse; negative for inverted polarity
    level_sd: NDArray[np.float64]  # relative to the level
    coherence: NDArray[np.float64]  # share of the power in the gate that the common pulse explains
    power: NDArray[np.float64]  # in the gate, in a unit common to the microphones of a recording
    other_sound: tuple[float, float]  # standard deviations of times (s) and relative levels by other echoes or motion
    evidence: NDArray[np.float64]  # log likelihood of normal relative to inverted polarity, at the best delays


def measure_arrival(pulses: Compressed, call: Call, at_s: NDArray[np.float64], used: NDArray[np.bool_]) -> SoundArrival:
    """Measure the sound around times that are known to a few microseconds, by maximum likelihood."""
    # With `Y(f) = a R(f) exp(−2πj f d) + N(f)` for a common pulse R, standard deviations are the Cramér-Rao bounds `σ_d
    # = σ / (2π a √(2 Σ f² |R|²))` and `σ_a = σ / √(2 Σ |R|²)` (S. M. Kay, Estimation Theory, 1993).
    bins, frequency_hz = _whitened(pulses, call, at_s)
    made = _estimate(bins, frequency_hz, used)
    # Half a period of delay resembles an inversion, so a microphone is inverted only on strong evidence.
    sign = np.where(made.evidence < -_MIN_EVIDENCE, -1.0, 1.0)
    if (sign < 0).any():
        made = _estimate(bins * sign[:, None], frequency_hz, used)
    return replace(made, time_s=made.time_s + at_s, level=made.level * sign, evidence=made.evidence * sign)


def _estimate(bins: NDArray[np.complex128], frequency_hz: NDArray[np.float64], used: NDArray[np.bool_]) -> SoundArrival:
    """Return the estimates for positive amplitudes; times are relative to the centre of the gate."""
    turn = 2 * np.pi * frequency_hz
    steering = np.exp(1j * turn[:, None] * _LAGS_S)
    scale = np.sqrt(np.sum(np.abs(bins) ** 2, axis=1))
    # The sum of the signals would lose a pulse that half of them invert, but the strongest one has it.
    pulse = bins[used][np.argmax(scale[used])]
    for number in range(_ROUNDS):
        product = bins * np.conj(pulse)
        if number < _SEARCHES:
            delay_s = _LAGS_S[np.argmax((product @ steering).real, axis=1)]
        for _ in range(2):
            shifted = product * np.exp(1j * turn * delay_s[:, None])
            slope = -np.sum(shifted.imag * turn, axis=1)
            curvature = -np.sum(shifted.real * turn**2, axis=1)
            delay_s = delay_s - np.clip(slope / np.where(curvature == 0, 1.0, curvature), -_MAX_STEP_S, _MAX_STEP_S)
        aligned = bins * np.exp(1j * turn * delay_s[:, None])
        amplitude = (aligned @ np.conj(pulse)).real / float(np.sum(np.abs(pulse) ** 2))
        pulse = amplitude[used] @ aligned[used] / max(float(np.sum(amplitude[used] ** 2)), 1e-300)
        norm = max(float(np.sqrt(np.sum(np.abs(pulse) ** 2))), 1e-300)
        pulse, amplitude = pulse / norm, amplitude * norm
    power = np.sum(np.abs(bins) ** 2, axis=1)
    rest = np.sum(np.abs(aligned - amplitude[:, None] * pulse) ** 2, axis=1)
    noise = max(_noise(rest[used], len(frequency_hz)), 1e-300)
    opposite = np.max(-((bins * np.conj(pulse)) @ steering).real, axis=1)
    own = float(np.sum(turn**2 * np.abs(pulse) ** 2))
    safe = np.maximum(np.abs(amplitude), 1e-300)
    time_sd_s, level_sd = np.sqrt(noise / (2 * own)) / safe, np.sqrt(noise / 2) / safe
    return SoundArrival(
        time_s=delay_s,
        time_sd_s=time_sd_s,
        level=amplitude,
        level_sd=level_sd,
        coherence=1 - rest / np.maximum(power, 1e-300),
        power=power,
        other_sound=_between_halves(aligned, amplitude, pulse, turn, used, time_sd_s, level_sd),
        evidence=(np.maximum(amplitude, 0.0) ** 2 - np.maximum(opposite, 0.0) ** 2) / noise,
    )


def _between_halves(
    aligned: NDArray[np.complex128],
    amplitude: NDArray[np.float64],
    pulse: NDArray[np.complex128],
    turn: NDArray[np.float64],
    used: NDArray[np.bool_],
    time_sd_s: NDArray[np.float64],
    level_sd: NDArray[np.float64],
) -> tuple[float, float]:
    """Return standard deviations of times and relative levels because of other sound, such as other echoes."""
    # Other sound moves the estimates of both halves of the band differently; noise does so by four times its variance.
    middle = len(turn) // 2
    amplitude = np.where(amplitude == 0, 1e-300, amplitude)  # of a channel that is constant
    late_s, level = [], []
    for half in (slice(None, middle), slice(middle, None)):
        product = aligned[:, half] * np.conj(pulse[half])
        pulse_power = np.abs(pulse[half]) ** 2
        late_s.append(-product.imag @ turn[half] / (amplitude * np.sum(turn[half] ** 2 * pulse_power)))
        level.append(product.real.sum(axis=1) / (amplitude * np.sum(pulse_power)))
    more = []
    for (lower, upper), sd in ((late_s, time_sd_s), (level, level_sd)):
        ratio = float(np.median(((lower - upper)[used] / sd[used]) ** 2)) / _MEDIAN_OF_SQUARE
        typical = float(np.median(sd[used]))
        more.append(typical * math.sqrt(ratio / 4) if ratio > 2 * _NOISE_IN_HALVES else 0.0)
    return more[0], more[1]


def _noise(rest: NDArray[np.float64], n_bins: int) -> float:
    """Return the power of the noise in each frequency bin, from the residual power of each microphone."""
    n_mics = len(rest)
    # Estimates of the pulse and of amplitude and delay take their share of the noise, and so does the gate.
    share = (1 - 1 / n_mics) * (1 - 1 / n_bins) if n_mics > 1 and n_bins > 1 else 1.0
    # The median of residual powers, which do not count microphones with another echo, is below the mean.
    freedom = 2 * n_bins * share
    median = (1 - 2 / (9 * freedom)) ** 3
    return float(np.median(rest)) / (n_bins * share * median * (1 - 5 / 8 * _TAPER))


def _whitened(
    pulses: Compressed, call: Call, at_s: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return spectra of the gates around the given times, in which noise is white, and their frequencies."""
    n_steps = pulses.envelope.shape[1]
    half = min(n_steps // 2 - 1, round(_GATE_S / pulses.step_s))
    steps = np.arange(-half, half + 1)
    turned = pulses.bins * np.exp(2j * np.pi * pulses.frequency_hz * (at_s - pulses.origin_s)[:, None])
    gate = scipy.signal.windows.tukey(len(steps), _TAPER)
    signals = scipy.fft.ifft(turned, n_steps, axis=1)[:, steps % n_steps] * gate
    low_hz, high_hz = pulses.frequency_hz[[0, -1]]
    step_hz = 1 / (len(steps) * pulses.step_s)
    frequency_hz = np.arange(low_hz + step_hz / 2, high_hz, step_hz)
    transform = np.exp(-2j * np.pi * np.outer(steps * pulses.step_s, frequency_hz - low_hz))
    rate_hz = call.sample_rate_hz
    replica = call_samples(call, rate_hz=rate_hz)
    n_fft = scipy.fft.next_fast_len(8 * len(replica), real=True)
    magnitude = np.abs(scipy.fft.rfft(replica, n_fft))
    own = np.interp(frequency_hz, np.fft.rfftfreq(n_fft, 1 / rate_hz), magnitude)
    return signals @ transform / np.maximum(own, _LEAST_SPECTRUM * own.max()), frequency_hz

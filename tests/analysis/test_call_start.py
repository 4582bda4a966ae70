"""Calls of nearly equal slope: another start of the emission shifts ranges, and is named or reported as unknown.

Recordings are rendered from closed forms of the phase, and range errors follow from a correlation of both calls.
"""

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from ertis_numba.analysis.call_match import call_match
from ertis_numba.frames import Measurement
from ertis_numba.settings import Array, Call, Recording, Settings

RATE_HZ = 450e3
SPEED_M_S = 343.0
N_SAMPLES = 9000
PLACES_M = tuple((0.0, 0.01 * mic, 0.003 * (mic % 3)) for mic in range(4))


def sweep(time_s, modulation, start_hz, stop_hz, duration_s, ramp=0.1):
    """Samples of a sweep at times since its start, from the closed form of its phase."""
    inside_s = np.clip(time_s, 0, duration_s)
    if modulation == "linear":
        cycles = start_hz * inside_s + (stop_hz - start_hz) * inside_s**2 / (2 * duration_s)
    else:
        rate = (1 / stop_hz - 1 / start_hz) / duration_s
        cycles = np.log1p(rate * start_hz * inside_s) / rate
    edge_s = np.minimum(time_s, duration_s - time_s)
    return np.sin(np.pi / 2 * np.clip(edge_s / (ramp * duration_s), 0, 1)) ** 2 * np.cos(2 * np.pi * cycles)


def range_error_m(emitted, stated):
    """Error of ranges: half the way of sound in the lag between both calls."""
    time_s = np.arange(2**14) / RATE_HZ - 5e-3
    product = np.fft.rfft(sweep(time_s, *emitted)) * np.conj(np.fft.rfft(sweep(time_s, *stated)))
    envelope = np.abs(np.fft.ifft(product, 2**14))
    lag = int(np.argmax(np.roll(envelope, 2**13))) - 2**13
    return SPEED_M_S / 2 * lag / RATE_HZ


SCENES = {
    "one echo": [(6e-3, 1.0)],
    "six echoes": [(4e-3 + 1.7e-3 * place, (-0.8) ** place) for place in range(6)],
    "direct sound": [(0.4e-3, 3.0), (8e-3, 0.1)],
}


def recorded(emitted, scene, *, snr_db=30, seed=0, ramp=0.1, band_hz=None):
    random = np.random.default_rng(seed)
    time_s, signals = np.arange(N_SAMPLES) / RATE_HZ, np.zeros((N_SAMPLES, len(PLACES_M)))
    for delay_s, amplitude in SCENES[scene]:
        across_s = random.uniform(-2.9e-5, 2.9e-5)
        for mic in range(len(PLACES_M)):
            signals[:, mic] += amplitude * sweep(time_s - delay_s - mic * across_s, *emitted, ramp)
    if band_hz is not None:
        signals = sosfilt(butter(1, band_hz, "band", fs=RATE_HZ, output="sos"), signals, axis=0)
    peak = np.abs(signals).max()
    return (0.1 / peak * signals + 0.1 * 10 ** (-snr_db / 20) * random.standard_normal(signals.shape)).astype("f4")


def compared(data, stated):
    modulation, start_hz, stop_hz, duration_s = stated
    call = Call(modulation=modulation, start_frequency_hz=start_hz, stop_frequency_hz=stop_hz, duration_s=duration_s)
    recording = Recording(sample_rate_hz=RATE_HZ, n_samples=N_SAMPLES, encoding="float32")
    return call_match(Measurement(data, Settings(array=Array(positions_m=PLACES_M), recording=recording, call=call)))


EMITTED = [
    ("hyperbolic", 60e3, 30e3, 2e-3),
    ("hyperbolic", 25e3, 50e3, 2.5e-3),
    ("linear", 110e3, 30e3, 3e-3),
    ("linear", 30e3, 60e3, 4e-3),
]


def of_nearly_equal_slope(modulation, start_hz, stop_hz, duration_s):
    """Calls along nearly the same curve, with other ends, and a call of scaled frequencies."""

    def delay_s(first_hz, last_hz):
        return last_hz - first_hz if modulation == "linear" else 1 / first_hz - 1 / last_hz

    slope = duration_s / delay_s(start_hz, stop_hz)
    for begin, end, longer in ((0.83, 0.83, 1.04), (1.2, 1.2, 1.0), (1.15, 1.0, 1.0), (0.85, 1.0, 1.0)):
        first_hz, last_hz = begin * start_hz, end * stop_hz
        yield modulation, first_hz, last_hz, longer * slope * delay_s(first_hz, last_hz)
    yield modulation, 1.1 * start_hz, 1.1 * stop_hz, duration_s / 1.21


@pytest.mark.parametrize("emitted", EMITTED, ids=str)
def test_calls_of_nearly_equal_slope_are_named_or_unknown(emitted):
    for place, stated in enumerate(of_nearly_equal_slope(*emitted)):
        assert abs(range_error_m(emitted, stated)) > 0.01
        scene = [*SCENES][place % len(SCENES)]
        found = compared(recorded(emitted, scene, snr_db=(40, 20, 10)[place % 3], seed=place), stated)
        assert found.verdict != "matches", (stated, scene)
        assert "ranges in the image are wrong" in found.warning.lower()


def test_call_of_an_earlier_start_is_named():
    found = compared(recorded(("hyperbolic", 60e3, 30e3, 2e-3), "one echo"), ("hyperbolic", 50e3, 25e3, 2.5e-3))
    assert found.verdict == "differs"
    assert "they look like a hyperbolic sweep from about" in found.warning
    assert (found.sweep.start_hz, found.sweep.stop_hz) == pytest.approx((60e3, 30e3), rel=0.05)
    assert found.sweep.duration_s == pytest.approx(2e-3, rel=0.1)


LATER = ("hyperbolic", 80e3, 20e3, 4.5e-3)  # The same period slope as that from 60 to 30 kHz in 2 ms.


@pytest.mark.parametrize(("emitted", "band_hz"), [(EMITTED[0], None), (LATER, (32e3, 42e3))], ids=["other", "narrow"])
def test_emission_that_may_begin_later_is_unknown(emitted, band_hz):
    found = compared(recorded(emitted, "one echo", band_hz=band_hz), LATER)
    assert found.verdict == "unknown"
    assert "of the call; if its emitter has no such band, another call was emitted" in found.warning


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("emitted", EMITTED, ids=str)
def test_right_calls_are_never_named(emitted, scene):
    low_hz, high_hz = sorted(emitted[1:3])
    bands_hz = (None, (0.9 * low_hz, 1.1 * high_hz), (0.9 * np.sqrt(low_hz * high_hz), 1.1 * np.sqrt(low_hz * high_hz)))
    for seed, band_hz in enumerate(bands_hz):
        data = recorded(emitted, scene, snr_db=(15, 30, 40)[seed], seed=seed, band_hz=band_hz)
        found = compared(data, emitted)
        assert found.verdict == "matches" or (band_hz is not None and found.verdict == "unknown"), found


@pytest.mark.parametrize("seed", range(4))
def test_calls_of_another_kind_that_pass_keep_the_stated_range_error(seed):
    random = np.random.default_rng(seed)
    start_hz, width, duration_s = random.uniform(30e3, 60e3), random.uniform(1.2, 1.5), random.uniform(1e-3, 4e-3)
    emitted, stated = ((kind, start_hz, start_hz * width, duration_s) for kind in ("linear", "hyperbolic"))
    found = compared(recorded(emitted, "one echo", seed=seed), stated)
    assert found.verdict != "matches" or abs(range_error_m(emitted, stated)) < SPEED_M_S / 2 * found.start_error_s
    own = compared(recorded(emitted, "one echo", seed=seed), emitted)
    assert own.verdict == "matches"
    assert own.start_error_s < 0.4e-3

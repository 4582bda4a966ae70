"""The sigma-delta modulators against their own equations, and what they keep of the band."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

from ertis_numba import kernels
from ertis_numba.errors import ArgumentError
from ertis_numba.simulation.modulator import Modulator, loop_gains, noise_transfer

RATE_HZ = 4_500_000.0
BAND = 80_000 / RATE_HZ
MASK = 2**64 - 1


def modulate_plainly(signal, key, gains, dither, limit):
    """Step through `modulate_pdm` for one microphone with Python's own numbers; return bits and what was quantised."""
    c1, c2, c3, c4, r1, r2 = gains
    s1 = s2 = s3 = s4 = 0.0
    bits, quantised = [], []
    for sample, u in enumerate(signal.tolist()):
        z = (key + sample * 0x9E3779B97F4A7C15) & MASK
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        noise = ((z ^ (z >> 31)) >> 11) / 2**53 - 0.5
        bit = (u + dither * noise) + ((s1 + s2) + (s3 + s4)) >= 0
        bits.append(int(bit))
        quantised.append(u + ((s1 + s2) + (s3 + s4)))
        d = u - (1 if bit else -1)
        s1 = min(max(s1 + (c1 * d - r1 * s2), -limit), limit)
        s2 = min(max(s2 + c2 * s1, -limit), limit)
        s3 = min(max(s3 + (c3 * s2 - r2 * s4), -limit), limit)
        s4 = min(max(s4 + c4 * s3, -limit), limit)
    return bits, np.array(quantised)


def modulated(signals, order=4, dither=0.5, band=BAND):
    keys = np.random.default_rng(3).integers(0, 2**64, len(signals), dtype=np.uint64)
    return Modulator(keys, order=order, dither=dither, band=band).process(signals)


def tone(amplitude, n_samples=131_072, frequency_hz=41_234.5):
    return amplitude * np.sin(2 * np.pi * frequency_hz / RATE_HZ * np.arange(n_samples))


def in_band_snr_db(bits, signal, low_hz=20_000, high_hz=80_000):
    window = np.hanning(len(signal))
    frequency_hz = np.fft.rfftfreq(len(signal), 1 / RATE_HZ)
    inside = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
    power = np.abs(np.fft.rfft(signal * window)[inside]) ** 2
    error = np.abs(np.fft.rfft((2.0 * bits - 1 - signal) * window)[inside]) ** 2
    return 10 * np.log10(power.sum() / error.sum())


@pytest.mark.parametrize("device", kernels.DEVICES)
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_modulator_does_what_its_equations_say(order, device):
    signals = np.stack([tone(0.4, 3000), np.zeros(3000), np.full(3000, 0.3)])
    signals[0, 1000:1200] = 5.0  # overload, to reach the limits
    keys = np.array([0, 1, 2**64 - 1], dtype=np.uint64)
    gains = loop_gains(order, BAND)
    bits = np.empty(signals.shape, dtype=np.uint8)
    states = np.zeros((3, 4))
    modulate_pdm = kernels.load(device).modulate_pdm
    parts = []
    for block in (slice(0, 1000), slice(1000, 3000)):  # the state goes on from block to block
        part = bits[:, block].copy()
        modulate_pdm(signals[:, block].copy(), keys, states, np.asarray(gains), block.start, 0.5, 2.0, part)
        parts.append(part)
    bits = np.concatenate(parts, axis=1)
    for mic in range(3):
        assert bits[mic].tolist() == modulate_plainly(signals[mic], int(keys[mic]), gains, 0.5, 2.0)[0]


@pytest.mark.parametrize(("order", "least_db"), [(1, 28), (2, 49), (3, 54), (4, 62)])
def test_modulator_keeps_the_band(order, least_db):
    signal = tone(0.5)
    assert in_band_snr_db(modulated(signal[None], order)[0], signal) > least_db


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_noise_is_shaped_as_designed(order):
    """Bits less signal are the quantiser's error, filtered by the noise transfer function: no other filter is left."""
    signal = tone(0.4, 3000)
    bits, quantised = modulate_plainly(signal, 1, loop_gains(order, BAND), 0.5, np.inf)
    error = 2.0 * np.array(bits) - 1 - quantised
    shaped = lfilter(*noise_transfer(order, BAND), error)
    assert_allclose(2.0 * np.array(bits) - 1 - signal, shaped, atol=1e-3)  # gains are rounded to 20 bits


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_zeros_lie_on_the_unit_circle_and_poles_within(order):
    zeros, poles = noise_transfer(order, BAND)
    assert_allclose(np.abs(np.roots(zeros)), 1, atol=1e-6)
    assert np.all(np.abs(np.roots(poles)) < 0.9)
    assert zeros[0] == poles[0] == 1  # a delay of at least one sample around the loop
    assert np.max(np.abs(np.angle(np.roots(zeros)))) < 2 * np.pi * BAND
    gain = abs(np.polyval(zeros, -1) / np.polyval(poles, -1))
    assert gain == pytest.approx(1.5, rel=0.01)


def test_dither_leaves_no_idle_tones():
    """Constant inputs make a modulator sing; with dither no line in the band rises above −85 dB of full scale."""
    n = 65_536
    constants = np.concatenate([[0, 1 / 512, 1 / 256, 1 / 64], np.random.default_rng(0).uniform(-0.3, 0.3, 28)])
    bits = modulated(np.repeat(constants[:, None], n, axis=1))
    lines = np.abs(np.fft.rfft((2.0 * bits - 1) * np.hanning(n))) / (n / 4)
    assert 20 * np.log10(lines[:, n // 225 : int(BAND * n)].max()) < -85


@pytest.mark.parametrize("overload", [1.0, 3.0, 1000.0])
def test_modulator_recovers_from_overload(overload):
    signal = tone(0.3)
    signal[1000:20_000] *= overload / 0.3
    bits = modulated(signal[None])[0]
    assert in_band_snr_db(bits[21_000:], signal[21_000:]) > 58


def test_modulator_is_the_same_for_any_threads_and_blocks():
    signals = np.stack([tone(0.5, 5000, 30_000 + 1000 * mic) for mic in range(5)])
    keys = np.arange(5, dtype=np.uint64)
    whole = Modulator(keys, order=4, dither=0.5, band=BAND).process(signals)
    for count in (1, kernels.load("cpu").max_threads):
        modulator = Modulator(keys, order=4, dither=0.5, band=BAND, threads=count)
        parts = [modulator.process(part) for part in np.split(signals, [1, 777, 778, 4000], axis=1)]
        assert_array_equal(np.concatenate(parts, axis=1), whole)


def test_modulator_refuses_other_orders():
    with pytest.raises(ArgumentError, match="order is 5; give a whole number from 1 to 4"):
        noise_transfer(5, BAND)
    with pytest.raises(ArgumentError, match=r"band is 0\.3; give a number from 0 to 0\.25"):
        noise_transfer(4, 0.3)

"""Sigma-delta modulators follow their equations and preserve the signal band."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import Layout
from ertis_numba.simulation.modulator import Modulator, loop_gains, noise_transfer
from tests.on_device import KERNELS, SIMULATED

RATE_HZ = 4_500_000.0
BAND = 80_000 / RATE_HZ
MASK = 2**64 - 1
COMPARATOR = np.zeros(8)  # without integrators and dither, bits are the signs of signal and noise


def modulate_plainly(signal, key, gains, dither, limit, noise_rms=0.0):
    """Step through `modulate_pdm` for one microphone in plain Python; return the bits and the quantiser's input."""
    c1, c2, c3, c4, r1, r2 = gains
    s1 = s2 = s3 = s4 = 0.0
    scale = noise_rms * (1 / math.sqrt((2**24 - 1) / 3))
    bits, quantised = [], []
    for sample, x in enumerate(signal.tolist()):
        z = (key + sample * 0x9E3779B97F4A7C15) & MASK
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        z ^= z >> 31
        noise = sum(z >> shift & 0xFFF for shift in (0, 12, 24, 36)) - 8190
        u = round((x + scale * noise) * 2**20) / 2**20
        bit = (u + dither * (((z >> 48) + 0.5) / 2**16 - 0.5)) + ((s1 + s2) + (s3 + s4)) >= 0
        bits.append(int(bit))
        quantised.append(u + ((s1 + s2) + (s3 + s4)))
        d = u - (1 if bit else -1)
        s1 = min(max(s1 + (c1 * d - r1 * s2), -limit), limit)
        s2 = min(max(s2 + c2 * s1, -limit), limit)
        s3 = min(max(s3 + (c3 * s2 - r2 * s4), -limit), limit)
        s4 = min(max(s4 + c4 * s3, -limit), limit)
    return bits, np.array(quantised)


def keys_of(n_mics):
    return np.random.default_rng(3).integers(0, 2**64, n_mics, dtype=np.uint64)


def layout_of(enabled, word_bits=8):
    n = len(enabled)
    return Layout("test", np.zeros((n, 3)), np.array(enabled, dtype=bool), np.ones(n), np.zeros(n), word_bits)


def mics_of(n_mics):
    mics = np.full(-(-n_mics // 8) * 8, -1, dtype=np.int32)
    mics[:n_mics] = np.arange(n_mics)
    return mics.reshape(-1, 8)


def bits_of(octets, n_mics):
    """Return the bits of the first channels: (mic, sample)."""
    return np.unpackbits(octets, axis=1, bitorder="little").T[:n_mics]


def modulated(signals, order=4, dither=0.5, noise_rms=0.0):
    n_mics, n_samples = signals.shape
    modulator = Modulator(
        layout_of(np.ones(n_mics)), keys_of(n_mics), np.full(n_mics, noise_rms), order=order, dither=dither, band=BAND
    )
    words = np.empty((n_samples, -(-n_mics // 8)), dtype=np.uint8)
    modulator.process(signals, out=words)
    return bits_of(words, n_mics)


def compared(signals, keys, noise_rms, dither=0.0):
    """Return ±1, the signs of signal plus noise plus dither: (mic, sample)."""
    out = np.empty((signals.shape[1], -(-len(signals) // 8)), dtype=np.uint8)
    loop = COMPARATOR.copy()
    loop[6] = dither
    kernels.load("cpu").modulate_pdm(
        signals, mics_of(len(signals)), keys, noise_rms, np.zeros((len(signals), 4)), loop, 0, out
    )
    return 2.0 * bits_of(out, len(signals)) - 1


def tone(amplitude, n_samples=131_072, frequency_hz=41_234.5):
    return amplitude * np.sin(2 * np.pi * frequency_hz / RATE_HZ * np.arange(n_samples))


def in_band_snr_db(bits, signal, low_hz=20_000, high_hz=80_000):
    window = np.hanning(len(signal))
    frequency_hz = np.fft.rfftfreq(len(signal), 1 / RATE_HZ)
    inside = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
    power = np.abs(np.fft.rfft(signal * window)[inside]) ** 2
    error = np.abs(np.fft.rfft((2.0 * bits - 1 - signal) * window)[inside]) ** 2
    return 10 * np.log10(power.sum() / error.sum())


@pytest.mark.parametrize("device", KERNELS)
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_modulator_follows_its_equations(order, device):
    n = 600 if SIMULATED else 3000
    ties = np.random.default_rng(1).integers(-(2**19), 2**19, n) * 2.0**-21  # half of them between two steps
    signals = np.stack([tone(0.4, n), np.zeros(n), np.full(n, 0.3), ties])
    signals[0, n // 3 : n // 3 + 200] = 5.0  # overload, to reach the limits
    signals[2, n // 3 : n // 3 + 200] = -1e9
    keys = np.array([0, 1, 2**64 - 1, 3], dtype=np.uint64)
    noise_rms = np.array([0.001, 0.0, 0.1, 0.0])
    mics = np.array([[-1, 2, -1, 0, 1, -1, -1, -1], [-1] * 8, [-1, -1, -1, -1, -1, -1, -1, 3]], dtype=np.int32)
    gains = loop_gains(order, BAND)
    states = np.zeros((4, 4))
    modulate_pdm = KERNELS[device].modulate_pdm
    parts = []
    for block in (slice(0, n // 3 + 3), slice(n // 3 + 3, n)):  # the state goes on from block to block
        part = np.full((block.stop - block.start, 3), 255, dtype=np.uint8)
        loop = np.array([*gains, 0.5, 2.0])
        modulate_pdm(signals[:, block].copy(), mics, keys, noise_rms, states, loop, block.start, part)
        parts.append(part)
    bits = np.unpackbits(np.concatenate(parts), axis=1, bitorder="little").T
    for channel, mic in enumerate(mics.ravel()):
        if mic < 0:
            assert not bits[channel].any()
        else:
            wanted, _ = modulate_plainly(signals[mic], int(keys[mic]), gains, 0.5, 2.0, noise_rms[mic])
            assert bits[channel].tolist() == wanted


@pytest.mark.parametrize("word_bits", [8, 16, 32, 64])
@pytest.mark.parametrize("n_mics", [1, 7, 8, 9, 33, 1024])
def test_every_array_gives_the_same_bits_on_every_device(n_mics, word_bits):
    random = np.random.default_rng(n_mics)
    enabled = random.random(n_mics) < 0.8
    enabled[-1] = True
    layout = layout_of(enabled, word_bits)
    n_enabled = int(enabled.sum())
    keys, noise_rms = keys_of(n_enabled), np.where(np.arange(n_enabled) < n_enabled // 2, 0.0, 0.01)
    signals = random.uniform(-0.5, 0.5, (n_enabled, 300))
    words = random.integers(0, 255, (300, layout.n_words)).astype(f"u{word_bits // 8}")
    modulator = Modulator(layout, keys, noise_rms, order=4, dither=0.5, band=BAND)
    for block in np.split(np.arange(300), [1, 258, 265]):
        modulator.process(signals[:, block], out=words[block[0] : block[-1] + 1])

    octets = np.empty((300, -(-n_enabled // 8)), dtype=np.uint8)
    loop, states = np.array([*loop_gains(4, BAND), 0.5, 2.0]), np.zeros((n_enabled, 4))
    kernels.load("numpy").modulate_pdm(signals, mics_of(n_enabled), keys, noise_rms, states, loop, 0, octets)
    channels = np.zeros((layout.n_words * word_bits, 300), dtype=np.uint8)
    channels[:n_mics][enabled] = bits_of(octets, n_enabled)
    for channel, bits in enumerate(channels):
        word = words[:, channel // word_bits].astype(np.uint64)
        assert_array_equal(word >> np.uint64(channel % word_bits) & np.uint64(1), bits)


def test_array_without_microphones_gives_zeros():
    words = np.full((100, 1), 7, dtype=np.uint32)
    empty = np.empty(0)
    modulator = Modulator(layout_of([False] * 5, 32), empty.astype(np.uint64), empty, order=4, dither=0.5, band=BAND)
    modulator.process(np.empty((0, 100)), out=words)
    assert not words.any()


@pytest.mark.parametrize("rms", [0.003, 0.2])
def test_noise_is_nearly_gaussian_with_its_rms(rms):
    """The signs of noise on a constant reveal its distribution: their mean is 1 − 2 P(noise < −constant)."""
    constants = np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0])
    signals = np.repeat(rms * constants[:, None], 200_000, axis=1)
    means = compared(signals, keys_of(7), np.full(7, rms)).mean(axis=1)
    wanted = [math.erf(constant / math.sqrt(2)) for constant in constants]
    assert_allclose(means, wanted, atol=0.02)  # a sum of four numbers differs by up to 0.015 from the normal law
    within = compared(np.full((1, 200_000), 3.47 * rms), keys_of(1), np.array([rms]))
    assert within.min() == 1  # the sum cannot be larger


def test_noise_has_the_given_power():
    """The modulator adds little in the band, so the noise of the bits there is the given noise."""
    n = 131_072
    bits = modulated(np.zeros((32, n)), noise_rms=0.02)
    spectrum = np.abs(np.fft.rfft((2.0 * bits - 1) * np.hanning(n))) ** 2 / np.sum(np.hanning(n) ** 2)
    low, middle, high = n // 300, n // 112, n // 65  # 15, 40 and 69 kHz
    for band in (slice(low, middle), slice(middle, high)):
        assert spectrum[:, band].mean() == pytest.approx(0.02**2, rel=0.03)


def test_noise_and_dither_are_white_and_independent():
    n_mics, n = 9, 100_000
    silence, no_noise = np.zeros((n_mics, n)), np.zeros(n_mics)
    noise = compared(silence, keys_of(n_mics), np.ones(n_mics))
    dither = compared(silence, keys_of(n_mics), no_noise, dither=1.0)
    rows = np.concatenate([noise, dither])
    rows = np.concatenate([rows, np.roll(rows, 1, axis=1), np.roll(rows, 10, axis=1)])
    correlation = rows @ rows.T / n
    assert np.abs(correlation - np.eye(len(rows))).max() < 5 / math.sqrt(n)


def test_noise_of_microphones_is_separate():
    signals = np.stack([tone(0.3, 2000)] * 3)
    keys, gains = keys_of(3), np.array([*loop_gains(4, BAND), 0.5, 2.0])
    octets = np.empty((2, 2000, 1), dtype=np.uint8)
    for out, rms in zip(octets, ([0.0, 0.0, 0.0], [0.0, 0.01, 0.0]), strict=True):
        kernels.load("cpu").modulate_pdm(signals, mics_of(3), keys, np.array(rms), np.zeros((3, 4)), gains, 0, out)
    changed = (bits_of(octets[0], 3) != bits_of(octets[1], 3)).any(axis=1)
    assert changed.tolist() == [False, True, False]


@pytest.mark.parametrize(("order", "min_db"), [(1, 28), (2, 49), (3, 54), (4, 62)])
def test_modulator_keeps_the_band(order, min_db):
    signal = tone(0.5)
    assert in_band_snr_db(modulated(signal[None], order)[0], signal) > min_db


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_noise_has_the_designed_spectrum(order):
    """Bits minus signal are the quantiser's error after the noise transfer function only."""
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
    """Constant inputs cause idle tones; with dither, no line in the band exceeds −85 dB of full scale."""
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


def test_modulator_is_independent_of_threads_and_blocks():
    signals = np.stack([tone(0.5, 5000, 30_000 + 1000 * mic) for mic in range(37)])
    noise_rms = np.linspace(0, 0.01, 37)
    found = set()
    for count in range(1, kernels.load("cpu").max_threads + 1):
        for cuts in ([], [1, 777, 778, 4000]):
            words = np.empty((5000, 2), dtype=np.uint32)
            layout = layout_of(np.ones(37), 32)
            modulator = Modulator(layout, keys_of(37), noise_rms, order=4, dither=0.5, band=BAND, threads=count)
            for block in np.split(np.arange(5000), cuts):
                modulator.process(signals[:, block], out=words[block[0] : block[-1] + 1])
            found.add(words.tobytes())
    assert len(found) == 1


@pytest.mark.parametrize(
    ("spoiled", "message"),
    [
        ({"keys": keys_of(4)}, r"keys has shape \(4,\); pass shape \(3,\)"),
        ({"noise_rms": np.zeros(1)}, r"noise_rms has shape \(1,\); pass shape \(3,\)"),
        ({"signals": np.zeros((3, 9))}, r"signals has shape \(3, 9\); pass shape \(3, 10\)"),
        ({"out": np.zeros((10, 1), np.uint16)}, r"out, in bytes, has shape \(10, 2\); pass shape \(10, 1\)"),
    ],
)
def test_modulator_refuses_wrong_shapes(spoiled, message):
    valid = {"keys": keys_of(3), "noise_rms": np.zeros(3), "signals": np.zeros((3, 10)), "out": np.zeros((10, 1), "u1")}
    given = valid | spoiled
    layout = layout_of([True, False, True, True])
    with pytest.raises(ArgumentError, match=message):
        Modulator(layout, given["keys"], given["noise_rms"], order=4, dither=0.5, band=BAND).process(
            given["signals"], out=given["out"]
        )


def test_modulator_refuses_other_orders():
    with pytest.raises(ArgumentError, match="order is 5; use a whole number from 1 to 4"):
        noise_transfer(5, BAND)
    with pytest.raises(ArgumentError, match=r"band is 0\.3; use a number from 0 to 0\.25"):
        noise_transfer(4, 0.3)

"""Tests of the check that words are PDM.

Refusing a genuine measurement is worse than accepting a corrupt one. Genuine data are a real measurement and its
pieces, and simulated ones. The hard ones come directly from modulators with overload, clicks, noise, low orders or no
dither.
"""

import importlib.metadata
import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba import open_recording
from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices import splice_detection
from ertis_numba.devices.bit_means import BitMeans
from ertis_numba.devices.bits import BitCheck
from ertis_numba.geometry import load_layout
from ertis_numba.settings import Recording
from ertis_numba.simulation import load_scene
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.modulator import Modulator
from ertis_numba.simulation.render import Simulator
from tests.scenes import only

REAL = np.fromfile(importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin"), dtype="<u4")
SYNTHETIC = Path(__file__).parents[2] / "data" / "synthetic"
RATE_HZ, SLOW_HZ, SPEED_M_S = 4.5e6, 1.125e6, 343.0
SHORT = 32_768
TIME_S = np.arange(SHORT) / RATE_HZ
LAYOUT = load_layout("eRTIS_v3D1")
QUIET = slice(12_000, 160_000)  # of the real measurement: after its direct sound
GLITCHES = (41_646, 43_221, 45_321, 46_371, 46_896, 48_471, 142_447, 143_497, 144_022, 145_597)


def recorded(name):
    with open_recording(SYNTHETIC / f"{name}.h5") as recording:
        return np.ascontiguousarray(recording[0].data)


def verdict(words, rate_hz=RATE_HZ, **options):
    return BitCheck(len(words), rate_hz, **{"splices": True, **options}).check(words)


def modulated(signals, seed=1, order=4, dither=0.5, noise=1e-3):
    """Words of a short block: (sample,) uint32."""
    keys = np.random.default_rng(seed).integers(0, 2**63, 32, dtype=np.uint64)
    modulator = Modulator(LAYOUT, keys, np.full(32, noise), order=order, dither=dither, band=0.011, threads=1)
    words = np.empty((SHORT, 1), dtype="<u4")
    modulator.process(np.broadcast_to(signals, (32, SHORT)), out=words)
    return words[:, 0]


def earlier_s(azimuth_deg):
    """Lead of sound from the side at each microphone: (mic, 1)."""
    return LAYOUT.positions_m[:, 1:2] * np.sin(np.radians(azimuth_deg)) / SPEED_M_S


def clicks(width_s, amplitude, azimuth_deg=0.0):
    """Short pulses at five times."""
    since_s = TIME_S + earlier_s(azimuth_deg)
    return amplitude * sum(np.exp(-(((since_s - begin_s) / width_s) ** 2)) for begin_s in np.arange(1, 6) * 1.13e-3)


def hiss(low_hz, high_hz, rms, azimuth_deg=0.0):
    """Noise from one direction."""
    frequency_hz = np.fft.rfftfreq(SHORT, 1 / RATE_HZ)
    spectrum = np.fft.rfft(np.random.default_rng(2).standard_normal(SHORT))
    spectrum[(frequency_hz < low_hz) | (frequency_hz > high_hz)] = 0
    turned = np.fft.irfft(spectrum * np.exp(2j * np.pi * frequency_hz * earlier_s(azimuth_deg)), SHORT)
    return rms * turned / turned.std()


def direct_sound(amplitude):
    """Sweep from 50 to 25 kHz that begins loudly, with a small delay between microphones."""
    since_s = TIME_S - np.arange(32)[:, None] * 5e-6 - 0.4e-3
    inside = (since_s > 0) & (since_s < 2.5e-3)
    return np.where(inside, amplitude * np.sin(2 * np.pi * (50e3 * since_s - 5e6 * since_s**2)), 0)


SOUNDS = {
    "silence": lambda: np.zeros(SHORT),
    "direct sound": lambda: direct_sound(0.3),
    "overload": lambda: direct_sound(3.0),
    "overload thirtyfold": lambda: direct_sound(30.0),
    "clicks from ahead": lambda: clicks(2e-6, 0.3),
    "loud clicks from ahead": lambda: clicks(2e-6, 3.0),
    "clicks to 1 MHz from ahead": lambda: clicks(0.3e-6, 1.0),
    "clicks from nearly ahead": lambda: clicks(6e-6, 0.5, azimuth_deg=2.0),
    "clicks from aside": lambda: clicks(6e-6, 0.5, azimuth_deg=20.0),
    "loud clicks from aside": lambda: clicks(6e-6, 5.0, azimuth_deg=5.0),
    "thuds": lambda: clicks(300e-6, 5.0),
    "wind": lambda: hiss(10.0, 400.0, 0.3) * np.linspace(0.0, 3.0, 32)[:, None],
    "noise from ahead": lambda: hiss(20e3, 160e3, 0.1),
    "noise to 1 MHz from ahead": lambda: hiss(20e3, 1e6, 0.1),
    "loud noise from aside": lambda: hiss(20e3, 80e3, 0.3, azimuth_deg=30.0),
}


@pytest.mark.parametrize("name", SOUNDS)
def test_sound_of_any_modulator_is_accepted_as_pdm(name):
    signals = SOUNDS[name]()
    for order, dither in itertools.product((1, 2, 3, 4), (0.0, 0.5)):
        words = modulated(signals, order=order, dither=dither)
        assert (verdict(words), verdict(words, SLOW_HZ)) == (None, None), (order, dither)


def test_real_measurement_is_accepted_as_pdm():
    """All of its pieces are accepted too, although some words are altered."""
    check = BitCheck(len(REAL), RATE_HZ, splices=True)
    assert check.check(REAL) is None
    for n_samples in (4 * SHORT, SHORT):
        check = BitCheck(n_samples, RATE_HZ, splices=True)
        for first in np.random.default_rng(3).integers(0, len(REAL) - n_samples, 60):
            assert check.check(REAL[first : first + n_samples]) is None


@pytest.mark.parametrize("name", ["reflectors", "reflectors_3d"])
def test_recordings_are_accepted_as_pdm(name):
    assert verdict(recorded(name)) is None


@pytest.mark.parametrize("path", sorted((SYNTHETIC / "scenes").glob("*.toml")), ids=lambda path: path.stem)
def test_simulated_scenes_are_accepted_as_pdm(path):
    scene = load_scene(path)
    first = scene.sensors[0]
    sensors = (first.replace(recording=Recording(n_samples=2 * SHORT)), *scene.sensors[1:])
    simulator = Simulator(scene.replace(sensors=sensors, count=1), plan=only(*EFFECTS))
    assert verdict(simulator.render().data) is None


def test_faulty_microphones_are_reported_but_accepted():
    """Nine are faulty, including all of one byte lane; they may fail one by one between blocks."""
    check = BitCheck(SHORT, RATE_HZ, splices=True)
    words = modulated(SOUNDS["direct sound"]())
    for mask in np.cumsum(1 << np.array([30, 8, 9, 10, 11, 12, 13, 14, 15])):
        assert check.check(words & ~np.uint32(mask)) is None
    assert list(np.flatnonzero(check.density == 0)) == [8, 9, 10, 11, 12, 13, 14, 15, 30]
    assert check.check(words | np.uint32(7)) is None
    assert list(np.flatnonzero(check.density == 1)) == [0, 1, 2]


def test_isolated_altered_words_are_accepted():
    """A real sensor does so: in ten words, the upper half is nearly the lower half of the next word."""
    for word in GLITCHES:
        assert int(REAL[word] >> 16 ^ REAL[word + 1] & 0xFFFF).bit_count() <= 1
    random = np.random.default_rng(4)
    check = BitCheck(len(REAL), RATE_HZ, splices=True)
    for _ in range(15):
        words = REAL.copy()
        for place in random.integers(0, len(words) - 1, 20):
            words[place] = words[place] & 0xFFFF | words[place + 1] << 16
        assert check.check(words) is None


@pytest.mark.parametrize("largest", [2, 256], ids=["bits", "bytes"])
def test_flipped_bits_are_accepted_like_those_of_a_real_sensor(largest):
    random = np.random.default_rng(5)
    check = BitCheck(len(REAL), RATE_HZ, splices=True)
    clear_of_glitches = [
        place for place in range(15_000, 160_000, 3_001) if np.min(np.abs(np.array(GLITCHES) - place)) > 300
    ]
    for place in clear_of_glitches:
        words = REAL.copy()
        words.view(np.uint8)[4 * place + random.integers(0, 4)] ^= random.integers(1, largest)
        assert check.check(words) is None


def lost_and_added(words, random, *, repeats, largest=4_000):
    """Words that lack some bytes at one place and have as many extra bytes at another, at least 8 words away."""
    data, n_bytes = words.tobytes(), int(random.integers(1, largest + 1))
    lost, added = 0, 0
    while abs(lost - added) < n_bytes + 8:
        lost, added = random.integers(n_bytes, len(data) - n_bytes, 2)
    more = data[added - n_bytes : added] if repeats else random.bytes(n_bytes)
    parts = [(lost, lost + n_bytes, b""), (added, added, more)]
    (begin, after, first), (begin_2, after_2, second) = sorted(parts)
    joined = data[:begin] + first + data[after:begin_2] + second + data[after_2:]
    assert len(joined) == len(data)
    return np.frombuffer(joined, dtype="<u4")


def replaced(words, random):
    """Words whose middle part is from another measurement."""
    first, last = np.sort(random.integers(0, len(words), 2))
    other = np.roll(words, random.integers(1, len(words)))
    return np.concatenate([words[:first], other[first:last], words[last:]])


def packets_lost(words, random):
    """Words that lack packets of 512 bytes and end with the start of the next block."""
    n_words = 128 * int(random.integers(1, 8))
    place = int(random.integers(QUIET.start, QUIET.stop - n_words) if len(words) == len(REAL) else len(words) // 2)
    return np.concatenate([words[:place], words[place + n_words :], words[:n_words]])


KINDS = {
    "repeated": lambda words, random: lost_and_added(words, random, repeats=True),
    "random": lambda words, random: lost_and_added(words, random, repeats=False),
    "few repeated": lambda words, random: lost_and_added(words, random, repeats=True, largest=64),
    "replaced": replaced,
    "packets": packets_lost,
}
# Somewhat below what 400 of each gave.
FOUND = {
    "real": {"repeated": 0.97, "random": 0.90, "few repeated": 0.95, "replaced": 0.94, "packets": 0.93},
    "reflectors": {"repeated": 0.90, "random": 0.86, "few repeated": 0.90, "replaced": 0.82},
    "reflectors_3d": {"repeated": 0.85, "random": 0.80, "few repeated": 0.90, "replaced": 0.85},
}


@pytest.mark.parametrize("name", FOUND)
def test_splices_are_detected(name):
    words, random = REAL if name == "real" else recorded(name), np.random.default_rng(6)
    check = BitCheck(len(words), RATE_HZ, splices=True)
    for kind, smallest in FOUND[name].items():
        found = [check.check(KINDS[kind](words, random)) for _ in range(100)]
        assert {*found} <= {None, "splice", "noise"}
        assert np.mean([item is not None for item in found]) >= smallest, kind
    assert check.check(words) is None
    assert BitCheck(len(words), RATE_HZ).check(KINDS["repeated"](words, random)) is None  # unless asked for


def test_data_other_than_pdm_is_refused():
    random = np.random.default_rng(7)
    text = Path(__file__).read_bytes() * 20
    for words, reason in (
        (np.zeros(SHORT, dtype=np.uint32), "constant bits"),
        (np.full(SHORT, 0xFFFF_FFFF, dtype=np.uint32), "constant bits"),
        (np.full(SHORT, 0x1234_5678, dtype=np.uint32), "constant bits"),
        (np.frombuffer(text[: 4 * SHORT], dtype="<u4"), "density"),
        (random.integers(0, 2**32, SHORT, dtype=np.uint32), "noise"),
    ):
        for rate_hz in (RATE_HZ, SLOW_HZ):
            assert verdict(words, rate_hz, splices=False) == reason


@pytest.mark.parametrize("first", [0, 20_000, len(REAL) - 5_000])
def test_intervals_without_pdm_are_refused(first):
    stretch = slice(first, first + 5_000)
    random = np.random.default_rng(8).integers(0, 2**32, 5_000, dtype=np.uint32)
    for value, reason in ((0, "constant bits"), (0xFFFF_FFFF, "constant bits"), (random, "noise")):
        words = REAL.copy()
        words[stretch] = value
        assert verdict(words, splices=False) == reason


def test_density_is_the_fraction_of_ones():
    check = BitCheck(len(REAL), RATE_HZ)
    assert check.density is None
    check.check(REAL)
    bits = np.unpackbits(REAL.view(np.uint8).reshape(-1, 4), axis=1, bitorder="little")
    assert np.array_equal(check.density, bits.mean(axis=0))


def test_channels_without_a_microphone_are_ignored():
    words, enabled = modulated(SOUNDS["silence"]()), np.arange(32) >= 8
    noisy = words & ~np.uint32(0xFF) | np.random.default_rng(9).integers(0, 256, SHORT, dtype=np.uint32)
    assert verdict(noisy, enabled=enabled) is None
    assert verdict(words & np.uint32(0xFF), enabled=enabled) == "constant bits"
    assert verdict(words, enabled=np.zeros(32, dtype=bool)) is None


def test_number_of_examined_impulses_is_limited(monkeypatch):
    looked = []
    monkeypatch.setattr(
        splice_detection.Splices, "_is_splice", lambda *arguments: looked.append(arguments[-2]) is not None
    )
    words = REAL.copy()
    for place in range(20_000, 150_000, 1_000):
        words[place:] = np.roll(words[place:], 3)
    verdict(words)
    assert len(looked) == len({at // 1_000 for at in looked}) == 8


def test_read_only_words_are_accepted_and_unchanged():
    words = REAL.copy()
    words.flags.writeable = False
    assert verdict(words) is None
    assert np.array_equal(words, REAL)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_samples": 4_095}, r"n_samples is 4095; use a whole number of at least 4096"),
        ({"pdm_rate_hz": 0.0}, r"pdm_rate_hz is 0; use a number above 0"),
        ({"enabled": np.ones(8, dtype=bool)}, r"enabled has shape \(8,\); pass shape \(32,\)"),
    ],
)
def test_pdm_check_refuses_invalid_arguments(change, message):
    with pytest.raises(ArgumentError, match=message):
        BitCheck(**{"n_samples": SHORT, "pdm_rate_hz": RATE_HZ} | change)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (np.zeros(SHORT - 1, dtype=np.uint32), r"words has shape \(32767,\); pass shape \(32768,\)"),
        (np.zeros(SHORT, dtype=np.uint16), r"words are uint16; pass uint32"),
    ],
)
def test_pdm_check_refuses_other_arrays(words, message):
    with pytest.raises(ArgumentError, match=message):
        BitCheck(SHORT, RATE_HZ).check(words)


@pytest.mark.parametrize("n_samples", [4096, 5000, 31 * 200, 31 * 200 + 15, 31 * 200 + 16])
def test_bit_means_equal_means_of_samples(n_samples):
    words = np.random.default_rng(n_samples).integers(0, 2**32, n_samples, dtype=np.uint32)
    signs = 2.0 * (words[:, None] >> np.arange(32, dtype=np.uint32) & 1) - 1
    padded = np.pad(signs, ((15, 30), (0, 0)))
    wanted = [padded[first : first + 31].mean(axis=0) for first in range(0, n_samples + 15, 31)]
    assert_allclose(BitMeans(n_samples)(words), np.transpose(wanted), atol=1e-6)


def test_bit_check_loads_no_compiled_kernels():
    program = (
        "import sys, ertis_numba.devices.capture, ertis_numba.devices.bits as bits, numpy as np\n"
        "bits.BitCheck(4096, 4.5e6).check(np.zeros(4096, np.uint32))\n"
        "sys.exit('numba' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)

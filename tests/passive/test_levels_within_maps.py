"""No source is more than 1 dB above the delay-and-sum power of its own direction, computed here in closed form.

``ERTIS_RANDOM_CASES=10000 pytest --timeout 0 tests/passive/test_levels_within_maps.py`` tries more random maps.
"""

import os

import numpy as np

import ertis_numba as ertis
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive.bands import bin_shares

N, RATE_HZ = 4096, 225e3
MAPS_OF_ARRAY = 10
N_MAPS = int(os.environ.get("ERTIS_RANDOM_CASES", "40"))
LIMIT_DB = 1.0


def random_settings(random):
    """A disc, a ring, a line or a volume of 4 to 32 microphones, 1 to 10 cm in radius, and a band."""
    n_mics, turn = int(random.integers(4, 33)), 2.399963 * np.arange(32)
    radius = [np.sqrt((np.arange(n_mics) + 0.5) / n_mics), np.ones(n_mics)][random.integers(2)]
    places = np.stack([0 * radius, radius * np.cos(turn[:n_mics]), radius * np.sin(turn[:n_mics])], axis=1)
    kind = random.integers(4)
    if kind == 2:
        places = np.linspace(-1, 1, n_mics)[:, None] * np.array([0, 1, 0])
    elif kind == 3:
        places = random.uniform(-1, 1, (n_mics, 3))
    low_hz = 10 ** random.uniform(4, 4.6)
    changes = {
        "recording.encoding": "float32",
        "recording.sample_rate_hz": RATE_HZ,
        "recording.n_samples": N,
        "passive.bands_hz": ((low_hz, low_hz * random.uniform(1.1, 1.5)),),
        "array.positions_m": (10 ** random.uniform(-2, -1) * places).round(6).tolist(),
    }
    return ertis.Settings().replace(**changes)


def random_sound(settings, places_m, random):
    """Up to three tones or noises from random directions, and noise of the microphones or none."""
    heard = random.standard_normal((N, len(places_m))) * 10 ** random.uniform(-3, 0) * random.choice([0, 1, 1, 1])
    frequency_hz = np.fft.rfftfreq(2 * N, 1 / RATE_HZ)
    for _ in range(random.integers(0, 4)):
        towards = random.standard_normal(3)
        towards[0] = abs(towards[0])
        early_s = places_m @ (towards / np.linalg.norm(towards)) / sound_speed_m_s(settings.air)
        tone_hz = random.uniform(*settings.passive.bands_hz[0])
        tone = 2 * np.cos(2 * np.pi * tone_hz * np.arange(2 * N) / RATE_HZ + random.uniform(0, 6))
        spectrum = np.fft.rfft(random.standard_normal(2 * N) if random.integers(2) else tone)
        waves = np.fft.irfft(spectrum * np.exp(2j * np.pi * frequency_hz * early_s[:, None]))
        heard += 10 ** random.uniform(-2, 0) * waves[:, N // 2 : N // 2 + N].T
    return ertis.Measurement(heard.astype(np.float32), settings)


def test_no_source_is_louder_than_its_map():
    n_sources = 0
    for number in range(-(-N_MAPS // MAPS_OF_ARRAY)):
        random = np.random.default_rng([5, number])
        settings = random_settings(random)
        with ertis.AcousticCamera(settings, "cpu", 1, check=False, false_alarm=0.1) as camera:
            places_m = microphones(camera.settings.array).enabled_positions_m
            shares = bin_shares(camera.band_hz, camera.frequency_hz)[0].astype(np.float64)
            for _ in range(MAPS_OF_ARRAY):
                found = camera.process(random_sound(settings, places_m, random))
                matrix = camera.cross_spectrum().matrix.astype(np.complex128)
                for each in found.bearings:
                    towards = unit_vectors(np.array([each.azimuth_rad]), np.array([each.elevation_rad]))[0]
                    early = 2 * np.pi * camera.frequency_hz[:, None] * (places_m @ towards)
                    waves = np.exp(1j * early / sound_speed_m_s(settings.air))
                    powers = np.einsum("bi,bij,bj->b", waves.conj(), matrix, waves).real / len(places_m) ** 2
                    assert each.level_dbfs <= 10 * np.log10(shares @ powers) + LIMIT_DB, (number, each)
                n_sources += len(found.bearings)
    assert n_sources >= N_MAPS / 4

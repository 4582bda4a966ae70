"""Default bands of acoustic maps, which follow the record, and notes on the sound outside of them."""

import math
import re
import warnings

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import OutsideBandsWarning
from ertis_numba.figures._acoustic_signals import _spectra
from ertis_numba.geometry import unit_vectors
from ertis_numba.passive.bands import band_edges
from ertis_numba.settings import Array, Passive, Recording

RATES_HZ = (8e3, 16e3, 44.1e3, 48e3, 96e3, 192e3, 250e3, 256e3, 384e3, 500e3)
SPEED_M_S = 331.3 * math.sqrt(1 + 20 / 273.15)
TONE_DBFS = -16.99  # of an amplitude of 0.2
AZIMUTH_DEG = 20.0

pytestmark = pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")


def heard(rate_hz, frequency_hz, *, noise=1e-3, offset=0.0, amplitude=0.2, n_samples=16_384, **changes):
    """Return a measurement with a tone from azimuth 20°, on a ring without grating lobes."""
    angle, radius_m = np.arange(8) * math.pi / 4, 0.2 * SPEED_M_S / max(frequency_hz, 0.02 * rate_hz)
    places_m = np.stack([0 * angle, radius_m * np.cos(angle), radius_m * np.sin(angle)], axis=1)
    turn = math.radians(AZIMUTH_DEG)
    early_s = places_m @ np.array([math.cos(turn), math.sin(turn), 0.0]) / SPEED_M_S
    time_s = np.arange(n_samples)[:, None] / rate_hz + early_s
    random = np.random.default_rng(round(frequency_hz)).normal(0, noise, time_s.shape)
    data = amplitude * np.sin(2 * math.pi * frequency_hz * time_s) + random + offset
    settings = ertis.Settings().replace(
        array=Array(positions_m=tuple(map(tuple, places_m.tolist()))),
        recording=Recording(sample_rate_hz=rate_hz, n_samples=n_samples, encoding="float32"),
        **{"processing.mode": "passive", "processing.directions": "2d:91", **changes},
    )
    return ertis.Measurement(data.astype("f4"), settings, ertis.Stamp(sensor="s", behaviour="passive"))


def mapped(measurement):
    """Return the map of a measurement, and the note on sound outside of its bands."""
    with ertis.AcousticCamera(measurement.settings, check=False) as camera:
        return camera.process(measurement), camera.band_note


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_tones_at_any_frequency_are_found_or_named(rate_hz):
    shares = [*np.random.default_rng(round(rate_hz)).uniform(0.05, 0.99, 2).tolist(), 0.01, 0.95]
    for frequency_hz in (0.5 * rate_hz * share for share in shares):
        found, note = mapped(heard(rate_hz, frequency_hz))
        if found.band_hz.min() < frequency_hz < found.band_hz.max():
            loudest = max(found.loudest(), key=lambda source: source.level_dbfs)
            # A tone at the edge of two bands has half of its power in each.
            both = 10 * math.log10(found.power.sum(axis=1).max())
            assert both == pytest.approx(TONE_DBFS, abs=1.0)
            assert TONE_DBFS - 3.5 < loudest.level_dbfs < TONE_DBFS + 1.0
            assert math.degrees(loudest.azimuth_rad) == pytest.approx(AZIMUTH_DEG, abs=4.0)
            continue
        named, level = re.search(r"strongest at (\S+) kHz with (\S+) dBFS", note).groups()
        assert 1e3 * float(named) == pytest.approx(frequency_hz, abs=2 * rate_hz / 4096)
        assert float(level) == pytest.approx(TONE_DBFS, abs=1.0)
        assert float(note.split(" %")[0]) > 99


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_default_bands_follow_the_record(rate_hz):
    edges = band_edges(Passive(), Recording(sample_rate_hz=rate_hz, n_samples=round(0.1 * rate_hz), encoding="int16"))
    assert edges.max() == pytest.approx(0.4 * rate_hz)
    assert 1.0 <= edges.min() <= max(0.013 * rate_hz, 520.0)
    assert edges[1:, 0] == pytest.approx(edges[:-1, 1])
    assert np.all(np.diff(edges, axis=1) > 0)


@pytest.mark.parametrize("n_samples", [64, 100, 1000])
@pytest.mark.parametrize("rate_hz", [8e3, 500e3])
def test_short_records_have_bands(rate_hz, n_samples):
    found, _ = mapped(heard(rate_hz, 0.3 * rate_hz, n_samples=n_samples))
    assert found.band_hz.max() == pytest.approx(0.4 * rate_hz)


def test_limits_of_pdm_stay():
    edges = band_edges(Passive(), Recording())
    assert edges[[0, -1], [0, 1]].round().tolist() == [8913.0, 89125.0]


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_noise_and_offset_cause_no_note(rate_hz):
    for seed, n_samples in ((1, 16_384), (2, 4096), (3, 700)):
        _, note = mapped(heard(rate_hz, 1.0 + seed, amplitude=0.0, noise=0.05, offset=0.5, n_samples=n_samples))
        assert note is None


def test_own_bands_and_limits_cause_no_note():
    for changes in ({"passive.bands_hz": ((1e3, 5e3),)}, {"passive.limits_hz": (1e3, 9e3)}):
        _, note = mapped(heard(48e3, 23e3, **changes))
        assert note is None


def test_advised_bands_locate_sound_below_the_default_bands():
    measurement = heard(384e3, 2e3, n_samples=38_400)
    _, note = mapped(measurement)
    low_hz, high_hz = map(float, re.search(r"use the band ([\d.]+):([\d.e+]+) Hz", note).groups())
    own = measurement.settings.replace("passive.bands_hz", ((low_hz, high_hz),))
    found, _ = mapped(ertis.Measurement(measurement.data, own, measurement.stamp))
    assert found.loudest()[0].level_dbfs == pytest.approx(TONE_DBFS, abs=1.0)


def test_cameras_warn_once_of_sound_beyond_their_bands():
    measurement = heard(96e3, 45e3)
    camera = ertis.AcousticCamera(measurement.settings)
    with pytest.warns(OutsideBandsWarning, match="at 45 kHz .* record at a higher rate: bands end at 38.4 kHz"):
        camera.process(measurement)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        camera.process(measurement)
    camera.close()


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_spectra_reach_half_the_rate(rate_hz):
    frequency_hz = 0.475 * rate_hz
    power, bins_hz, _, _ = _spectra(heard(rate_hz, frequency_hz), None)
    assert bins_hz[-1] == pytest.approx(rate_hz / 2)
    spectrum = power.mean(axis=1)
    assert bins_hz[spectrum.argmax()] == pytest.approx(frequency_hz, abs=bins_hz[1])
    assert 10 * math.log10(spectrum.sum()) == pytest.approx(TONE_DBFS, abs=0.5)


def edges_of(measurement):
    with ertis.AcousticCamera(measurement.settings, check=False) as camera:
        return camera.band_hz, float(camera.frequency_hz[1] - camera.frequency_hz[0])


@pytest.mark.parametrize("method", ["delay_and_sum", "functional", "capon", "clean_sc"])
@pytest.mark.parametrize("rate_hz", [44.1e3, 384e3])
def test_tones_at_edges_of_bands_are_named_with_their_level(rate_hz, method):
    edges, spacing_hz = edges_of(heard(rate_hz, 0.1 * rate_hz))
    for edge_hz in (edges[1, 1], edges[len(edges) // 2, 1], edges[-2, 1]):
        for steps in (-0.5, 0, 0.4):
            frequency_hz = float(edge_hz) + steps * spacing_hz
            measurement = heard(rate_hz, frequency_hz, **{"passive.method": method})
            _, note = mapped(measurement)
            named, level, low_hz, high_hz = re.search(
                r"tone at (\S+) kHz of about (\S+) dBFS lies at the edge of two bands.* the band (\d+):(\d+) Hz", note
            ).groups()
            assert 1e3 * float(named) == pytest.approx(frequency_hz, abs=0.12 * spacing_hz)
            assert float(level) == pytest.approx(TONE_DBFS, abs=1.0)
            own = measurement.settings.replace("passive.bands_hz", ((float(low_hz), float(high_hz)),))
            found, note = mapped(ertis.Measurement(measurement.data, own, measurement.stamp))
            assert found.loudest()[0].level_dbfs == pytest.approx(TONE_DBFS, abs=1.0)
            assert note is None


@pytest.mark.parametrize("rate_hz", [44.1e3, 384e3])
def test_bands_note_every_tone_that_they_show_half_a_decibel_low(rate_hz):
    edges, spacing_hz = edges_of(heard(rate_hz, 0.1 * rate_hz))
    for edge_hz in (edges[0, 0], edges[2, 0], edges[-1, 1]):
        for steps in np.arange(-3, 3.1, 0.6):
            found, note = mapped(heard(rate_hz, float(edge_hz) + steps * spacing_hz))
            loudest = max(found.loudest(), key=lambda source: source.level_dbfs)
            assert note is not None or loudest.level_dbfs == pytest.approx(TONE_DBFS, abs=0.6)


def test_tones_at_the_highest_edge_need_a_higher_rate():
    _, note = mapped(heard(96e3, 38.3e3))
    assert re.search(r"38.3\d? kHz of about -1[67]\S+ dBFS lies at the edge of the bands, 38.4 kHz.* higher rate", note)


@pytest.mark.parametrize("method", ["capon", "clean_sc", "hr_clean_sc"])
def test_tones_at_the_lowest_edge_are_named_for_all_methods_with_levels(method):
    edges, _ = edges_of(heard(96e3, 9.6e3))
    _, note = mapped(heard(96e3, float(edges[0, 0]), **{"passive.method": method}))
    assert re.search(r"a tone at \S+ kHz of about -1[67]\S+ dBFS lies at the edge of the bands", note)


@pytest.mark.parametrize("method", ["delay_and_sum", "clean_sc"])
def test_tones_within_a_band_are_not_named_on_grids_that_distort_their_spectrum(method):
    turn, radius_m = np.arange(16) * 2.399963, 0.7 * np.sqrt((np.arange(16) + 0.5) / 16)
    position_m = np.stack([0 * turn, radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1)
    settings = (
        ertis.Settings()
        .replace("processing.mode", "passive")
        .replace(array=Array(positions_m=tuple(map(tuple, position_m.tolist()))))
        .replace(recording=Recording(sample_rate_hz=51.2e3, n_samples=12_800, encoding="float32"))
        .replace(passive=ertis.Settings().passive.replace(bands_hz=((17e3, 19e3),), method=method))
        .replace("processing.directions", "3d:400")
    )
    for seed in range(6):
        random = np.random.default_rng(seed)
        (towards,) = unit_vectors(np.radians(random.uniform(-25, 25, 1)), np.radians(random.uniform(-15, 15, 1)))
        time_s = np.arange(12_800)[:, None] / 51.2e3 + (position_m @ towards)[None] / 343.87
        data = 0.3 * np.sin(2 * np.pi * 18e3 * time_s) + random.normal(0, 1e-3, time_s.shape)
        _, note = mapped(ertis.Measurement(data.astype("f4"), settings, ertis.Stamp(behaviour="passive")))
        assert note is None


@pytest.mark.parametrize("method", ["delay_and_sum", "capon", "functional"])
@pytest.mark.parametrize("n_samples", [1024, 2048, 16_384])
def test_noise_at_edges_is_no_tone(n_samples, method):
    for seed in range(6):
        measurement = heard(96e3, 1.0, amplitude=0.0, noise=0.0, n_samples=n_samples, **{"passive.method": method})
        white = np.random.default_rng(seed).normal(0, 0.1, n_samples + 400)
        shapes = (white, np.cumsum(white) * 0.1, np.convolve(white, np.hanning(9)))  # White, red, and low pass.
        for source in shapes:
            shared = source[100 : 100 + n_samples, None]  # From ahead of a ring in one plane.
            _, note = mapped(ertis.Measurement((measurement.data + shared).astype("f4"), measurement.settings))
            assert note is None or "edge" not in note

"""Records without sound, faulty bits, offsets and idle tones: finite images that lose only a faulty channel's share."""

import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.frames import Measurement
from ertis_numba.geometry.waveform import matched_filter_spectrum
from ertis_numba.pipeline import Pipeline
from tests.cases import SHORT, words_of
from tests.hard_cases.echoes import echo_signals, echo_words

SETTINGS = SHORT.replace(processing=SHORT.processing.replace(directions="2d:91"))
N_SAMPLES = SETTINGS.recording.n_samples
ECHO = {"azimuth_deg": 20.0, "range_m": 0.7, "level": 0.5}
ODD = np.arange(N_SAMPLES) % 2 == 1
ALL = np.uint32(0xFFFF_FFFF)
SILENT = {
    "all zero": np.zeros(N_SAMPLES, dtype=np.uint32),
    "all one": np.full(N_SAMPLES, ALL),
    "alternating": np.where(ODD, ALL, np.uint32(0)),
}
CHANNEL = np.uint32(1 << 7)
FAULTS = {
    "stuck at 0": lambda words: words & ~CHANNEL,
    "stuck at 1": lambda words: words | CHANNEL,
    "dead, its modulator idles": lambda words: np.where(ODD, words | CHANNEL, words & ~CHANNEL),
}


def pulses(rate_hz):
    """Output of a modulator for an offset near its limit, one pulse per period: (sample,) uint32 of 0 and 1."""
    phase = np.arange(N_SAMPLES + 1) * (rate_hz / SETTINGS.recording.sample_rate_hz)
    return np.diff(np.floor(phase)).astype(np.uint32)


def image_of(words, settings=SETTINGS, device="auto"):
    image = Pipeline(settings, device, predict=False).process(Measurement(words, settings))
    assert np.isfinite(image.amplitude).all()
    assert image.amplitude.min() >= 0
    return image


def level_db(image):
    return 20 * np.log10(float(image.amplitude.max()))


def require_echo(image, changed_db, abs_db):
    """Require the echo at its position, with the expected change of its level."""
    [peak] = find_peaks(image, top=1)
    assert peak.azimuth_deg == pytest.approx(20, abs=0.1)
    assert peak.range_m == pytest.approx(0.7, abs=3e-4)
    assert level_db(image) - level_db(image_of(echo_words(SETTINGS, **ECHO))) == pytest.approx(changed_db, abs=abs_db)


@pytest.mark.parametrize(
    ("method", "device", "largest_db"), [("fast", "cpu", -130), ("paper", "cpu", -130), ("paper", "numpy", -180)]
)
@pytest.mark.parametrize("name", SILENT)
def test_record_without_sound_gives_an_empty_image(name, method, device, largest_db):
    """Complete records give -146 dBFS at most, because offset and clock lie far out of the band."""
    settings = SETTINGS.replace(processing=SETTINGS.processing.replace(method=method))
    assert level_db(image_of(SILENT[name], settings, device)) < largest_db


@pytest.mark.parametrize(("name", "largest_db"), [("all zero", -70), ("all one", -70), ("alternating", -100)])
def test_constant_record_shows_only_its_initial_step(name, largest_db):
    """A constant starts with a full-scale step at sample 0: -79 dB there, -124 dB beyond 0.5 m."""
    image = image_of(SILENT[name], SETTINGS.replace(processing=SETTINGS.processing.replace(range_m=(0.0, 1.0))))
    assert level_db(image) < largest_db
    assert 20 * np.log10(image.amplitude[:, image.range_m > 0.5].max()) < -110


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_missing_channel_lowers_the_level_by_its_share(fault):
    """One of 32 channels is -0.28 dB."""
    require_echo(image_of(fault(echo_words(SETTINGS, **ECHO))), 20 * np.log10(31 / 32), 0.02)


@pytest.mark.parametrize(("offset", "abs_db"), [(-0.01, 0.02), (0.1, 0.05), (0.3, 0.1)])
def test_offset_leaves_the_level_unchanged(offset, abs_db):
    """An offset of 0.3 of full scale changes the level by 0.05 dB, the noise of the bits themselves."""
    require_echo(image_of(words_of(echo_signals(SETTINGS, **ECHO) + offset)), 0, abs_db)


@pytest.mark.parametrize("rate_hz", [30_000.0, 40_000.0, 45_000.0])
def test_idle_tone_of_one_channel_keeps_the_echo(rate_hz):
    """A tone of -29 dB in the middle of the band replaces the microphone's signal."""
    words = (echo_words(SETTINGS, **ECHO) & ~CHANNEL) | (pulses(rate_hz) * CHANNEL)
    require_echo(image_of(words), 20 * np.log10(31 / 32), 0.05)


@pytest.mark.parametrize("rate_hz", [30_000.0, 40_000.0, 45_000.0])
def test_idle_tone_of_all_channels_has_the_gain_of_the_filter(rate_hz):
    """Compression spreads a tone over the length of the call, within 0.3 dB of the filter's gain."""
    image = image_of(pulses(rate_hz) * ALL)
    n_fft, signal_rate_hz = 2**14, SETTINGS.signal_rate_hz
    matched = matched_filter_spectrum(SETTINGS, n_fft=n_fft)
    gain = np.abs(matched.values[round(rate_hz * n_fft / signal_rate_hz) - matched.first_bin]) / 2
    amplitude = 4 * rate_hz / SETTINGS.recording.sample_rate_hz  # of the first harmonic of short pulses from -1 to 1
    ahead = image.amplitude[np.argmin(np.abs(image.azimuth_rad))]
    assert 20 * np.log10(ahead.max()) == pytest.approx(20 * np.log10(gain * amplitude), abs=0.3)

"""Images of sound from one direction without an echo list no reflectors; echoes in quiet are listed."""

import math
from pathlib import Path

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.analysis.detect import find_peaks, left_out_in_noise
from ertis_numba.analysis.peak_notes import list_notes
from ertis_numba.settings import Recording
from tests.echo_draws import AMPLITUDE, Case, Draws, unit

REFLECTORS = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
FALSE_ALARM, N_DRAWS = 1e-3, 5
MIDDLE = {"azimuth_deg": (-50, 50), "range_m": (0.72, 0.98)}
CASES = {
    "2d": Case("2d:91", 25, **MIDDLE),
    "3d": Case("3d:300", 25, **MIDDLE),
    "bits": Case("2d:91", 25, encoding="pdm", **MIDDLE),
}


def tones(rng, low_hz, high_hz, count):
    """Sum of tones of random frequencies and phases: noise of a band if there are many."""
    hz, phase = rng.uniform(low_hz, high_hz, count), rng.uniform(0, 2 * math.pi, count)
    return lambda time_s: sum(np.cos(2 * math.pi * f * time_s + p) for f, p in zip(hz, phase, strict=True)) / count**0.5


def click(rng):
    """Noise of the band that decays within a third of a millisecond around a random instant."""
    noise, middle_s = tones(rng, 20e3, 60e3, 60), rng.uniform(2e-3, 7e-3)
    return lambda time_s: 3 * noise(time_s) * np.exp(-np.abs(time_s - middle_s) / 0.3e-3)


KINDS = {
    "a hiss": lambda rng: tones(rng, 20e3, 60e3, 60),
    "a narrow hiss": lambda rng: tones(rng, 36e3, 39e3, 60),
    "a tone": lambda rng: tones(rng, 28e3, 47e3, 1),
    "a tone at the edge of the band": lambda rng: tones(rng, 24.5e3, 25.5e3, 1),
    "a click": click,
}


@pytest.fixture(scope="module")
def draws():
    return {name: Draws(case) for name, case in CASES.items()}


@pytest.mark.parametrize("kind", [*KINDS, "crosstalk"])
@pytest.mark.parametrize("name", CASES)
def test_sound_from_one_direction_is_no_reflector(draws, name, kind):
    made, rng = draws[name], np.random.default_rng([3, len(kind)])
    time_s, n_false = np.arange(made.n_samples) / made.rate_hz, 0
    for _ in range(1 if name == "bits" else N_DRAWS):
        lead_s = 0 * made.positions_m[:, 0] if kind == "crosstalk" else made.positions_m @ unit(*made.place(rng)[:2])
        heard = KINDS.get(kind, KINDS["a hiss"])(rng)(time_s + lead_s[:, None] / made.speed_m_s)
        image = made.image(3 * heard + 0.02 * rng.standard_normal(heard.shape))
        assert find_peaks(image, false_alarm=None)
        n_false += bool(find_peaks(image, false_alarm=FALSE_ALARM))
        assert n_false or left_out_in_noise(image, false_alarm=FALSE_ALARM)
        notes = list_notes([(image, [])], false_alarm=FALSE_ALARM)
        assert n_false or any("left out because a hiss, a tone or a click" in each for each in notes)
    assert n_false <= (kind == "a click")  # About 1 of 40 clicks has a single high maximum.


@pytest.mark.parametrize("name", ["2d", "3d"])
def test_echoes_in_quiet_are_reflectors(draws, name):
    made, rng, n_found = draws[name], np.random.default_rng(5), 0
    for _ in range(N_DRAWS):
        image, (_, _, range_m) = made.drawn(rng)
        n_found += any(abs(peak.range_m - range_m) < 0.02 for peak in find_peaks(image, false_alarm=FALSE_ALARM))
        assert not left_out_in_noise(image, false_alarm=FALSE_ALARM)
    assert n_found == N_DRAWS


def test_echo_above_a_hiss_is_a_reflector(draws):
    made, rng = draws["2d"], np.random.default_rng(6)
    time_s = np.arange(made.n_samples) / made.rate_hz
    lead_s = made.positions_m @ unit(-40, 0) / made.speed_m_s
    hiss = 0.2 * tones(rng, 20e3, 60e3, 60)(time_s + lead_s[:, None])
    (peak, *_) = find_peaks(made.image(made.signals(unit(20, 0), 0.85) + hiss), false_alarm=FALSE_ALARM)
    assert (peak.azimuth_deg, peak.range_m) == (pytest.approx(20, abs=1), pytest.approx(0.85, abs=2e-3))
    assert peak.level_dbfs == pytest.approx(20 * math.log10(AMPLITUDE), abs=1)


BEAMFORMERS = [
    ({}, "none"),
    ({"beamformer": "dmas", "dmas_order": 4}, "none"),
    ({}, "coherence_factor"),
    ({"beamformer": "dmas", "dmas_order": 5}, "coherence_factor"),
    ({"beamformer": "capon"}, "none"),
]


@pytest.mark.usefixtures("sound_unchecked")
@pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.ErrorBudgetWarning")  # Budgets hold for echoes.
@pytest.mark.parametrize(("beamformer", "weighting"), BEAMFORMERS)
def test_every_beamformer_lists_the_reflectors_and_no_noise(beamformer, weighting):
    """The scene has five reflectors; noise of single microphones may be steady, or swell within the record."""
    with ertis.open_recording(REFLECTORS) as recording:
        measurement, settings = recording[0], recording.settings.replace("processing.directions", "2d:91")
    for name, value in {**beamformer, "weighting": weighting}.items():
        settings = settings.replace(f"processing.{name}", value)
    found = find_peaks(ertis.Pipeline(settings).process(measurement), false_alarm=FALSE_ALARM)
    assert sorted(each.range_m for each in found) == pytest.approx([1.15, 1.6, 2.45, 3.3, 4.4], abs=0.01)
    pcm = Recording(sample_rate_hz=450e3, n_samples=16_384, encoding="float32")
    settings = settings.replace(recording=pcm).replace("accuracy.max_error_db", -15.0)  # capon keeps no less.
    pipeline, rng = ertis.Pipeline(settings), np.random.default_rng(1)
    swelling = 1 + 9 * np.exp(-(((np.arange(16_384) - 8000) / 1500) ** 2))[:, None]
    for gain in (1.0, swelling):
        noise = (0.01 * gain * rng.standard_normal((16_384, 32))).astype("f4")
        image = pipeline.process(ertis.Measurement(noise, settings))
        assert find_peaks(image, false_alarm=FALSE_ALARM) == []

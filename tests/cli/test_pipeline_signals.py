"""Intermediate signals of a pipeline: demodulated, and after the matched filter."""

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from tests.analysis.test_call_match import CALL, REVERSED, SETTINGS, heard
from tests.cases import CASES, noise


def test_pipeline_returns_demodulated_and_matched_signals():
    measurement = heard(CALL, echoes=((6e-3, 1.0),))
    with Pipeline(SETTINGS, "cpu", 1, predict=False) as pipeline:
        found = pipeline.signals(measurement)
        rate_hz = pipeline.settings.signal_rate_hz
    plain, matched = found.demodulated, found.matched
    assert plain.shape == matched.shape == (len(found.positions_m), len(found.time_s))
    assert found.sample_rate_hz == rate_hz
    assert found.stamp == measurement.stamp
    assert found.settings == pipeline.settings
    assert np.abs(plain).max() == pytest.approx(0.1, rel=0.05)
    envelope = np.abs(matched[3])
    assert np.argmax(envelope) == pytest.approx(6e-3 * rate_hz, abs=1)
    assert found.time_s[np.argmax(envelope)] == pytest.approx(6e-3, abs=1 / rate_hz)
    assert found.range_m[np.argmax(envelope)] == pytest.approx(6e-3 * sound_speed_m_s(SETTINGS.air) / 2, abs=1e-3)
    assert envelope.max() == pytest.approx(0.1, rel=0.05)


def test_pipeline_refuses_signals_of_another_sensor():
    other = heard(CALL, settings=SETTINGS.replace(call=REVERSED))
    with Pipeline(SETTINGS, "cpu", 1, predict=False) as pipeline, pytest.raises(DataError):
        pipeline.signals(other)


def test_signals_have_calibrated_gains_removed_and_delays_left_in():
    settings = CASES["PCM, calibrated"]
    measurement = noise(settings)
    calibrated = settings.array
    plain = settings.replace(array=calibrated.replace(gain=None, delay_s=None))
    with Pipeline(settings, "cpu", 1, predict=False) as pipeline:
        found = pipeline.signals(measurement)
    with Pipeline(plain, "cpu", 1, predict=False) as pipeline:
        raw = pipeline.signals(Measurement(measurement.data, plain))
    enabled = np.array(calibrated.enabled)
    gain = np.array(calibrated.gain)[enabled]
    assert found.demodulated * gain[:, None] == pytest.approx(raw.demodulated, rel=1e-6)
    assert found.delay_s.tolist() == np.array(calibrated.delay_s)[enabled].tolist()


def test_signals_need_an_open_pipeline_and_a_measurement():
    pipeline = Pipeline(SETTINGS, "cpu", 1, predict=False)
    with pytest.raises(ArgumentError, match="measurement is of type str; pass a "):
        pipeline.signals("rec.h5")
    pipeline.close()
    with pytest.raises(ArgumentError, match="the pipeline is closed"):
        pipeline.signals(heard(CALL))

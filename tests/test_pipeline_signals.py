"""Intermediate signals of a pipeline: demodulated, and after the matched filter."""

import numpy as np
import pytest

from ertis_numba.errors import DataError
from ertis_numba.pipeline import Pipeline
from tests.test_call_match import CALL, REVERSED, SETTINGS, heard


def test_pipeline_returns_demodulated_and_matched_signals():
    measurement = heard(CALL, echoes=((6e-3, 1.0),))
    with Pipeline(SETTINGS, "cpu", 1, predict=False) as pipeline:
        plain, matched = pipeline.signals(measurement), pipeline.signals(measurement, matched=True)
        rate_hz = pipeline.settings.signal_rate_hz
    assert plain.shape == matched.shape
    assert np.abs(plain).max() == pytest.approx(0.1, rel=0.05)
    envelope = np.abs(matched[3])
    assert np.argmax(envelope) == pytest.approx(6e-3 * rate_hz, abs=1)
    assert envelope.max() == pytest.approx(0.1, rel=0.05)


def test_pipeline_refuses_signals_of_another_sensor():
    other = heard(CALL, settings=SETTINGS.replace(call=REVERSED))
    with Pipeline(SETTINGS, "cpu", 1, predict=False) as pipeline, pytest.raises(DataError):
        pipeline.signals(other)

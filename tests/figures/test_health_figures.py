"""Health of short or narrow records, noise and dynamic range, and merged reports."""

import dataclasses
import json
import time
import warnings

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.analysis.health import health, merge
from ertis_numba.settings import Call, Recording
from tests import cases
from tests.health_recordings import (
    BY_HAND,
    real,
    sound,
)


@pytest.mark.parametrize("n_samples", [0, 1, 2, 33, 255, 256, 257, 4000, 17_000])
@pytest.mark.parametrize("bits", ["silent", "alternating", "real"])
def test_short_records_are_examined(n_samples, bits):
    rows = {"silent": 0 * real().data, "alternating": np.arange(163_840) % 2 * 0xFFFFFFFF, "real": real().data}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = health(dataclasses.replace(real(), data=rows[bits].astype("<u4")[:n_samples]))
    json.dumps(dataclasses.asdict(report), allow_nan=False)
    if n_samples < 256:
        assert {item.state for item in report.channels} == {"unknown"}
        assert report.unknown == (f"the state of any microphone: the record has {n_samples} samples, fewer than 256",)
    elif bits == "real":
        assert bool(report.unknown) == (n_samples < 17_000)
    else:
        assert len(report.faults) == 1


def test_single_microphone_is_not_compared():
    report = health(cases.noise(cases.CASES["one microphone"]))
    assert report.unknown == ("a dead microphone: no other channel is available for comparison",)
    assert report.noise_dbfs == pytest.approx(-19.5, abs=1.5)


@pytest.mark.parametrize("call", [Call(start_frequency_hz=39_500.0, stop_frequency_hz=40_500.0), Call()])
def test_band_too_narrow_for_the_record_is_reported(call):
    measurement = dataclasses.replace(sound(), settings=sound().settings.replace(call=call))
    assert health(measurement).unknown == (
        ("dead microphones, tones and noise: 65536 samples are too few to resolve the band of 39.5 to 40.5 kHz",)
        if call != Call()
        else ()
    )


@pytest.mark.parametrize("words", [np.zeros(4000, "u4"), np.zeros((4000, 2), "u1"), np.zeros((4000, 1, 1), "u1")])
def test_words_of_another_array_are_refused(words):
    with pytest.raises(ertis.DataError, match=r"its settings describe uint8 of shape \(4000,\); use the settings"):
        health(dataclasses.replace(sound(), data=words))


def test_noise_of_white_bits_is_their_share_in_the_band():
    """Bits have a mean square of 1, spread evenly up to half of their rate."""
    report = health(cases.noise(cases.SHORT.replace(recording=Recording(n_samples=163_840))))
    assert report.noise_dbfs == pytest.approx(10 * np.log10(25e3 / 2.25e6), abs=0.3)


@pytest.mark.parametrize("name", ["default", "wide band", "line of 8", "16 bits, disabled"])
def test_dynamic_range_matches_that_of_images(name):
    """A full-scale echo is 1 in an image. The quietest of a few channels is below their mean."""
    measurements = [cases.noise(cases.CASES[name], seed) for seed in range(4)]
    pipeline = ertis.Pipeline(cases.CASES[name])
    noise = np.mean([np.mean(pipeline.process(measurement).amplitude ** 2) for measurement in measurements])
    reported = merge([health(measurement) for measurement in measurements]).dynamic_range_db
    assert reported == pytest.approx(-10 * np.log10(noise), abs=1.2)


def test_reports_of_several_measurements_are_merged():
    healthy, sick = health(sound()), health(BY_HAND["idle tone"]())
    report = merge([healthy, healthy, sick])
    assert report.measurements == 3
    assert report.faults == dict.fromkeys(sick.faults, (3,))
    assert report.channels[3].noise_dbfs == healthy.channels[3].noise_dbfs
    assert report.channels[3].tone_hz == sick.channels[3].tone_hz
    assert merge([healthy]) == healthy
    quiet = health(dataclasses.replace(sound(), data=np.random.default_rng(1).integers(0, 256, 65_536, np.uint8)))
    assert merge([quiet, quiet]).unknown == ("dead microphones: no sound exceeds the noise by 9 dB",)
    assert merge([quiet, healthy]).unknown == ()
    assert merge([quiet, healthy]).channels[3].level_db == healthy.channels[3].level_db
    with pytest.raises(ertis.ArgumentError, match="reports is empty; pass at least one"):
        merge([])
    with pytest.raises(ertis.ArgumentError, match="reports have different channels; use reports of one array"):
        merge([healthy, health(real())])


def test_health_is_quick():
    health(real())
    start_s = time.process_time()
    health(real())
    assert time.process_time() - start_s < 0.5  # 0.08 s where nothing else runs

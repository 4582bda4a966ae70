"""Health checks name faults on the right channel, and report nothing for healthy arrays."""

import dataclasses
import functools

import numpy as np
import pytest

from ertis_numba.analysis.health import ChannelHealth, Health, NotObservable, health, merge
from ertis_numba.frames import Measurement
from ertis_numba.settings import Recording
from ertis_numba.simulation import Electronics, Point, Tone
from ertis_numba.storage import open_recording
from tests import cases, rings
from tests.health_recordings import (
    BY_HAND,
    DATA,
    EIGHT,
    real,
    rendered,
    sound,
    with_bits,
)
from tests.scenes import line_array

# ---- no false alarm -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["line", "reflectors", "reflectors_3d"])
def test_shipped_recordings_have_no_faults(name):
    with open_recording(DATA / f"{name}.h5") as recording:
        report = health(recording[0])
    assert (report.faults, report.tones_hz, report.unknown) == ({}, (), ())
    assert {item.state for item in report.channels} == {"ok"}


@pytest.mark.parametrize("n_samples", [163_840, 65_536, 40_961])
def test_real_measurement_has_no_faults(n_samples):
    report = health(dataclasses.replace(real(), data=real().data[:n_samples]))
    assert (report.faults, report.tones_hz, report.unknown) == ({}, (), ())
    assert -65 < report.noise_dbfs < -45
    assert 75 < report.dynamic_range_db < 95


@pytest.mark.parametrize(
    "electronics",
    [
        Electronics(),
        Electronics(noise_dbfs=-30.0),
        Electronics(noise_dbfs=-60.0, modulator_order=2),
        Electronics(noise_dbfs=-45.0, gain_spread_db=2.0, delay_spread_s=3e-6, microphone_diameter_m=0.002),
    ],
)
def test_usual_microphones_have_no_faults(electronics):
    sensor = EIGHT.replace(electronics=electronics)
    direct = sensor.replace(emitter=sensor.emitter.replace(direct_sound_db=-65.0))
    for measurement in (rendered(sensor), rendered(direct)):
        assert health(measurement).faults == {}


@pytest.mark.parametrize("name", cases.CASES)
def test_white_bits_are_not_a_fault(name):
    report = health(cases.noise(cases.CASES[name]))
    assert report.faults == {}
    assert "dead microphone" in report.unknown[0]
    assert all(item.level_db is None for item in report.channels)


@pytest.mark.parametrize("n_samples", [256, 1000, 5000])
def test_random_white_bits_are_not_a_fault(n_samples):
    settings = cases.SHORT.replace(recording=Recording(n_samples=n_samples))
    reports = [health(cases.noise(settings, seed)) for seed in range(60)]
    assert merge(reports).faults == {}
    assert max(abs(item.offset) for report in reports for item in report.channels) > 3 / np.sqrt(n_samples)


# ---- faults ---------------------------------------------------------------------------------------


def test_simulated_faults_are_named():
    sensor = EIGHT.replace(electronics=EIGHT.electronics.replace(dead_channels=(2, 5), stuck_low=(0,), stuck_high=(7,)))
    report = health(rendered(sensor))
    assert report.faults == {"stuck at 0": (0,), "dead": (2, 5), "stuck at 1": (7,)}
    assert report.verdict() == "stuck at 0: channel 0; dead: channels 2, 5; stuck at 1: channel 7"
    assert report.channels[2].level_db < -12
    assert report.channels[0].noise_dbfs is None


@pytest.mark.parametrize("name", BY_HAND)
def test_constructed_faults_are_named(name):
    report = health(BY_HAND[name]())
    assert 3 in report.faults[name]
    assert {channel for channels in report.faults.values() for channel in channels} == {3}
    if name in {"stuck at 0", "stuck at 1", "stuck in a pattern"}:
        assert set(report.faults) == {name}
    if name == "idle tone":
        assert report.channels[3].tone_hz == pytest.approx(31e3, abs=600)


def test_silent_array_is_reported():
    report = health(dataclasses.replace(sound(), data=np.zeros_like(sound().data)))
    assert report.verdict() == "stuck at 0: every channel"
    assert (report.noise_dbfs, report.dynamic_range_db) == (None, None)


@functools.cache
def numbers():
    """Signals of microphones with float32 samples."""
    recording = rings.PCM.recording.replace(encoding="float32", n_samples=12_000)
    return rings.heard(rings.PCM.replace(recording=recording))


@pytest.mark.parametrize("scale", [1e-4, 1.0, 300.0])
def test_pcm_numbers_have_no_full_scale(scale):
    """Samples in pascals, for example, have no limit; clipping is reported at any scale."""
    words = numbers().data * np.float32(scale)
    assert health(dataclasses.replace(numbers(), data=words)).faults == {}
    words[:, 5] = np.clip(words[:, 5], -0.4 * np.abs(words).max(), 0.4 * np.abs(words).max())
    assert health(dataclasses.replace(numbers(), data=words)).faults == {"saturated": (5,)}


def test_levels_above_full_scale_refer_to_the_highest_amplitude():
    words = numbers().data
    noise = np.random.default_rng(1).standard_normal(words.shape)
    noisy = 0.1 * words / np.abs(words).max() + 1e-4 * noise

    def reported(peak):
        given = (peak / np.abs(noisy).max() * noisy).astype(np.float32)
        report = health(dataclasses.replace(numbers(), data=given))
        return report.noise_dbfs, report.dynamic_range_db

    at_full_scale = reported(1.0)
    for peak in (3e5, 3e12):
        assert reported(peak) == pytest.approx(at_full_scale, abs=0.01)
    quieter = (at_full_scale[0] - 20, at_full_scale[1] + 20)  # full scale is 1 where nothing goes beyond it
    assert reported(0.1) == pytest.approx(quieter, abs=0.01)
    assert at_full_scale[0] < -60


def test_calibrated_gains_are_not_reported_as_dead():
    gain = (1.0, 2.0, 0.5, 3.0, 0.7, 3.0, 0.2, 3.0)
    words = numbers().data * np.float32(gain)
    assert health(dataclasses.replace(numbers(), data=words)).faults == {"dead": (6,)}
    settings = numbers().settings.replace(array=rings.RING.replace(gain=gain))
    assert health(Measurement(words, settings)).faults == {}
    words[:, 3] *= np.float32(0.2)
    assert health(Measurement(words, settings)).faults == {"dead": (3,)}


def test_disabled_channels_are_ignored():
    dead = health(with_bits(with_bits(sound(), 3, np.zeros(65_536)), 6, np.zeros(65_536)))
    assert dead.faults == {"stuck at 0": (3, 6)}
    array = EIGHT.array.replace(enabled=tuple(channel not in {3, 6} for channel in range(8)))
    settings = sound().settings.replace(array=array)
    report = health(dataclasses.replace(with_bits(sound(), 3, np.zeros(65_536)), settings=settings))
    assert report.faults == {}
    assert [item.channel for item in report.channels] == [0, 1, 2, 4, 5, 7]


def test_tone_on_all_channels_is_not_a_fault():
    tone = Tone(position_m=(1.0, 0.5, 0.0), frequency_hz=34_000.0, level_db=-20.0)
    report = health(rendered(EIGHT, tones=(tone,)))
    assert report.faults == {}
    assert report.tones_hz == pytest.approx((34e3,), abs=600)


@pytest.mark.parametrize("word_bits", [8, 16, 32, 64])
def test_health_accepts_any_words(word_bits):
    sensor = EIGHT.replace(
        array=line_array(70, 0.002).replace(word_bits=word_bits),
        recording=Recording(n_samples=32_768),
        electronics=EIGHT.electronics.replace(dead_channels=(9,), stuck_high=(69,)),
    )
    assert health(rendered(sensor)).faults == {"dead": (9,), "stuck at 1": (69,)}


def test_health_accepts_many_microphones():
    sensor = EIGHT.replace(
        array=line_array(512, 1e-4),
        recording=Recording(n_samples=20_000),
        electronics=EIGHT.electronics.replace(dead_channels=(500,), stuck_low=(255, 256, 257)),
    )
    report = health(rendered(sensor, Point(range_m=0.35, strength_db=-20)))
    assert report.verdict() == "stuck at 0: channels 255-257; dead: channel 500"
    assert len(report.channels) == 512


# ---- faults that recordings cannot show -----------------------------------------------------------


def unseen(**reasons):
    """A report without faults whose recording does not show the named ones, such as ``order="3 others fit"``."""
    lines = tuple(
        NotObservable(faults=(name,), reason=reason, remedy="record again") for name, reason in reasons.items()
    )
    return Health(channels=(ChannelHealth(channel=0, offset=0.0),), not_observable=lines)


def test_merged_reports_keep_what_no_measurement_shows_for_whatever_reason():
    merged = merge([unseen(order="3 others fit", scale="far away"), unseen(order="4 others fit")])
    assert [str(each) for each in merged.not_observable] == ["order: 3 others fit; record again"]
    assert merged.verdict() == "no fault found; not observable: order (record again)"
    assert merge([unseen(order="no echo"), unseen(scale="no echo")]).verdict() == "no fault found"


def test_verdict_names_unknown_checks():
    assert Health(channels=(), unknown=("dead microphones: no sound",)).verdict() == (
        "no fault found; not known: dead microphones: no sound"
    )


@pytest.mark.parametrize(
    ("cases", "left"),
    [
        ([{"a", "b"}, {"b", "c"}], ["order: others fit (1, such as b); move"]),
        ([{"a", "b"}, {"c"}], []),
        ([{"a", "b"}, set()], ["order: others fit (2, such as a); move"]),
        ([{"a"}, {"a"}, None], []),
    ],
)
def test_merged_reports_exclude_the_alternatives_of_each_measurement(cases, left):
    lines = [
        ()
        if each is None
        else (NotObservable(faults=("order",), reason="others fit", remedy="move", cases=tuple(each)),)
        for each in cases
    ]
    reports = [Health(channels=(ChannelHealth(channel=0),), not_observable=each) for each in lines]
    assert [str(each) for each in merge(reports).not_observable] == left

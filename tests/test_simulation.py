"""Rendered scenes against closed forms: arrival times, spreading, noise, and what the modulators keep of them."""

import hashlib
import json
import re
import tracemalloc

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.air import sound_speed_m_s
from ertis_numba.errors import ArgumentError, SettingsError
from ertis_numba.geometry import load_layout, microphones
from ertis_numba.settings import Array, Call, Processing, Recording, Settings
from ertis_numba.simulation import DirectSound, Electronics, Point, Scene, arrivals, load_scene, true_peaks
from ertis_numba.simulation.render import received, render
from ertis_numba.storage import open_recording
from ertis_numba.waveform import call_at

RATE_HZ = 4_500_000.0
SHORT = Settings(
    array=Array(layout="three", positions_m=((0.0, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, -0.03)), word_bits=8),
    recording=Recording(n_samples=40_000),
    processing=Processing(range_m=(0.3, 0.9)),
)
SCENE = Scene(seed=7, sensor=SHORT, points=(Point(azimuth_deg=25, elevation_deg=-10, range_m=0.7, strength_db=-15),))


def signals_of(measurement):
    """Return the bits of every channel as (channel, sample) of +1 and −1."""
    words = measurement.words.reshape(len(measurement.words), -1)
    octets = words.astype(words.dtype.newbyteorder("<")).view(np.uint8)
    return 2.0 * np.unpackbits(octets, axis=1, bitorder="little").T - 1.0


def arrival_s(signal, call, rate_hz, near_s):
    """Find the call in a signal: the peak of the correlation with itself, to a small part of a sample."""
    n = 2 * len(signal)
    frequency_hz = np.fft.rfftfreq(n, 1 / rate_hz)
    inside = (frequency_hz > call.low_frequency_hz) & (frequency_hz < call.high_frequency_hz)
    replica = np.fft.rfft(call_at(call, np.arange(len(signal)) / rate_hz), n)
    product = np.where(inside, np.fft.rfft(signal, n) * np.conj(replica), 0)
    for _ in range(4):  # Newton's steps to the maximum of the exact correlation
        turn = 2j * np.pi * frequency_hz
        turned = product * np.exp(turn * near_s)
        near_s -= np.sum(turned * turn).real / np.sum(turned * turn**2).real
    return near_s


# ---- arrivals --------------------------------------------------------------------------------------


def test_arrivals_follow_the_ways_of_the_sound():
    scene = SCENE.replace(direct_sound=DirectSound(strength_db=-40))
    ways = arrivals(scene)
    positions_m = microphones(SHORT.array).positions_m
    azimuth, elevation = np.radians(25), np.radians(-10)
    point_m = 0.7 * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    back_m = np.linalg.norm(point_m - positions_m, axis=1)
    direct_m = np.linalg.norm(positions_m, axis=1)
    c = sound_speed_m_s(SHORT.air)
    assert_allclose(ways.delay_s, np.stack([direct_m, 0.7 + back_m]) / c, atol=1e-12)
    assert_allclose(ways.amplitude, np.stack([0.01 / direct_m, 10 ** (-15 / 20) / (0.7 * back_m)]), rtol=1e-12)


def test_arrivals_carry_the_spread_of_the_microphones():
    spread = SHORT.array.replace(gain=(1.0, 0.5, 2.0), delay_s=(0.0, 1e-5, -1e-6))
    plain, spread = arrivals(SCENE), arrivals(SCENE.replace(sensor=SHORT.replace(array=spread)))
    assert_allclose(spread.delay_s - plain.delay_s, [[0.0, 1e-5, -1e-6]], atol=1e-12)
    assert_allclose(spread.amplitude / plain.amplitude, [[1.0, 0.5, 2.0]])


@settings(max_examples=30, deadline=None)
@given(azimuth_deg=st.floats(-180, 180), elevation_deg=st.floats(-90, 90), range_m=st.floats(1e-3, 1000))
def test_arrivals_are_finite_everywhere(azimuth_deg, elevation_deg, range_m):
    point = Point(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, range_m=range_m, strength_db=0)
    array = Array(positions_m=((0.0, 0.0, 0.0),))  # the one microphone sits upon the emitter
    ways = arrivals(Scene(sensor=Settings(array=array), points=(point,), direct_sound=DirectSound()))
    assert np.all(np.isfinite(ways.amplitude))
    assert np.all(ways.amplitude <= 1e4)
    assert np.all(ways.delay_s >= 0)


@pytest.mark.parametrize("range_m", [0.3, 0.5123, 0.7])
def test_received_calls_arrive_on_time(range_m):
    scene = SCENE.replace(points=(Point(azimuth_deg=40, range_m=range_m, strength_db=-20),))
    ways = arrivals(scene)
    for mic, signal in enumerate(received(scene, ways, 0, 40_000)):
        wanted_s = ways.delay_s[0, mic]
        assert abs(arrival_s(signal, SHORT.call, RATE_HZ, wanted_s + 3e-7) - wanted_s) * 450e3 < 1e-5


def test_bits_hold_the_arrival_and_the_amplitude():
    """Through 4th order bits with dither, an arrival moves by less than 0.002 of a sample at 450 kHz."""
    scene = SCENE.replace(points=(Point(azimuth_deg=-40, range_m=0.6, strength_db=-15),))
    ways = arrivals(scene)
    bits = signals_of(render(scene))
    clean = received(scene, ways, 0, 40_000)
    for mic in range(3):
        wanted_s = ways.delay_s[0, mic]
        error = (arrival_s(bits[mic], SHORT.call, RATE_HZ, wanted_s + 3e-7) - wanted_s) * 450e3
        assert abs(error) < 0.002
        assert bits[mic] @ clean[mic] / (clean[mic] @ clean[mic]) == pytest.approx(1, abs=0.01)


def test_spreading_falls_by_12_db_when_the_distance_doubles():
    near, far = (
        arrivals(SCENE.replace(points=(Point(range_m=range_m, strength_db=0),))).amplitude for range_m in (10, 20)
    )
    assert_allclose(20 * np.log10(near / far), 12.04, atol=0.01)


def test_true_peaks_are_the_points_strongest_first():
    points = (
        Point(azimuth_deg=10, range_m=1.0, strength_db=-20),
        Point(azimuth_deg=-20, elevation_deg=5, range_m=2.0, strength_db=0),
    )
    strong, weak = true_peaks(SCENE.replace(points=points))
    assert (strong.azimuth_deg, strong.elevation_deg, strong.range_m, strong.level_db) == (-20, 5, 2.0, 0)
    assert weak.level_db == pytest.approx(-20 + 2 * 20 * np.log10(2), abs=0.02)
    assert true_peaks(SCENE.replace(points=())) == []


# ---- rendering -------------------------------------------------------------------------------------


def test_seed_and_index_decide_every_bit():
    noisy = SCENE.replace(electronics=Electronics(noise_dbfs=-60))
    first = render(noisy)
    assert_array_equal(first.words, render(noisy).words)
    others = [render(noisy, 1), render(noisy.replace(seed=8)), render(SCENE)]
    for other in others:
        assert np.mean(other.words != first.words) > 0.1
    assert (others[0].stamp.sequence, others[0].stamp.sync_count, others[0].stamp.timestamp_ns) == (1, 1, 50_000_000)


def test_blocks_do_not_show(monkeypatch):
    scene = SCENE.replace(electronics=Electronics(noise_dbfs=-60), direct_sound=DirectSound())
    whole = render(scene).words
    monkeypatch.setattr("ertis_numba.simulation.render._BLOCK", 1237)
    assert_array_equal(render(scene).words, whole)


def test_words_are_those_of_an_earlier_version():
    """A change of these bits changes every shipped recording: then rebuild data/synthetic, and say so."""
    words = render(SCENE.replace(electronics=Electronics(noise_dbfs=-60))).words
    assert hashlib.sha256(words.tobytes()).hexdigest()[:16] == "2e3d9c39f62416ca"


def test_noise_has_its_level():
    sensor = SHORT.replace(recording=Recording(n_samples=200_000))
    scene = Scene(sensor=sensor, electronics=Electronics(noise_dbfs=-20, dither=0))
    bits = signals_of(render(scene))[:3]
    spectrum = np.abs(np.fft.rfft(bits)) ** 2 / bits.shape[1]  # white noise of level σ: σ² in every bin
    low = spectrum[:, int(0.002 * bits.shape[1]) : int(0.01 * bits.shape[1])]
    assert_allclose(10 * np.log10(low.mean(axis=1)), -20, atol=0.3)
    assert abs(np.corrcoef(bits)[0, 1]) < 0.02  # each microphone has its own


@pytest.mark.parametrize(("word_bits", "n_channels"), [(8, 1), (8, 8), (16, 17), (32, 33), (64, 64), (64, 1024)])
def test_channels_lie_in_their_bits(word_bits, n_channels):
    positions_m = tuple((0.0, 1e-3 * channel, 0.0) for channel in range(n_channels))
    array = Array(layout="line", positions_m=positions_m, word_bits=word_bits)
    sensor = SHORT.replace(array=array, recording=Recording(n_samples=601))
    measurement = render(Scene(sensor=sensor, points=(Point(range_m=0.02, strength_db=-80),)))
    n_words = -(-n_channels // word_bits)
    assert measurement.words.shape == ((601, n_words) if n_words > 1 else (601,))
    assert measurement.words.dtype == f"u{word_bits // 8}"
    bits = signals_of(measurement)
    assert np.all(bits[n_channels:] == -1)
    assert np.all(np.abs(bits[:n_channels].mean(axis=1)) < 0.2)


def test_disabled_channels_hold_zeros():
    layout = load_layout("uRTIS_v1")
    sensor = Settings(array=Array(layout="uRTIS_v1"), recording=Recording(n_samples=500))
    bits = signals_of(render(Scene(sensor=sensor)))
    assert np.all(bits[~layout.enabled] == -1)
    assert np.all(bits[layout.enabled].max(axis=1) == 1)


@pytest.mark.parametrize("n_samples", [1, 7, 4099])
def test_odd_records_render(n_samples):
    scene = Scene(sensor=SHORT.replace(recording=Recording(n_samples=n_samples)), points=(Point(range_m=0.05),))
    assert render(scene).words.shape == (n_samples,)


def test_an_echo_past_the_record_is_not_heard():
    ways = arrivals(SCENE.replace(points=(Point(range_m=900),)))
    assert not received(SCENE, ways, 0, 40_000).any()


def test_memory_does_not_grow_with_the_record():
    scene = SCENE.replace(sensor=SHORT.replace(recording=Recording(n_samples=1_000_000)))
    render(SCENE)
    tracemalloc.start()
    render(scene)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10e6  # the words take 1 MB, the signals would take 24 MB


def test_index_is_checked():
    with pytest.raises(ArgumentError, match="index is -1; give a whole number of at least 0"):
        render(SCENE, -1)


# ---- scenes ----------------------------------------------------------------------------------------

points = st.builds(
    Point,
    azimuth_deg=st.floats(-180, 180),
    elevation_deg=st.floats(-90, 90),
    range_m=st.floats(1e-3, 1000),
    strength_db=st.floats(-300, 120),
)
scenes = st.builds(
    Scene,
    seed=st.integers(0, 2**63 - 1),
    rate_hz=st.floats(0.01, 1000),
    sensor=st.sampled_from([Settings(), SHORT, Settings.from_preset("short_20_80")]),
    electronics=st.builds(
        Electronics,
        noise_dbfs=st.none() | st.floats(-300, 0),
        modulator_order=st.integers(1, 4),
        dither=st.floats(0, 2),
    ),
    direct_sound=st.none() | st.builds(DirectSound, strength_db=st.floats(-300, 120)),
    points=st.lists(points, max_size=4).map(tuple),
)


@settings(max_examples=50, deadline=None)
@given(scenes)
def test_scenes_survive_toml(scene):
    assert Scene.from_toml(scene.to_toml()) == scene


def test_scene_file(tmp_path):
    (tmp_path / "line.csv").write_text("0, 0\n5, 0\n10, 0\n")
    (tmp_path / "scene.toml").write_text('[sensor.array]\nlayout = "line.csv"\n[[points]]\nrange_m = 1\n')
    scene = load_scene(tmp_path / "scene.toml")
    assert scene.points == (Point(range_m=1.0),)
    assert len(microphones(scene.sensor.array).enabled) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed = ", "scene: .*; correct it or take it out"),
        ("sede = 1", "scene: unknown key `sede`; correct it"),
        ("[[points]]\nazimuth_deg = 1", "scene: Object missing required field `range_m`.*points"),
        ("[[points]]\nrange_m = 1\nradius_m = 1", "unknown key `radius_m`.*points"),
        ("[[points]]\nrange_m = 0", r"point\.range_m is 0; give a number from 0\.001 to 1000"),
        ("[[points]]\nrange_m = nan", r"point\.range_m is nan; give a finite number"),
        ("[[points]]\nrange_m = 1\nazimuth_deg = 181", r"point\.azimuth_deg is 181; give a number from -180 to 180"),
        ("[[points]]\nrange_m = 1\nelevation_deg = 91", r"point\.elevation_deg is 91; give a number from -90 to 90"),
        ("[[points]]\nrange_m = 1\nstrength_db = 121", r"point\.strength_db is 121; give a number from -300 to 120"),
        ("[direct_sound]\nstrength_db = 121", r"direct_sound\.strength_db is 121; give a number from -300 to 120"),
        ("[electronics]\nnoise_dbfs = 1", r"electronics\.noise_dbfs is 1; give a number from -300 to 0"),
        ("[electronics]\nmodulator_order = 5", r"electronics\.modulator_order is 5; give a whole number from 1 to 4"),
        ("[electronics]\ndither = 3", r"electronics\.dither is 3; give a number from 0 to 2"),
        ("seed = -1", "seed is -1; give a whole number of at least 0"),
        ("rate_hz = 0", "rate_hz is 0; give a number from 1e-06 to 1e\\+06"),
        ("[sensor.recording]\nn_samples = 0", r"recording\.n_samples is 0; give a whole number from 1 to 268435456"),
    ],
)
def test_bad_scenes_are_refused(text, message):
    with pytest.raises(SettingsError, match=message):
        Scene.from_toml(text)


def test_missing_scene_file(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.toml: .*; give a readable scene file"):
        load_scene(tmp_path / "none.toml")


def test_replace_refuses_unknown_fields():
    with pytest.raises(ArgumentError, match=r"Point field 'range' is unknown .did you mean 'range_m'"):
        SCENE.points[0].replace(range=1.0)
    assert SCENE.points[0].replace(range_m=2.0).range_m == 2.0


def test_call_is_far_below_half_the_pdm_rate():
    """What justifies evaluating the call at the PDM rate: nothing of it is left where it would alias."""
    call = Call(start_frequency_hz=80_000, stop_frequency_hz=20_000)
    fine = np.fft.rfft(call_at(call, np.arange(400_000) / (8 * RATE_HZ)))
    frequency_hz = np.fft.rfftfreq(400_000, 1 / (8 * RATE_HZ))
    beyond = np.abs(fine[frequency_hz > RATE_HZ / 2]).max()
    assert 20 * np.log10(beyond / np.abs(fine).max()) < -190


# ---- the command -----------------------------------------------------------------------------------


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.to_toml(), encoding="utf-8")
    return path


def simulate(*arguments):
    return CliRunner().invoke(cli, ["simulate", *map(str, arguments)])


def test_command_writes_what_render_returns(scene_file, tmp_path):
    target = tmp_path / "out.h5"
    result = simulate(scene_file, "-o", target, "--count", 3, "--seed", 11, "--json", "--quiet")
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {
        "output": str(target),
        "measurements": 3,
        "seed": 11,
        "reflectors": [{"azimuth_deg": 25.0, "elevation_deg": -10.0, "range_m": 0.7, "level_db": 0.0}],
    }
    scene = SCENE.replace(seed=11)
    with open_recording(target) as recording:
        assert len(recording) == 3
        for index, measurement in enumerate(recording):
            assert_array_equal(measurement.words, render(scene, index).words)
            assert measurement.stamp == render(scene, index).stamp
        truth = recording.truth
    assert Scene.from_toml(truth.scene) == scene
    assert truth.seed == 11
    assert_allclose(np.degrees(truth.azimuth_rad), [[25.0]] * 3)
    assert_allclose(np.degrees(truth.elevation_rad), [[-10.0]] * 3)


def test_command_writes_beside_the_scene_and_overwrites_when_told(scene_file):
    assert simulate(scene_file).exit_code == 0
    assert scene_file.with_suffix(".h5").exists()
    refused = simulate(scene_file)
    assert refused.exit_code == 1
    assert "scene.h5 exists; give another name, or ask to overwrite it (--force)" in refused.stderr
    assert simulate(scene_file, "--force").exit_code == 0


def test_command_records_a_scene_without_reflectors(tmp_path):
    path = tmp_path / "empty.toml"
    path.write_text(SCENE.replace(points=()).to_toml(), encoding="utf-8")
    result = simulate(path, "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["reflectors"] == []


@pytest.mark.parametrize(
    ("text", "arguments", "code", "message"),
    [
        (None, (), 1, r"scene\.toml: .*; give a readable scene file"),
        ("sede = 1", (), 1, r"scene\.toml: unknown key `sede`; correct it or take it out"),
        ("[sensor.array]\nlayout = 'eRTIS'", (), 1, "layout 'eRTIS' is unknown"),
        ("", ("--count", "0"), 2, "--count"),
        ("", ("--seed", "-1"), 2, "--seed"),
    ],
)
def test_command_refuses(tmp_path, text, arguments, code, message):
    path = tmp_path / "scene.toml"
    if text is not None:
        path.write_text(text)
    result = simulate(path, *arguments)
    assert result.exit_code == code
    assert re.search(message, result.stderr)
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == ([path] if text is not None else [])

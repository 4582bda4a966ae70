"""Faults are named on the right channel, and what is in order raises no alarm."""

import dataclasses
import functools
import importlib.metadata
import json
import re
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import load_layout
from ertis_numba.settings import Call, Recording, Settings
from ertis_numba.simulation import Electronics, Point, Tone
from ertis_numba.simulation.names import EFFECTS
from ertis_numba.simulation.render import Simulator
from ertis_numba.stages.health import health, limits, merge
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from tests import cases, files, rings
from tests.scenes import SENSOR, line_array, only, scene_of

ROOT = Path(__file__).parents[1]
DATA = ROOT / "data" / "synthetic"
RAW = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
REAL = Settings.from_preset("default_25_50")
EIGHT = SENSOR.replace(
    array=line_array(8, 0.004).replace(word_bits=8),
    recording=Recording(n_samples=65_536),
    electronics=Electronics(noise_dbfs=-45.0),
)
ECHOES = (Point(range_m=0.5, strength_db=-20), Point(azimuth_deg=40, range_m=0.9, strength_db=-10))


def rendered(sensor=EIGHT, *points, **more):
    """A measurement in which every effect acts."""
    return Simulator(scene_of(*(points or ECHOES), sensor=sensor, **more), plan=only(*EFFECTS)).render()


@functools.cache
def sound():
    return rendered()


@functools.cache
def real():
    return Measurement(np.fromfile(RAW, dtype="<u4"), REAL)


def with_bits(measurement, channel, bits):
    """The measurement with other bits, (sample,) of 0 and 1, in one channel of 8-bit or 32-bit words."""
    words = measurement.words & ~words_bit(measurement, channel)
    return dataclasses.replace(measurement, words=words | (np.asarray(bits).astype(words.dtype) << channel))


def words_bit(measurement, channel):
    return measurement.words.dtype.type(1 << channel)


def modulated(signal, channel=0):
    """The usual measurement with one channel that hears a signal of its own, by a first-order modulator."""
    total = np.floor(np.cumsum((1 + np.clip(signal, -1, 1)) / 2 + np.zeros(65_536)))
    return with_bits(sound(), channel, np.diff(total, prepend=0.0) > 0)


TIME_S = np.arange(65_536) / 4.5e6
NOISE = 0.01 * np.random.default_rng(5).standard_normal(65_536)


# ---- no false alarm -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["line", "reflectors", "reflectors_3d"])
def test_shipped_recordings_are_in_order(name):
    with open_recording(DATA / f"{name}.h5") as recording:
        report = health(recording[0])
    assert (report.faults, report.tones_hz, report.unknown) == ({}, (), ())
    assert {item.state for item in report.channels} == {"ok"}


@pytest.mark.parametrize("n_samples", [163_840, 65_536, 40_961])
def test_real_measurement_is_in_order(n_samples):
    report = health(dataclasses.replace(real(), words=real().words[:n_samples]))
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
def test_usual_microphones_are_in_order(electronics):
    sensor = EIGHT.replace(electronics=electronics)
    direct = sensor.replace(emitter=sensor.emitter.replace(direct_sound_db=-65.0))
    for measurement in (rendered(sensor), rendered(direct)):
        assert health(measurement).faults == {}


@pytest.mark.parametrize("name", cases.CASES)
def test_white_bits_are_no_fault(name):
    report = health(cases.noise(cases.CASES[name]))
    assert report.faults == {}
    assert "dead microphone" in report.unknown[0]
    assert all(item.level_db is None for item in report.channels)


@pytest.mark.parametrize("n_samples", [256, 1000, 5000])
def test_white_bits_are_no_fault_by_chance(n_samples):
    settings = cases.SHORT.replace(recording=Recording(n_samples=n_samples))
    reports = [health(cases.noise(settings, seed)) for seed in range(60)]
    assert merge(reports).faults == {}
    assert max(abs(item.offset) for report in reports for item in report.channels) > 3 / np.sqrt(n_samples)


# ---- faults ---------------------------------------------------------------------------------------


def test_faults_of_the_simulator():
    sensor = EIGHT.replace(electronics=EIGHT.electronics.replace(dead_channels=(2, 5), stuck_low=(0,), stuck_high=(7,)))
    report = health(rendered(sensor))
    assert report.faults == {"stuck at 0": (0,), "dead": (2, 5), "stuck at 1": (7,)}
    assert report.verdict() == "stuck at 0: channel 0; dead: channels 2, 5; stuck at 1: channel 7"
    assert report.channels[2].level_db < -12
    assert report.channels[0].noise_dbfs is None


BY_HAND = {
    "stuck at 0": lambda: with_bits(sound(), 3, np.zeros(65_536)),
    "stuck at 1": lambda: with_bits(sound(), 3, np.arange(65_536) % 10_000 > 0),  # with a glitch now and then
    "stuck in a pattern": lambda: with_bits(sound(), 3, np.arange(65_536) % 2),
    "offset": lambda: modulated(0.08 + NOISE + 0.05 * np.sin(2.5e5 * TIME_S), 3),
    "saturated": lambda: modulated(1.5 * np.sin(2.5e5 * TIME_S) * (TIME_S < 2.5e-3) + NOISE, 3),
    "idle tone": lambda: modulated(NOISE + 0.03 * np.sin(2 * np.pi * 31e3 * TIME_S), 3),
    "dead": lambda: with_bits(sound(), 3, np.random.default_rng(2).random(65_536) < 0.5),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_faults_by_hand(name):
    report = health(BY_HAND[name]())
    assert 3 in report.faults[name]
    assert {channel for channels in report.faults.values() for channel in channels} == {3}
    if name in {"stuck at 0", "stuck at 1", "stuck in a pattern"}:
        assert set(report.faults) == {name}
    if name == "idle tone":
        assert report.channels[3].tone_hz == pytest.approx(31e3, abs=600)


def test_all_silent():
    report = health(dataclasses.replace(sound(), words=np.zeros_like(sound().words)))
    assert report.verdict() == "stuck at 0: every channel"
    assert (report.noise_dbfs, report.dynamic_range_db) == (None, None)


@functools.cache
def numbers():
    """What microphones give that speak float32."""
    recording = rings.PCM.recording.replace(encoding="float32", n_samples=12_000)
    return rings.heard(rings.PCM.replace(recording=recording))


@pytest.mark.parametrize("scale", [1e-4, 1.0, 300.0])
def test_numbers_have_no_full_scale(scale):
    """Pascal, for one, goes as high as the sound; what was cut off before is told at any scale."""
    words = numbers().words * np.float32(scale)
    assert health(dataclasses.replace(numbers(), words=words)).faults == {}
    words[:, 5] = np.clip(words[:, 5], -0.4 * np.abs(words).max(), 0.4 * np.abs(words).max())
    assert health(dataclasses.replace(numbers(), words=words)).faults == {"saturated": (5,)}


def test_levels_of_numbers_beyond_1_refer_to_the_highest():
    words = numbers().words
    noise = np.random.default_rng(1).standard_normal(words.shape)
    noisy = 0.1 * words / np.abs(words).max() + 1e-4 * noise

    def told(peak):
        given = (peak / np.abs(noisy).max() * noisy).astype(np.float32)
        report = health(dataclasses.replace(numbers(), words=given))
        return report.noise_dbfs, report.dynamic_range_db

    at_full_scale = told(1.0)
    for peak in (3e5, 3e12):
        assert told(peak) == pytest.approx(at_full_scale, abs=0.01)
    quieter = (at_full_scale[0] - 20, at_full_scale[1] + 20)  # full scale is 1 where nothing goes beyond it
    assert told(0.1) == pytest.approx(quieter, abs=0.01)
    assert at_full_scale[0] < -60


def test_calibrated_gains_make_no_microphone_dead():
    gain = (1.0, 2.0, 0.5, 3.0, 0.7, 3.0, 0.2, 3.0)
    words = numbers().words * np.float32(gain)
    assert health(dataclasses.replace(numbers(), words=words)).faults == {"dead": (6,)}
    settings = numbers().settings.replace(array=rings.RING.replace(gain=gain))
    assert health(Measurement(words, settings)).faults == {}
    words[:, 3] *= np.float32(0.2)
    assert health(Measurement(words, settings)).faults == {"dead": (3,)}


def test_disabled_channels_are_not_looked_at():
    dead = health(with_bits(with_bits(sound(), 3, np.zeros(65_536)), 6, np.zeros(65_536)))
    assert dead.faults == {"stuck at 0": (3, 6)}
    array = EIGHT.array.replace(enabled=tuple(channel not in {3, 6} for channel in range(8)))
    settings = sound().settings.replace(array=array)
    report = health(dataclasses.replace(with_bits(sound(), 3, np.zeros(65_536)), settings=settings))
    assert report.faults == {}
    assert [item.channel for item in report.channels] == [0, 1, 2, 4, 5, 7]


def test_a_tone_that_all_hear_is_no_fault():
    tone = Tone(position_m=(1.0, 0.5, 0.0), frequency_hz=34_000.0, level_db=-20.0)
    report = health(rendered(EIGHT, tones=(tone,)))
    assert report.faults == {}
    assert report.tones_hz == pytest.approx((34e3,), abs=600)


@pytest.mark.parametrize("word_bits", [8, 16, 32, 64])
def test_any_words(word_bits):
    sensor = EIGHT.replace(
        array=line_array(70, 0.002).replace(word_bits=word_bits),
        recording=Recording(n_samples=32_768),
        electronics=EIGHT.electronics.replace(dead_channels=(9,), stuck_high=(69,)),
    )
    assert health(rendered(sensor)).faults == {"dead": (9,), "stuck at 1": (69,)}


def test_many_microphones():
    sensor = EIGHT.replace(
        array=line_array(1024, 1e-4),
        recording=Recording(n_samples=20_000),
        electronics=EIGHT.electronics.replace(dead_channels=(1000,), stuck_low=(511, 512, 513)),
    )
    report = health(rendered(sensor, Point(range_m=0.35, strength_db=-20)))
    assert report.verdict() == "stuck at 0: channels 511-513; dead: channel 1000"
    assert len(report.channels) == 1024


# ---- what cannot be told --------------------------------------------------------------------------


@pytest.mark.parametrize("n_samples", [0, 1, 2, 33, 255, 256, 257, 4000, 17_000])
@pytest.mark.parametrize("bits", ["silent", "alternating", "real"])
def test_short_records(n_samples, bits):
    rows = {"silent": 0 * real().words, "alternating": np.arange(163_840) % 2 * 0xFFFFFFFF, "real": real().words}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = health(dataclasses.replace(real(), words=rows[bits].astype("<u4")[:n_samples]))
    json.dumps(dataclasses.asdict(report), allow_nan=False)
    if n_samples < 256:
        assert {item.state for item in report.channels} == {"unknown"}
        assert report.unknown == (f"anything: {n_samples} samples are fewer than 256",)
    elif bits == "real":
        assert bool(report.unknown) == (n_samples < 17_000)
    else:
        assert len(report.faults) == 1


def test_one_microphone_has_nothing_to_be_compared_with():
    report = health(cases.noise(cases.CASES["one microphone"]))
    assert report.unknown == ("a dead microphone: there is no other to compare it with",)
    assert report.noise_dbfs == pytest.approx(-19.5, abs=1.5)


@pytest.mark.parametrize("call", [Call(start_frequency_hz=39_500.0, stop_frequency_hz=40_500.0), Call()])
def test_a_band_too_narrow_for_the_record_is_told(call):
    measurement = dataclasses.replace(sound(), settings=sound().settings.replace(call=call))
    assert health(measurement).unknown == (
        ("dead microphones, tones and noise: 65536 samples do not resolve the call's band",) if call != Call() else ()
    )


@pytest.mark.parametrize("words", [np.zeros(4000, "u4"), np.zeros((4000, 2), "u1"), np.zeros((4000, 1, 1), "u1")])
def test_words_of_another_array_are_refused(words):
    with pytest.raises(ertis.DataError, match=r"its settings want uint8 of shape \(4000,\): give the settings"):
        health(dataclasses.replace(sound(), words=words))


# ---- figures --------------------------------------------------------------------------------------


def test_noise_of_white_bits_is_what_falls_into_the_band():
    """Bits have a mean square of 1, spread evenly up to half of their rate."""
    report = health(cases.noise(cases.SHORT.replace(recording=Recording(n_samples=163_840))))
    assert report.noise_dbfs == pytest.approx(10 * np.log10(25e3 / 2.25e6), abs=0.3)


@pytest.mark.parametrize("name", ["default", "wide band", "line of 8", "16 bits, disabled"])
def test_dynamic_range_is_that_of_images(name):
    """A full-scale echo is 1 in an image. What is quietest of a few channels is quieter than their mean."""
    measurements = [cases.noise(cases.CASES[name], seed) for seed in range(4)]
    pipeline = ertis.Pipeline(cases.CASES[name])
    noise = np.mean([np.mean(pipeline.process(measurement).energy ** 2) for measurement in measurements])
    told = merge([health(measurement) for measurement in measurements]).dynamic_range_db
    assert told == pytest.approx(-10 * np.log10(noise), abs=1.2)


def test_several_measurements_are_merged():
    healthy, sick = health(sound()), health(BY_HAND["idle tone"]())
    report = merge([healthy, healthy, sick])
    assert report.measurements == 3
    assert report.faults == dict.fromkeys(sick.faults, (3,))
    assert report.channels[3].noise_dbfs == healthy.channels[3].noise_dbfs
    assert report.channels[3].tone_hz == sick.channels[3].tone_hz
    assert merge([healthy]) == healthy
    quiet = health(dataclasses.replace(sound(), words=np.random.default_rng(1).integers(0, 256, 65_536, np.uint8)))
    assert merge([quiet, quiet]).unknown == ("dead microphones: no sound stands out of the noise",)
    assert merge([quiet, healthy]).unknown == ()
    assert merge([quiet, healthy]).channels[3].level_db == healthy.channels[3].level_db
    with pytest.raises(ertis.ArgumentError, match="reports are none; give at least one"):
        merge([])
    with pytest.raises(ertis.ArgumentError, match="reports are of different channels; give those of one array"):
        merge([healthy, health(real())])


@pytest.mark.alone
def test_it_is_quick():
    health(real())
    start_s = time.perf_counter()
    health(real())
    assert time.perf_counter() - start_s < 0.5  # 0.08 s where nothing else runs


# ---- commands -------------------------------------------------------------------------------------


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


@pytest.fixture
def sick(tmp_path):
    """Ten measurements; the last one alone has a stuck bit."""
    words = [real().words] * 9 + [real().words & ~np.uint32(1 << 4)]
    given = [Measurement(each, REAL, Stamp(sequence=number)) for number, each in enumerate(words)]
    return write_recording(tmp_path / "rec.h5", given)


def test_info_tells_the_health(sick, tmp_path):
    held = json.loads(run("info", sick, "--health", "--json").stdout)
    [section] = held["sensors"]
    assert (section["measurements"], section["looked_at"]) == (10, 8)
    assert section["faults"] == {"stuck at 0": [4]}
    assert [row["state"] for row in section["channels"][3:6]] == ["ok", "stuck at 0", "ok"]
    assert section["dynamic_range_db"] == pytest.approx(84, abs=3)
    lines = run("info", sick, "--health").stdout.splitlines()
    assert "10, of which 8 looked at" in lines[1]
    assert lines[9].split()[:4] == ["4", "stuck", "at", "0"]
    assert len({len(line) for line in lines[4:37]}) == 1
    assert lines[37].startswith("not observable ") or lines[37].startswith("fault ")
    assert any(line.startswith("fault          channel 4: stuck at 0, 0 (limit 0.001); put them") for line in lines)
    image = write_energyscapes(tmp_path / "img.h5", [files.image()])
    done = run("info", image, "--health", code=1)
    assert done.stderr == (
        f"ertis: error: {image} is an energyscape file, wanted a recording; give the recording it was made from\n"
    )
    assert done.stdout == ""


@pytest.fixture
def faulty(tmp_path):
    """A recording whose first measurement has two stuck bits."""
    words = real().words & ~np.uint32(1 << 4) | np.uint32(1 << 9)
    second = dataclasses.replace(real(), stamp=Stamp(sequence=1))
    return write_recording(tmp_path / "rec.h5", [dataclasses.replace(real(), words=words), second])


# Converter noise is a larger part of so small an image than the default budget permits, which `process` reports, too.
FAST = ["--directions", "2d:5", "--range", "0.8:1.2", "--quiet", "--max-error", "-25"]


def test_process_warns_once(faulty, tmp_path):
    done = run("process", faulty, "-o", tmp_path / "img.h5", *FAST)
    assert done.stderr == (
        f"ertis: warning: {faulty}: sensor sensor has faulty microphones (stuck at 0: channel 4; stuck at 1: "
        "channel 9); put them under 'disabled' in a layout file for --settings, or see 'ertis info --health'\n"
    )
    assert (tmp_path / "img.h5").exists()


def test_process_refuses_if_asked_to(faulty, tmp_path):
    done = run("process", faulty, "-o", tmp_path / "img.h5", *FAST, "--strict", code=1)
    assert done.stderr.startswith(f"ertis: error: {faulty}: sensor sensor has faulty microphones (stuck at 0: channel")
    assert done.stderr.count("\n") == 1
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_the_remedy_helps(faulty, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    layout = load_layout("eRTIS_v3D1")
    rows = (1000 * layout.positions_m).tolist()
    Path("mine.toml").write_text(f"positions_mm = {rows}\ndisabled = [4, 9]\n")
    Path("settings.toml").write_text('array.layout = "mine.toml"\n')
    done = run("process", faulty, "-o", "img.h5", *FAST, "--settings", "settings.toml", "--strict")
    assert done.stderr == ""


def test_process_says_nothing_of_what_is_in_order(tmp_path):
    path = write_recording(tmp_path / "rec.h5", [real()])
    assert run("process", path, "-o", tmp_path / "img.h5", *FAST, "--strict").stderr == ""


def test_silence_is_no_fault_of_single_microphones(tmp_path):
    path = write_recording(tmp_path / "rec.h5", [dataclasses.replace(real(), words=0 * real().words)])
    told = run("process", path, "-o", tmp_path / "img.h5", *FAST).stderr
    assert "(stuck at 0: every channel); check its cable and supply, or see" in told


def test_page_shows_what_the_commands_print(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("data").symlink_to(ROOT / "data")
    page = (ROOT / "docs" / "health.md").read_text()
    for block in re.findall(r"```\n(.*?)```", page, re.DOTALL):
        for part in block.split("$ ertis ")[1:]:
            command, shown = part.split("\n", 1)
            done = run(*command.split(), *["--quiet"] * (not command.startswith("info")))
            assert done.stdout + done.stderr == shown, command


def test_page_has_the_limits():
    page = (ROOT / "docs" / "health.md").read_text()
    for told in (
        f"less than {100 * limits.MIN_CHANGES:g} % of",
        f"more than {100 * limits.MAX_SATURATED:g} % of",
        f"more than {limits.MAX_OFFSET:g} |",
        f"more than {limits.MAX_TONE_DB:g} dB out of",
        f"more than {-limits.MIN_LEVEL_DB:g} dB below",
        f"rise by {limits.MIN_RISE_DB:g} dB",
        f"first\n{limits.MAX_SAMPLES:,} samples",
        f"{limits.MAX_NOISE_DB:g} dB, or five",
        f"{-limits.MAX_WHITE_DB:g} dB below white bits",
        f"{-limits.MAX_FLIPPED_DB:g} dB below white bits, up to {-limits.MAX_FLIPS_DB:g} dB",
        f"{limits.MAX_STUCK_SAMPLES:,} samples, {limits.MAX_STUCK_NUMBERS} of PCM",
        f"{limits.MAX_HUM:g}, or four",
        f"{limits.MAX_GAIN_DB:g} dB, or five",
        f"| {1e6 * limits.MAX_DELAY_S:g} µs |",
        f"{limits.MIN_REPEATED_SAMPLES} samples",
        f"{1e6 * limits.MAX_SHIFT_S:g} µs",
        f"{limits.MAX_SWAP_DB:g} dB |",
    ):
        assert told in page, told

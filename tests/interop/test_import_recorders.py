"""Import of recorders' files: microphones in separate files, levels, silence of a trigger, and the range window."""

import re

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.io import wavfile

import ertis_numba as ertis
from ertis_numba.base.errors import DataError
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.sensor_check import check_recording
from ertis_numba.settings import Array, Call, Recording, Settings, record_range_m
from ertis_numba.simulation import Point
from ertis_numba.simulation.render import Simulator
from tests.interop.test_sync_channel import record
from tests.pages import commands_in, page, run_here
from tests.rings import PCM, RATE_HZ, scene_of

LINE = Settings(array=Array(layout="line", positions_m=tuple((0.0, 0.01 * place, 0.0) for place in range(4))))


def noise(n_samples=6_000, n_channels=1, seed=1, level=60):
    return np.random.default_rng(seed).normal(0, level, (n_samples, n_channels)).round().astype("<i2")


def write(path, samples, rate_hz=RATE_HZ):
    wavfile.write(path, rate_hz, samples)
    return path


def imported(*arguments):
    done = CliRunner().invoke(cli, ["import", "signals", *map(str, arguments)])
    assert done.exit_code == 0, done.stderr
    return done.stderr


# ---- one file per microphone ----------------------------------------------------------------------


def test_joined_files_are_the_channels(tmp_path):
    samples = noise(n_channels=4)
    paths = [write(tmp_path / f"mic{place}.wav", samples[:, place]) for place in range(4)]
    reader = ertis.open_pcm(paths, LINE, passive=True, join=True)
    (measurement,) = reader
    assert np.array_equal(measurement.data, samples)
    assert (
        "mic0.wav: the files were joined as channels, channel 0 first: mic0.wav, mic1.wav, mic2.wav, mic3.wav"
        in reader.notes
    )


def test_joined_stereo_files_are_the_channels(tmp_path):
    samples = noise(n_channels=4)
    paths = [write(tmp_path / f"{place}.wav", samples[:, place : place + 2]) for place in (0, 2)]
    (measurement,) = ertis.open_pcm(paths, LINE, passive=True, join=True)
    assert np.array_equal(measurement.data, samples)


def test_joined_folder_has_the_order_of_numbers(tmp_path):
    array = Array(layout="line", positions_m=tuple((0.0, 0.01 * place, 0.0) for place in range(12)))
    samples = noise(n_channels=12)
    for place in range(12):
        write(tmp_path / f"mic{place}.wav", samples[:, place])
    (measurement,) = ertis.open_pcm(tmp_path, Settings(array=array), passive=True, join=True)
    assert np.array_equal(measurement.data, samples)


def test_joined_files_are_cut_to_the_shortest(tmp_path):
    paths = [write(tmp_path / f"{place}.wav", noise(6_000 - place)[:, 0]) for place in range(4)]
    reader = ertis.open_pcm(paths, LINE, passive=True, join=True)
    (measurement,) = reader
    assert measurement.data.shape == (5_997, 4)
    assert any(
        "the files differ in length; up to 1.563e-05 s at the end were left out" in note for note in reader.notes
    )


NOT_JOINED = {
    "one file per microphone": (
        {"count": 4},
        {},
        r"the total of all 4 files; use join=True if the files are",
    ),
    "too few files": ({"count": 3}, {"join": True}, r"has 3 channels, but array 'line' has 4; write one row"),
    "rates": (
        {"count": 4, "rates_hz": (RATE_HZ, 96_000)},
        {"join": True},
        r"1.wav has 96000 Hz, but 0.wav has 192000; join only files of one recorder",
    ),
    "alphabet": (
        {"count": 4, "names": ("mic1", "mic10", "mic2", "mic3")},
        {"join": True},
        r"the files are in alphabetical order: mic1.wav, mic10.wav, mic2.wav, mic3.wav; list them in the order",
    ),
    "takes": (
        {"count": 4, "names": ("20240518_042537", "20240518_042637", "20240518_042737", "20240518_042837")},
        {"join": True},
        r"042637.wav begins 60 s after 20240518_042537.wav; join only files that begin at the same time",
    ),
}


@pytest.mark.parametrize("name", NOT_JOINED)
def test_files_of_other_microphones_are_refused(tmp_path, name):
    made, options, message = NOT_JOINED[name]
    names, rates_hz = made.get("names", range(made["count"])), made.get("rates_hz", (RATE_HZ,))
    paths = [
        write(tmp_path / f"{each}.wav", noise()[:, 0], rates_hz[place % len(rates_hz)])
        for place, each in enumerate(names)
    ]
    with pytest.raises(DataError, match=message):
        ertis.open_pcm(paths, LINE, passive=True, **options)


def test_join_command_combines_files(tmp_path):
    for place in range(4):
        write(tmp_path / f"m{place}.wav", noise(seed=place)[:, 0])
    (tmp_path / "line.csv").write_text("0, 0\n10, 0\n20, 0\n30, 0\n")
    arguments = (tmp_path, "--layout", tmp_path / "line.csv", "--passive", "-o", tmp_path / "rec.h5")
    refused = CliRunner().invoke(cli, ["import", "signals", *map(str, arguments)])
    assert refused.exit_code == 1
    assert "use --join" in refused.stderr
    imported(*arguments, "--join")
    with ertis.open_recording(tmp_path / "rec.h5") as recording:
        assert recording[0].data.shape == (6_000, 4)


def test_commands_of_the_page_run(tmp_path):
    """Runs all commands of recordings.md."""
    for folder, names in (("CARD", ("20240518_042537", "20240518_042637")), ("MICROPHONES", ("mic1", "mic2"))):
        (tmp_path / folder).mkdir()
        for name in names:
            write(tmp_path / folder / f"{name}.wav", noise()[:, 0])
    (tmp_path / "one.csv").write_text("0, 0\n")
    (tmp_path / "PAIR.csv").write_text("y_mm, z_mm\n0, 0\n10, 0\n")
    write(tmp_path / "LOOPBACK.wav", record([1.37e-3], 0.02).astype("f4"))
    ring_file(tmp_path).rename(tmp_path / "CALL.toml")
    for each in commands_in(page("recordings")):
        run_here(tmp_path, each)
    with ertis.open_recording(tmp_path / "joined.h5") as recording:
        assert recording[0].data.shape == (6_000, 2)


# ---- levels ---------------------------------------------------------------------------------------

ONE = Settings(array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),)))
SINE = np.sin(2 * np.pi * 0.05 * np.arange(6_000))
LEVELS = {
    "float of 16 bits": (
        (30_000 * SINE).astype("f4"),
        "reach 3.* full scale is 1, so levels are up to 90 dB too",
    ),
    "float of 24 bits": ((2.0**22 * SINE).astype("f4"), "divide the samples by 8.38861e"),
    "pascals": (
        (6 * SINE).astype("f4"),
        "or if they are pascals, set array.sensitivity_dbfs = 3 for levels in dB re 20",
    ),
    "silence": (np.zeros(6_000, "<i2"), "all samples are 0; choose another input of the recorder"),
    "silent bytes": (np.full(6_000, 128, "u1"), "all samples are 0; choose"),
    "16 bits in 32": (
        (30_000 * SINE).round().astype("<i4"),
        r"32 bits reach only 30000, as those of 16 bits do; if they are such, levels are 96 dB too low; .* by 65536",
    ),
    "24 bits in 32": ((2.0**22 * SINE).round().astype("<i4"), r"24 bits do; .* 48 dB too low; multiply .* by 256"),
    "24 bits in 64": ((2.0**22 * SINE).round().astype("<i8"), r"24 bits do; .* 241 dB too low; .* by 1099511627776"),
    "clipped int16": ((60_000 * SINE).clip(-32_768, 32_767).astype("<i2"), r"samples of channel 0 are at full scale"),
    "clipped float": ((2 * SINE).clip(-1, 1).astype("f4"), r"samples of channel 0 are at full scale"),
    "clipped bytes": (((400 * SINE).clip(-128, 127) + 128).astype("u1"), r"samples of channel 0 are at full scale"),
    "clipped int32": ((2.0**32 * SINE).clip(-(2.0**31), 2.0**31 - 1).astype("<i4"), "channel 0 are at full scale"),
}


@pytest.mark.parametrize("name", LEVELS)
def test_unusual_levels_are_noted(tmp_path, name):
    samples, message = LEVELS[name]
    reader = ertis.open_pcm(write(tmp_path / "a.wav", samples), ONE, passive=True)
    assert len(list(reader)) == 1
    assert any(re.search(message, note) for note in reader.notes), reader.notes


@pytest.mark.parametrize(
    "samples",
    [
        (32_767 * SINE[:30]).round().astype("<i2"),
        (1.5 * SINE).astype("f4"),  # A converter of floating-point samples does not clip at 1.
        (0.99 * SINE).astype("f4"),
        noise(),
        (2.0**20 * SINE).round().astype("<i4") * 256,
        (2.0**13 * SINE).round().astype("<i4") * 256,
        (2.0**24 * SINE).round().astype("<i4"),
    ],
    ids=["normalised", "float beyond 1", "float", "noise", "24 bits, high", "24 bits, quiet", "32 bits"],
)
def test_usual_levels_need_no_note(tmp_path, samples):
    reader = ertis.open_pcm(write(tmp_path / "a.wav", samples), ONE, passive=True)
    assert len(list(reader)) == 1
    assert not any("full scale" in note or "levels" in note for note in reader.notes)


def test_short_file_among_longer_ones_is_named(tmp_path):
    paths = [write(tmp_path / f"{place}.wav", noise(count)) for place, count in enumerate((90_000, 400, 90_000))]
    reader = ertis.open_pcm(paths, ONE, passive=True)
    assert any("because 1.wav lasts only 0.002083 s; use length_s" in note for note in reader.notes)


# ---- silence of a trigger -------------------------------------------------------------------------


@pytest.mark.parametrize(("first", "last"), [(20_000, 0), (0, 20_000), (20_000, 9_000)])
@pytest.mark.parametrize("kind", ["int16", "float32"])
@pytest.mark.parametrize("n_channels", [1, 4])
def test_silence_at_both_ends_is_no_fault(tmp_path, first, last, kind, n_channels):
    samples = noise(90_000, n_channels)
    samples[:first] = samples[len(samples) - last :] = 0
    samples = samples if kind == "int16" else (samples / 32_768).astype("f4")
    settings = ONE if n_channels == 1 else LINE
    ertis.write_recording(
        tmp_path / "rec.h5", ertis.open_pcm(write(tmp_path / "a.wav", samples), settings, passive=True)
    )
    assert check_recording(tmp_path / "rec.h5").is_fit


def test_silence_of_one_channel_is_a_fault(tmp_path):
    samples = noise(90_000, 4)
    samples[:20_000, 2] = 0
    ertis.write_recording(tmp_path / "rec.h5", ertis.open_pcm(write(tmp_path / "a.wav", samples), LINE, passive=True))
    checked = check_recording(tmp_path / "rec.h5")
    assert "channel 2 is stuck at times" in checked.verdict


def test_silence_within_a_record_is_a_fault(tmp_path):
    samples = noise(90_000, 4)
    samples[30_000:35_000] = 0
    ertis.write_recording(tmp_path / "rec.h5", ertis.open_pcm(write(tmp_path / "a.wav", samples), LINE, passive=True))
    verdict = check_recording(tmp_path / "rec.h5").verdict
    assert "1 fault: the record has dropouts (samples 30000-34999 have one value in every channel)" in verdict


def test_silent_record_is_a_fault(tmp_path):
    samples = np.zeros((90_000, 4), np.int16)
    ertis.write_recording(tmp_path / "rec.h5", ertis.open_pcm(write(tmp_path / "a.wav", samples), LINE, passive=True))
    assert "stuck at 0" in check_recording(tmp_path / "rec.h5").verdict


# ---- range window ---------------------------------------------------------------------------------


def ring_file(folder, text=""):
    """Write a settings file with the ring and more."""
    rows = np.array(PCM.array.positions_m).tolist()
    (folder / "ring.toml").write_text(f"array.layout = 'ring'\narray.positions_m = {rows}\n{text}")
    return folder / "ring.toml"


def echo_at(range_m, n_samples=3_740):
    """A record of a point at some range, longer than the default window."""
    point = Point(azimuth_deg=0.0, elevation_deg=0.0, range_m=range_m, strength_db=20.0)
    settings = PCM.replace(recording=PCM.recording.replace(n_samples=n_samples))
    return Simulator(scene_of(settings).replace(points=(point,))).render().data


@pytest.mark.parametrize("range_m", [0.5, 2.5, 2.85])
def test_default_window_is_what_the_record_holds(tmp_path, range_m):
    path = write(tmp_path / "a.wav", echo_at(range_m))
    reader = ertis.open_pcm(path, Settings(array=PCM.array))
    speed_m_s = sound_speed_m_s(PCM.air)
    first_m, last_m = reader.settings.processing.range_m
    assert first_m == pytest.approx(speed_m_s * 2.5e-3 / 2, abs=0.01)
    assert last_m == pytest.approx(speed_m_s * (3_740 / RATE_HZ - 2.5e-3) / 2, abs=0.01)
    assert f"range {first_m:g}–{last_m:g} m, the full window of the record" in reader.notes
    (peak,) = ertis.find_peaks(Pipeline(reader.settings, predict=False).process(next(iter(reader))), top=1)
    assert peak.range_m == pytest.approx(range_m, abs=2e-3)


def test_stated_window_is_kept(tmp_path):
    path = write(tmp_path / "a.wav", echo_at(1.0))
    for text, stated in (("[0.5, 5.0]", (0.5, 5.0)), ("[0.4, 1.5]", (0.4, 1.5))):
        target = tmp_path / "rec.h5"
        said = imported(
            path, "--settings", ring_file(tmp_path, f"processing.range_m = {text}"), "-o", target, "--force"
        )
        with ertis.open_recording(target) as recording:
            assert recording.settings.processing.range_m == stated
        assert f"range {stated[0]:g}–{stated[1]:g} m, as in the settings; the record contains 0.43–2.91 m" in said


@pytest.mark.parametrize("preset", ["short_25_50", "default_25_50", None])
def test_window_of_a_preset_is_replaced(tmp_path, preset):
    path = write(tmp_path / "a.wav", echo_at(1.0))
    options = () if preset is None else ("--preset", preset)
    said = imported(path, "--settings", ring_file(tmp_path), *options)
    assert "note: range 0.43–2.91 m, the full window of the record" in said
    shown = CliRunner().invoke(cli, ["info", str(tmp_path / "a.h5")]).stdout
    assert re.search(r"^range +0.43, 2.91 m$", shown, re.MULTILINE)


def test_window_follows_the_air(tmp_path):
    path = write(tmp_path / "a.wav", echo_at(1.0))
    said = imported(path, "--settings", ring_file(tmp_path), "--temperature", -20)
    assert "note: range 0.4–2.7 m, the full window of the record" in said


def test_record_range_is_empty_inwards():
    recording = Recording(sample_rate_hz=1e6, n_samples=2_810)
    assert record_range_m(recording, Call(), 343.0) == (0.0, 0.053)

"""Folders of RTIS Dev become recordings, as far as their content is known."""

import importlib.metadata
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.io import wavfile

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.interop import open_rtis_folder
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.verification import error_db
from ertis_numba.settings import PRESETS, Air, Array, Processing, Settings
from ertis_numba.storage import open_recording

SHORT = {
    "microphoneSamples": 65_536,
    "microphoneSampleFrequency": 4_500_000,
    "callSampleFrequency": 450_000,
    "callDuration": 2.5,
    "callMinimumFrequency": 25_000,
    "callMaximumFrequency": 50_000,
    "callEmissions": 1,
}
PLANAR = {"microphoneLayout": "eRTIS_v3D1", "minRange": 0.4, "maxRange": 1.5, "directions": 91, "2D": 1}
N_WORDS = 65_536


def words(number, count=1):
    return np.random.default_rng(number).integers(0, 2**32, count * N_WORDS, dtype="<u4")


def folder_of(tmp_path, *, names=("m_0.bin", "m_1.bin"), recording=SHORT, processing=PLANAR, more=None):
    folder = tmp_path / "run.1"
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        (folder / name).write_bytes(words(number).tobytes())
    given = {"recording.json": recording, "processing.json": processing, **(more or {})}
    for name, content in given.items():
        if content is not None:
            (folder / name).write_text(json.dumps(content))
    (folder / "notes.txt").write_text("windy")
    return folder


def shipped(kind):
    """Settings files of rtisdev by their names."""
    folder = Path(importlib.metadata.distribution("rtisdev").locate_file(f"rtisdev/config/premadeSettings/{kind}"))
    return {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}


def test_folder_import_keeps_samples_and_sequence_numbers(tmp_path):
    """Files are ordered by number instead of name; a missing number is a gap."""
    reader = open_rtis_folder(folder_of(tmp_path, names=("m_9.bin", "m_10.bin", "m_12.bin")), sensor="left")
    assert len(reader) == 3
    for (number, sequence), measurement in zip(enumerate((9, 10, 12)), reader, strict=True):
        assert np.array_equal(measurement.data, words(number))
        assert (measurement.stamp.sensor, measurement.stamp.sequence) == ("left", sequence)
        assert measurement.stamp.timestamp_ns == 0
        assert measurement.settings is reader.settings


def test_folder_import_reads_settings(tmp_path):
    reader = open_rtis_folder(folder_of(tmp_path))
    wanted = Settings.from_preset("short_25_50")
    processing = wanted.processing.replace(range_m=(0.4, 1.5), directions="2d:91")
    assert reader.settings == wanted.replace(processing=processing)


@pytest.mark.parametrize("preset", PRESETS)
def test_recording_settings_of_rtisdev_equal_the_presets(tmp_path, preset):
    settings = shipped("recording")[preset]
    folder = folder_of(tmp_path, names=(), recording=settings, processing=None)
    (folder / "0.bin").write_bytes(bytes(4 * settings["microphoneSamples"]))
    reader = open_rtis_folder(folder, layout="eRTIS_v2")
    assert reader.settings == Settings.from_preset(preset, array=Array(layout="eRTIS_v2"))


@pytest.mark.parametrize("name", sorted(set(shipped("processing")) - {"custom_example_2D_5m_91"}))
def test_processing_settings_of_rtisdev_are_accepted(tmp_path, name):
    given = shipped("processing")[name]
    processing = open_rtis_folder(folder_of(tmp_path, processing=given)).settings.processing
    assert processing.range_m == (given["minRange"], given["maxRange"])
    assert processing.directions == f"{2 if given['2D'] else 3}d:{given['directions']}"


CUSTOM = {"directionsCustom": "directions.csv", "delayMatrixCustom": "delaymatrix.csv", "rangesCustom": "ranges.csv"}


def custom_folder(tmp_path, **content):
    """A folder with a measurement of default length, and the files of the custom example of rtisdev or others."""
    processing = {"microphoneLayout": "eRTIS_v3D1"} | CUSTOM
    folder = folder_of(tmp_path, names=(), recording={"microphoneSamples": 163_840}, processing=processing)
    np.random.default_rng(1).integers(0, 2**32, 163_840, dtype="<u4").tofile(folder / "0.bin")
    shipped_in = Path(
        importlib.metadata.distribution("rtisdev").locate_file("rtisdev/config/premadeSettings/processing")
    )
    for name in CUSTOM.values():
        text = content.get(name.partition(".")[0])
        (folder / name).write_text((shipped_in / name).read_text() if text is None else text)
    return folder


def test_custom_files_of_rtisdev_are_imported(tmp_path):
    (measurement,) = open_rtis_folder(custom_folder(tmp_path))
    processing = measurement.settings.processing
    assert processing.range_m == (0.5, 5.0)
    assert processing.range_decimation == 100
    assert processing.delay_rate_hz == 450e3
    np.testing.assert_allclose(np.array(processing.directions)[:, 0], np.linspace(-90, 90, 91), atol=1e-9)
    settings = measurement.settings
    named = settings.replace(processing=Processing(directions="2d:91"))
    with Pipeline(settings, "cpu", predict=False) as own, Pipeline(named, "cpu", predict=False) as plane:
        found, wanted = own.process(measurement), plane.process(replace(measurement, settings=named))
    assert len(found.range_m) == pytest.approx(1181, abs=3)
    # The file holds whole samples, which are up to 0.6 samples from the delays of plane waves.
    assert error_db(found.amplitude, wanted.amplitude.astype(float)) < -15


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"ranges": "0.5,0.6,0.8"},
            "rangesCustom is the file 'ranges.csv', which has ranges 0.1 to 0.2 m apart, not ev",
        ),
        (
            {"ranges": "0.6,0.5"},
            "does not have two or more ascending ranges; correct it, or remove it and set processing.range_m",
        ),
        ({"ranges": "a,b"}, r"rangesCustom is the file 'ranges.csv', which cannot be read \("),
        (
            {"directions": "0,1,2"},
            "does not have two numbers in every row; correct it, or remove it and set processing.directions",
        ),
        (
            {"delaymatrix": "1,nan"},
            "does not contain finite numbers only; correct it, or remove it and process with the",
        ),
    ],
)
def test_custom_files_with_other_content_are_refused(tmp_path, content, message):
    with pytest.raises(DataError, match=message):
        open_rtis_folder(custom_folder(tmp_path, **content))


def test_missing_keys_have_the_defaults_of_rtisdev(tmp_path):
    folder = folder_of(tmp_path, recording={"microphoneSamples": N_WORDS}, processing={"microphoneLayout": "eRTIS_v2"})
    assert open_rtis_folder(folder).settings == Settings.from_preset("short_25_50", array=Array(layout="eRTIS_v2"))


@pytest.mark.parametrize("planar", [True, False])
def test_json_booleans_are_accepted(tmp_path, planar):
    processing = open_rtis_folder(folder_of(tmp_path, processing=PLANAR | {"2D": planar})).settings.processing
    assert processing.directions == f"{2 if planar else 3}d:91"


@pytest.mark.parametrize("planar", [True, False])
def test_combined_settings_file_is_accepted(tmp_path, planar):
    """``dict(RTISSettings)`` yields this, with more keys than necessary."""
    azimuth_rad = np.radians(np.linspace(-60, 60, 5)).tolist()
    elevation_rad = [0.0] * 5 if planar else [0.0, 0.1, 0.2, 0.3, 0.4]
    dumped = {**SHORT, **{name: PLANAR[name] for name in ("microphoneLayout", "minRange", "maxRange")}}
    dumped["dacSampleFrequency"] = dumped.pop("callSampleFrequency")
    dumped |= {"nDirections": 5, "directionsAzimuth": azimuth_rad, "directionsElevation": elevation_rad}
    dumped |= {"version": "2.16.0", "dacSamples": 1126, "pdmb": [0.1, 0.2], "disableList": []}
    folder = folder_of(tmp_path, recording=None, processing=None, more={"settings.json": dumped})
    processing = open_rtis_folder(folder).settings.processing
    assert processing.directions == ("2d:5" if planar else "3d:5")
    assert np.allclose(processing.azimuth_limits_deg, (-60, 60) if planar else (-90, 90))


def test_planar_directions_keep_their_elevation(tmp_path):
    processing = PLANAR | {"elevation2DAngle": 12.5}
    settings = open_rtis_folder(folder_of(tmp_path / "file", processing=processing)).settings
    assert (settings.processing.directions, settings.processing.elevation_deg) == ("2d:91", 12.5)
    angles = {"directionsAzimuth": [-1.0, 0.0, 1.0], "directionsElevation": [0.2] * 3}
    dumped = {**SHORT, **PLANAR, "directions": 3, **angles}
    folder = folder_of(tmp_path / "dict", recording=None, processing=None, more={"settings.json": dumped})
    processing = open_rtis_folder(folder).settings.processing
    assert processing.directions == "2d:3"
    assert processing.elevation_deg == pytest.approx(math.degrees(0.2))
    processing = PLANAR | {"2D": 0, "elevation2DAngle": 12.5}
    assert not open_rtis_folder(folder_of(tmp_path / "solid", processing=processing)).settings.processing.elevation_deg


def test_other_calls_and_clocks_are_imported(tmp_path):
    recording = SHORT | {"microphoneSampleFrequency": 1_125_000, "callDuration": 3.1, "callMaximumFrequency": 30_000}
    folder = folder_of(tmp_path, recording=recording, processing={"microphoneLayout": "uRTIS_v1"})
    settings = open_rtis_folder(folder).settings
    assert (settings.call.duration_s, settings.call.start_frequency_hz) == (0.0031, 30_000)
    assert settings.recording.sample_rate_hz == 1_125_000
    assert settings.output_rate_hz >= 2 * 5_000  # ranges are fine enough for the bandwidth
    assert math.isclose(settings.processing.range_m[1], 5.0)


def test_options_override_files_of_the_folder(tmp_path):
    processing = PLANAR | {"microphoneLayout": "mine"}
    folder = folder_of(tmp_path, recording=SHORT | {"callEmissions": 3}, processing=processing)
    air = Air(temperature_c=3.0)
    settings = open_rtis_folder(folder, layout="eRTIS_v2", preset="short_20_80", air=air).settings
    assert settings.array.layout == "eRTIS_v2"
    assert settings.call == Settings.from_preset("short_20_80").call
    assert settings.air == air


def test_example_measurement_of_rtisdev_is_imported(tmp_path):
    real = Path(importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin"))
    recording, processing = shipped("recording")["default_25_50"], shipped("processing")["2D_5m_181"]
    folder = folder_of(tmp_path, names=(), recording=recording, processing=processing)
    (folder / "simulate.bin").write_bytes(real.read_bytes())
    (measurement,) = open_rtis_folder(folder)
    assert np.array_equal(measurement.data, np.fromfile(real, dtype="<u4"))
    assert measurement.settings.processing.directions == "2d:181"
    assert measurement.stamp.sequence == 0


def test_file_of_many_measurements_is_imported(tmp_path):
    folder = folder_of(tmp_path, names=())
    (folder / "all.bin").write_bytes(words(1, 3).tobytes())
    assert [each.stamp.sequence for each in open_rtis_folder(folder)] == [0, 1, 2]


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (
            {"names": ()},
            r"run.1 is a folder; choose a file of raw words, or a folder with .wav files or .bin files of RTIS Dev",
        ),
        (
            {"names": ("a_1.bin", "b_2.bin")},
            "the order of its 2 .bin files is unknown, because their names are not like NAME<num",
        ),
        (
            {"names": ("a.bin", "a1.bin")},
            r"the order of its 2 \.bin files is unknown, because their names are not like NAME<number>\.bin",
        ),
        (
            {"names": ("a1.bin", "a01.bin")},
            r"the order of its 2 \.bin files is unknown, because their names are not like NAME<number>\.bin",
        ),
        ({"recording": None}, "run.1 contains no recording settings of RTIS Dev .*; choose a preset"),
        ({"processing": None}, r"does not name its array \(microphoneLayout\); set it \(layout\)"),
        ({"recording": SHORT | {"callEmissions": 2}}, "callEmissions is 2, but an image shows only 1 emission"),
        (
            {"recording": {"callCustom": "bat.csv"}},
            "callCustom is the file 'bat.csv', which a recording cannot contain",
        ),
        (
            {"processing": PLANAR | {"rangesCustom": "r.csv"}},
            "rangesCustom is the file 'r.csv', .*set processing.range_m",
        ),
        ({"processing": PLANAR | {"directionsCustom": "d.csv"}}, "directionsCustom is the file"),
        ({"more": {"z.json": {"callDuration": 3}}}, r"z.json: callDuration is 3, but 2.5 in recording.json; keep one"),
    ],
)
def test_folder_import_refuses_invalid_folders(tmp_path, made, message):
    with pytest.raises(DataError, match=message):
        open_rtis_folder(folder_of(tmp_path, **made))


@pytest.mark.parametrize(
    ("recording", "processing", "message"),
    [
        (SHORT | {"callDuration": "long"}, PLANAR, "run.1: callDuration is 'long'; use a number"),
        (SHORT | {"microphoneSamples": 0.5}, PLANAR, "microphoneSamples is 0.5; use a whole number"),
        (SHORT | {"callMinimumFrequency": 50_000}, PLANAR, "call.stop_frequency_hz are both 50000"),
        (SHORT, PLANAR | {"microphoneLayout": "eRTIS_v9"}, "layout 'eRTIS_v9' is unknown"),
        (SHORT, PLANAR | {"elevation2DAngle": 91}, "run.1: elevation2DAngle is 91; use a number from -90 to 90"),
        (SHORT, PLANAR | {"directions": 1.5}, "directions is 1.5; use a whole number"),
        (SHORT, PLANAR | {"microphoneLayout": 5}, "run.1: microphoneLayout is 5; correct it to the name of an array,"),
        (
            SHORT,
            PLANAR | {"microphoneLayout": ["a"]},
            r"run.1: microphoneLayout is \['a'\]; correct it to the name of an array,",
        ),
        (SHORT, PLANAR | {"directionsAzimuth": []}, r"directionsAzimuth is \[\]; write an angle for each direction,"),
        (SHORT, PLANAR | {"directionsAzimuth": 3}, "directionsAzimuth is 3; write an angle for each direction,"),
        (SHORT, PLANAR | {"directionsAzimuth": ["a"]}, "run.1: directionsAzimuth is 'a'; use a number"),
        (SHORT, PLANAR | {"directionsElevation": 0}, "directionsElevation is 0; write an angle for each direction,"),
        (
            SHORT | {"microphoneSamples": 11_000},
            PLANAR,
            "recording.n_samples gives a record of 2.444 ms, but the call ends after 2.5 ms; use more",
        ),
    ],
)
def test_folder_import_refuses_invalid_values(tmp_path, recording, processing, message):
    with pytest.raises(ArgumentError, match=message):
        open_rtis_folder(folder_of(tmp_path, recording=recording, processing=processing))


def test_invalid_or_foreign_json_is_handled(tmp_path):
    folder = folder_of(tmp_path, more={"list.json": [1, 2], "other.json": {"weather": "windy"}})
    assert len(open_rtis_folder(folder)) == 2
    (folder / "bad.json").write_text("{")
    with pytest.raises(DataError, match=r"bad.json: .*; correct the JSON, or remove the file"):
        open_rtis_folder(folder)
    with pytest.raises(DataError, match="none: No such file or directory; choose a folder of raw files"):
        open_rtis_folder(tmp_path / "none")


def test_overlapping_sequence_numbers_are_refused(tmp_path):
    folder = folder_of(tmp_path)
    (folder / "m_0.bin").write_bytes(words(0, 2).tobytes())
    with pytest.raises(
        DataError, match=r"m_0.bin contains 2 measurements, but the next file is number 1; list the files"
    ):
        open_rtis_folder(folder)


@pytest.mark.parametrize("name", ["m_99999999999999999999999.bin", f"m_{2**63}.bin"], ids=["far", "just"])
def test_unstorable_sequence_numbers_are_refused(tmp_path, name):
    with pytest.raises(
        DataError, match=rf"{name} is number \d+, above the limit of recordings; rename it with a smaller number"
    ):
        open_rtis_folder(folder_of(tmp_path, names=("m_0.bin", name)))


def test_import_command_accepts_a_folder(tmp_path):
    folder = folder_of(tmp_path, names=("m_5.bin", "m_7.bin"))
    done = CliRunner().invoke(
        cli, ["import", "signals", str(folder), "--temperature", "12.5", "--sensor", "left", "--json"]
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {"output": str(tmp_path / "run.1.h5"), "measurements": 2, "notes": []}
    with open_recording(tmp_path / "run.1.h5") as recording:
        assert [stamp.sequence for stamp in recording.stamps()] == [5, 7]
        assert [(gap.first, gap.last) for gap in recording.gaps] == [(6, 6)]
        assert recording.settings.air == Air(temperature_c=12.5)
        assert recording.settings.processing.directions == "2d:91"
        assert recording.sensor == "left"


@pytest.mark.parametrize("option", ["--layout", "--preset"])
def test_import_of_files_needs_settings(tmp_path, option):
    (tmp_path / "a.bin").write_bytes(words(1).tobytes())
    given = {"--layout": "eRTIS_v3D1", "--preset": "short_25_50"}
    del given[option]
    done = CliRunner().invoke(cli, ["import", "signals", str(tmp_path / "a.bin"), *sum(given.items(), ())])
    assert done.exit_code == 2
    assert f"Missing option '{option}'" in done.stderr


def test_import_of_sound_needs_a_layout(tmp_path):
    path = tmp_path / "a.wav"
    wavfile.write(path, 48_000, np.ones((480, 4), np.int16))
    done = CliRunner().invoke(cli, ["import", "signals", str(path), "--passive"])
    assert done.exit_code == 2
    assert "Missing option '--layout'" in done.stderr

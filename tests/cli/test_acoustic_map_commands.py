"""Acoustic maps on the command line: `ertis acoustic`, `ertis info` and `ertis peaks`."""

import dataclasses
import json
import re
from pathlib import Path

import click
import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli import acoustic
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.campaign import Campaign, CampaignOptions, RecordingStarted, find_recordings
from ertis_numba.frames import Stamp
from ertis_numba.geometry.air import transmission_loss_db
from ertis_numba.settings import MAP_METHODS
from tests.campaigns import InlinePool, names_in
from tests.pages import commands_in, page, python_in, run_code_here, run_here
from tests.passive.test_acoustic_camera import settings_of, sound

SETTINGS = settings_of(processing__range_m=(0.5, 0.9), passive__averages=2)
TURNED = (0.0, 0.0, 0.0, 1.0)

pytestmark = pytest.mark.usefixtures("folder")


SILENT_SCENE = """
seed = 1
[[sensors]]
emitter.silent = true
recording = {sample_rate_hz = 48000.0, n_samples = 4800, encoding = "float32"}
processing.mode = "passive"
passive.bands_hz = [[2000.0, 4000.0]]
[[noises]]
azimuth_deg = 40.0
range_m = 2.0
level_db = -40.0
band_hz = [1000.0, 10000.0]
"""


def heard(behaviours, sensor="sensor", settings=SETTINGS):
    """Return a measurement of a source at 20 degrees for each behaviour."""
    return [
        dataclasses.replace(
            sound(settings, [(20, 0.1)], noise=0.01, seed=number),
            stamp=Stamp(sensor=sensor, sequence=number, behaviour=behaviour, timestamp_ns=10**9 + number),
        )
        for number, behaviour in enumerate(behaviours)
    ]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    made = tmp_path_factory.mktemp("recorded")
    ertis.write_recording(made / "passive.h5", heard(["passive"] * 3))
    ertis.write_recording(made / "active.h5", heard(["active"] * 2))
    ertis.write_recording(made / "mixed.h5", heard(["active", "passive", "active", "passive"]))
    both = [*heard(["active"], "left"), *heard(["passive", "passive"], "right")]
    ertis.write_recording(made / "both.h5", both, mounting={"right": ((0.1, 0.0, 0.0), TURNED)})
    silent = [*heard(["passive"], "left"), *heard(["passive"], "right")]
    ertis.write_recording(made / "silent.h5", silent, mounting=dict.fromkeys(("left", "right"), ((0, 0, 0), TURNED)))
    (made / "images.toml").write_text('processing.mode = "active"')
    return made


@pytest.fixture
def folder(recorded, tmp_path, monkeypatch):
    for path in recorded.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def in_test_process(monkeypatch):
    """Process recordings in the test's own process, because worker processes start slowly."""
    monkeypatch.setattr(Campaign, "_pool", lambda _: InlinePool())


def run(line, *, code=0):
    done = CliRunner().invoke(cli, line.split())
    assert done.exit_code == code, done.output
    return done


def azimuths_deg(rows):
    return [row["azimuth_deg"] for row in rows]


def test_passive_recording_becomes_acoustic_maps():
    done = run("acoustic passive.h5 --device cpu --json")
    report = json.loads(done.stdout)
    assert (report["output"], report["kind"]) == ("passive.acoustic.h5", "acoustic_map")
    assert (report["measurements"], report["maps"], report["directions"], report["bands"]) == (3, 2, 61, 2)
    assert "2 acoustic maps of 3 measurements, 61 directions × 2 bands on cpu" in done.stderr
    with ertis.open_acoustic_maps("passive.acoustic.h5") as found, ertis.open_recording("passive.h5") as recording:
        assert [each.n_measurements for each in found] == [2, 1]
        assert found.attributes["recording_uuid"] == recording.uuid
        with ertis.AcousticCamera(recording.settings, "cpu") as camera:
            expected = list(camera.process_many(recording))
        for one, other in zip(found, expected, strict=True):
            assert np.array_equal(one.power, other.power)
        mean = found[0].replace(power=sum(each.n_measurements * each.power for each in found) / np.float32(3))
    expected = mean.loudest()
    assert [row["level_dbfs"] for row in report["loudest"]] == pytest.approx(
        [each.level_dbfs for each in expected], abs=1e-3
    )
    assert azimuths_deg(report["loudest"]) == pytest.approx(
        [np.degrees(each.azimuth_rad) for each in expected], abs=1e-3
    )
    assert azimuths_deg(report["loudest"]) == pytest.approx([20, 20], abs=2.0)  # directions are 3 degrees apart
    assert report["sensors"][0]["loudest"] == report["loudest"]


def test_bands_of_quantisation_noise_are_reported():
    """One-bit microphones at 4.5 MHz shape their noise to frequencies above 130 kHz."""
    pdm = ertis.Settings().replace(**{"recording.n_samples": 81_920, "processing.range_m": (0.5, 1.0)})
    noise = np.random.default_rng(5).integers(0, 2**32, 81_920, dtype=np.uint32)
    ertis.write_recording("pdm.h5", [ertis.Measurement(noise, pdm, Stamp(behaviour="passive"))])
    quiet = run("acoustic pdm.h5 -o low.h5 --bands 20000:130000")
    assert "quantisation" not in quiet.stderr
    noisy = run("acoustic pdm.h5 -o high.h5 --bands 20000:30000,200000:300000")
    (line,) = (line for line in noisy.stderr.splitlines() if "quantisation noise" in line)
    assert "dominates above 130 kHz, and therefore in 200 to 300 kHz; choose lower bands" in line


def test_silent_sensor_of_a_scene_needs_no_fitting_call(folder):
    """The default call reaches 50 kHz, above half of the sample rate."""
    (folder / "ear.toml").write_text(SILENT_SCENE)
    run("simulate ear.toml -o ear.h5")
    run("acoustic ear.h5 -o ear.acoustic.h5")
    with ertis.open_acoustic_maps("ear.acoustic.h5") as maps:
        assert maps.band_hz.tolist() == [[2000.0, 4000.0]]
        (loudest,) = maps[0].loudest()
    assert abs(np.degrees(loudest.azimuth_rad) - 40) < 15  # The array is smaller than a wavelength.


def test_options_of_maps_override_the_settings(folder):
    (folder / "given.toml").write_text('[passive]\nmethod = "music"\naverages = 9\nfocus_m = 3\n')
    run(
        "acoustic passive.h5 -o maps.h5 --settings given.toml --bands 25000:30000,30000:35000 --method functional "
        "--average 3 --focus 2 --device numpy"
    )
    with ertis.open_acoustic_maps("maps.h5") as found:
        assert found.band_hz.tolist() == [[25e3, 30e3], [30e3, 35e3]]
        assert (len(found), found[0].n_measurements) == (1, 3)
        assert (found.settings.passive.method, found.settings.passive.focus_m) == ("functional", 2.0)


def test_emission_is_masked_and_reported():
    done = run("acoustic mixed.h5 -o maps.h5 --device cpu")
    assert "mixed.h5: sensor sensor emitted its call in 2 of 4 measurements; maps leave out the first " in done.stderr
    assert "ms of each, but contain echoes of the call" in done.stderr
    with ertis.open_acoustic_maps("maps.h5") as found:
        assert [each.masked_s > found.settings.call.duration_s for each in found] == [True, True]
    assert "emitted" not in run("acoustic passive.h5 -o quiet.h5 --device cpu").stderr


def test_mixed_recording_becomes_images_of_its_calls():
    done = run("process mixed.h5 -o img.h5 --device cpu --json")
    assert (
        "mixed.h5: 2 of 4 measurements of sensor sensor are passive and left out; use 'ertis acoustic'" in done.stderr
    )
    assert json.loads(done.stdout)["measurements"] == 2
    with ertis.open_energyscapes("img.h5") as images:
        assert [stamp.sequence for stamp in images.stamps()] == [0, 2]
    run("process mixed.h5 -o all.h5 --settings images.toml --device cpu")
    with ertis.open_energyscapes("all.h5") as images:
        assert len(images) == 4


def test_sensor_without_calls_is_left_out_of_images():
    done = run("process both.h5 -o img.h5 --device cpu")
    assert "2 of 2 measurements of sensor right are passive and left out" in done.stderr
    assert ertis.storage.sensor_names("img.h5") == ("left",)
    run("acoustic both.h5 -o maps.h5 --sensor right --device cpu")
    with ertis.open_acoustic_maps("maps.h5") as maps:
        assert (maps.sensors, maps.translation_m.tolist()) == (("right",), [0.1, 0.0, 0.0])


NO_IMAGES = (
    "passive.h5: all measurements are passive and have no echoes; "
    "use 'ertis acoustic passive.h5' for maps of their sound"
)


def test_process_names_the_command_for_a_recording_of_sound(folder):
    done = run("process passive.h5 --device cpu", code=1)
    assert [line for line in done.stderr.splitlines() if "passive" in line] == [
        f'ertis: error: {NO_IMAGES}, or the setting processing.mode = "active" for images'
    ]
    assert not list(folder.glob("*.energy.h5"))


@pytest.mark.usefixtures("in_test_process")
def test_recordings_of_sound_are_skipped_unless_named(folder):
    for name in ("both", "silent"):
        (folder / f"{name}.h5").unlink()
    done = run("process *.h5 -o out/ --device cpu --workers 1")
    assert f"ertis: warning: {NO_IMAGES}" in done.stderr
    assert "mixed.h5: 2 of 4 measurements of sensor sensor are passive" in done.stderr
    assert "3 recordings: 2 made, 1 skipped; 4 measurements in " in done.stderr
    assert names_in(folder / "out") == ["active.energy.h5", "mixed.energy.h5"]
    done = run("process active.h5 passive.h5 -o named/ --device cpu --workers 1", code=1)
    assert f"ertis: failed: {NO_IMAGES}" in done.stderr
    assert names_in(folder / "named") == ["active.energy.h5"]


@pytest.mark.usefixtures("in_test_process")
def test_several_recordings_become_maps(folder):
    done = run("acoustic active.h5 mixed.h5 passive.h5 -o out/ --device cpu --average 3 --workers 1 --json")
    assert "out/passive.acoustic.h5: 1 acoustic map of 3 measurements, 61 directions × 2 bands on cpu" in done.stderr
    assert "3 recordings: 3 made; 9 measurements in " in done.stderr
    assert names_in(folder / "out") == ["active.acoustic.h5", "mixed.acoustic.h5", "passive.acoustic.h5"]
    rows = list(map(json.loads, done.stdout.splitlines()))
    (made,) = [row for row in rows if row.get("output") == "out/passive.acoustic.h5"]
    alone = json.loads(run("acoustic passive.h5 -o alone.h5 --device cpu --average 3 --json").stdout)
    assert (made["output"], made["outcome"], made["maps"]) == ("out/passive.acoustic.h5", "made", 1)
    assert made["loudest"] == alone["loudest"]
    with ertis.open_acoustic_maps("out/passive.acoustic.h5") as one, ertis.open_acoustic_maps("alone.h5") as other:
        assert one.uuid == other.uuid
    run("acoustic out -o more/ --device cpu")  # results of processing are skipped
    assert not list((folder / "more").glob("*.h5"))


@pytest.mark.usefixtures("in_test_process")
def test_finished_maps_are_kept(folder):
    line = "acoustic passive.h5 silent.h5 -o maps/ --device cpu --workers 1"
    run(line)
    assert "2 recordings: 2 kept; 0 measurements in " in run(line).stderr
    assert "2 kept" in run(f"{line} --strict").stderr
    done = run(f"{line} --average 1", code=1)
    assert "exists and was made with other settings (passive.averages of sensor sensor)" in done.stderr
    with h5py.File(folder / "maps" / "passive.acoustic.h5", "r+") as file:
        file["sensors/sensor/power"][0, 0, 0] += 1.0
    assert "passive.acoustic.h5 exists and is damaged; choose another folder" in run(line, code=1).stderr
    done = run(f"{line} --force")
    assert "maps/silent.acoustic.h5: exists already, kept" in done.stderr
    assert "2 recordings: 1 made, 1 kept; 3 measurements in " in done.stderr
    (folder / "maps" / "passive.acoustic.h5").write_bytes((folder / "active.h5").read_bytes())
    assert "passive.acoustic.h5 exists and is a recording" in run(f"{line} --force", code=1).stderr


@pytest.mark.usefixtures("in_test_process")
def test_failed_recordings_do_not_stop_maps_of_others(folder):
    (folder / "torn.h5").write_bytes((folder / "passive.h5").read_bytes()[:90_000])
    done = run("acoustic passive.h5 torn.h5 active.h5 -o maps --device cpu --json", code=1)
    *rows, _ = [json.loads(line) for line in done.stdout.splitlines()]
    assert {row["recording"]: (row["outcome"], row["output"]) for row in rows} == {
        "passive.h5": ("made", "maps/passive.acoustic.h5"),
        "torn.h5": ("failed", "maps/torn.acoustic.h5"),
        "active.h5": ("made", "maps/active.acoustic.h5"),
    }
    assert "ertis: failed: torn.h5 is cut short or damaged" in done.stderr
    assert "active.h5: sensor sensor emitted its call in 2 of 2 measurements; maps leave out the first" in done.stderr
    assert names_in(folder / "maps") == ["active.acoustic.h5", "passive.acoustic.h5"]
    done = run("acoustic passive.h5 silent.h5 -o more --bands 80000:100000 --device cpu", code=1)
    assert done.stderr.count("--bands ends at 100000 Hz, but the record reaches only 90000 Hz") == 2


@pytest.mark.usefixtures("in_test_process")
def test_progress_of_maps_counts_measurements():
    wanted = CampaignOptions(device="cpu", result="acoustic_map")
    started, *progress, ended = Campaign(find_recordings(["passive.h5"]), "maps", wanted).run()
    assert started == RecordingStarted(Path("passive.h5"), 3)
    assert [each.done for each in progress] == [1, 2, 3]
    assert (ended.outcome, ended.output) == ("made", Path("maps/passive.acoustic.h5"))


def test_images_of_silent_sensors_are_fused_only_if_asked(folder):
    done = run("fuse silent.h5 --device cpu", code=1)
    assert "silent.h5: all measurements are passive and have no echoes; use recordings of emitted calls" in done.stderr
    assert not (folder / "silent.fused.h5").exists()
    (folder / "active.toml").write_text('processing.mode = "active"')
    run("fuse silent.h5 --settings active.toml --device cpu")


def test_check_names_the_kind_of_a_file_of_maps():
    run("acoustic passive.h5 -o maps.h5 --device cpu")
    assert "maps.h5 is a file of acoustic maps, wanted a recording" in run("sensors check maps.h5", code=1).stderr


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("passive.h5 --verify", "No such option"),
        ("passive.h5 --workers 2", "--workers applies to several recordings"),
        ("passive.h5 --bands wide", "'wide' is not a list of bands; use third_octaves, octaves, or edges in Hz"),
        ("passive.h5 --bands 20000:30000:40000", "is not a list of bands"),
    ],
)
def test_options_without_effect_are_refused(folder, line, message):
    assert message in " ".join(run(f"acoustic {line} --device numpy", code=2).stderr.split())
    assert not list(folder.glob("*.energy.h5")) + list(folder.glob("*.acoustic.h5"))


def test_errors_of_maps_leave_no_file(folder):
    done = run("acoustic passive.h5 --bands 80000:100000 --device numpy", code=1)
    assert "--bands ends at 100000 Hz, but the record reaches only 90000 Hz" in done.stderr
    (folder / "passive.acoustic.h5").write_bytes(b"old")
    assert "exists" in run("acoustic passive.h5 --device numpy", code=1).stderr
    assert (folder / "passive.acoustic.h5").read_bytes() == b"old"


@pytest.mark.parametrize("changes", [{"dtype": "float16"}, {"explain": True}, {"verify": True}])
def test_campaigns_of_maps_refuse_options_of_images(changes):
    with pytest.raises(ertis.ArgumentError, match="are for images, but result is 'acoustic_map'; omit them"):
        CampaignOptions(result="acoustic_map", **changes)


def test_methods_are_those_of_the_settings():
    option = next(each for each in acoustic.acoustic.params if each.name == "passive_method")
    assert isinstance(option.type, click.Choice)
    assert tuple(option.type.choices) == tuple(MAP_METHODS)


def test_info_describes_acoustic_maps():
    run("acoustic both.h5 -o maps.h5 --device numpy --average 2 --focus 2")
    report = json.loads(run("info maps.h5 --json").stdout)
    assert report["kind"] == "acoustic_map"
    assert [(row["sensor"], row["measurements"], row["maps"]) for row in report["sensors"]] == [
        ("left", 1, 1),
        ("right", 2, 1),
    ]
    section = report["sensors"][1]
    assert (section["method"], section["averages"], section["focus_m"], section["bands"]) == ("delay_and_sum", 2, 2, 2)
    assert section["band_hz"] == [20e3, 40e3]
    text = run("info maps.h5").stdout
    assert "acoustic_map" in text
    assert "simulated" not in text


def test_peaks_are_the_sources_of_maps():
    run("acoustic passive.h5 -o maps.h5 --device numpy")
    rows = json.loads(run("peaks maps.h5 --top 1 --json").stdout)["sources"]
    with ertis.open_acoustic_maps("maps.h5") as maps:
        expected = [each for found in maps for each in found.bearings]
        assert {found.false_alarm for found in maps} == {1e-3}
    assert [(row["map"], *row["band_hz"]) for row in rows] == [
        (number, *band) for number in (0, 1) for band in ((20e3, 25e3), (30e3, 40e3))
    ]
    assert azimuths_deg(rows) == pytest.approx([each.azimuth_deg for each in expected], abs=1e-3)
    assert azimuths_deg(rows) == pytest.approx([20] * 4, abs=1.0)
    assert [row["level_dbfs"] for row in rows] == pytest.approx([each.level_dbfs for each in expected], abs=1e-3)
    shown = run("peaks maps.h5 -m 1 --top 1").stdout.splitlines()
    columns = "sensor map band_khz azimuth_deg sideways_deg elevation_deg upwards_deg level_dbfs snr_db"
    assert shown[0].split() == columns.split()
    assert [line.split()[:3] for line in shown[1:]] == [["sensor", "1", "20.0–25.0"], ["sensor", "1", "30.0–40.0"]]


def test_levels_are_sound_pressures_if_the_sensitivity_is_known(folder):
    (folder / "given.toml").write_text("[array]\nsensitivity_dbfs = -26\n")
    report = json.loads(run("acoustic passive.h5 -o maps.h5 --settings given.toml --device numpy --json").stdout)
    for row in report["loudest"]:
        assert row["level_db"] - row["level_dbfs"] == pytest.approx(94 + 26 + 3, abs=0.05)
    heading, first, *_ = run("peaks maps.h5").stdout.splitlines()
    assert heading.split()[-3:] == ["level_dbfs", "level_db", "snr_db"]
    with ertis.open_acoustic_maps("maps.h5") as maps:
        assert float(first.split()[-2]) == pytest.approx(maps[0].bearings[0].level_db, abs=0.06)
    run("acoustic passive.h5 -o unknown.h5 --device numpy")
    assert {row["level_db"] for row in json.loads(run("peaks unknown.h5 --json").stdout)["sources"]} == {None}


def test_source_levels_are_listed_if_the_distance_is_known(folder):
    (folder / "given.toml").write_text("[array]\nsensitivity_dbfs = -26\n")
    run("acoustic passive.h5 -o maps.h5 --settings given.toml --focus 4 --device numpy")
    heading, first, *_ = run("peaks maps.h5").stdout.splitlines()
    assert heading.split()[-4:-1] == ["level_dbfs", "level_db", "source_level_db"]
    with ertis.open_acoustic_maps("maps.h5") as maps:
        assert float(first.split()[-2]) == pytest.approx(maps[0].bearings[0].source_level_db, abs=0.06)
    for row in json.loads(run("peaks maps.h5 --json").stdout)["sources"]:
        loss_db = transmission_loss_db(SETTINGS.air, 4.0, np.array([np.sqrt(np.prod(row["band_hz"]))]))
        assert row["source_level_db"] - row["level_db"] == pytest.approx(loss_db[0], abs=1e-3)


def test_maps_of_music_have_no_level_but_their_bearings():
    report = json.loads(run("acoustic passive.h5 -o maps.h5 --method music --device numpy --json").stdout)
    assert [row["level_dbfs"] for row in report["loudest"]] == [None, None]
    run("acoustic passive.h5 -o other.h5 --device numpy")
    assert run("peaks maps.h5").stdout == run("peaks other.h5").stdout


def test_peaks_list_no_sources_of_maps_without_bearings():
    with ertis.open_recording("passive.h5") as recording, ertis.AcousticCamera(recording.settings, "cpu") as camera:
        ertis.write_acoustic_maps("old.h5", camera.process_many(recording))
    message = "error: old.h5 contains no bearings; use 'ertis acoustic' again to list sources"
    assert message in run("peaks old.h5", code=1).stderr


def test_peaks_mark_sources_that_may_be_crosstalk():
    made = heard(["passive"])[0]
    same = np.random.default_rng(0).standard_normal((len(made.data), 1)) + 0 * made.data
    ertis.write_recording("same.h5", [dataclasses.replace(made, data=(0.1 * same).astype(np.float32))])
    run("acoustic same.h5 -o maps.h5 --device numpy")
    done = run("peaks maps.h5")
    assert done.stderr.count("possible crosstalk has the same signal in all channels") == 1
    assert [line.split()[-1] for line in done.stdout.splitlines()] == ["doubt", "crosstalk?", "crosstalk?"]
    assert all(row["may_be_crosstalk"] for row in json.loads(run("peaks maps.h5 --json").stdout)["sources"])


@pytest.mark.parametrize("option", ["--detector peaks", "--all", "--truth"])
def test_peaks_of_maps_refuse_options_of_images(option):
    run("acoustic passive.h5 -o maps.h5 --device numpy")
    message = f"{option.split()[0]} is for images, but maps.h5 holds acoustic maps; leave it out"
    assert message in run(f"peaks maps.h5 {option}", code=2).stderr


def test_commands_and_code_of_the_page_run(tmp_path):
    text = page("passive")
    for command in commands_in(text):
        run_here(tmp_path, command)
        if command == "example leak":
            scene_file = tmp_path / "leak.toml"
            scene_file.write_text(scene_file.read_text("utf-8").replace("count = 10", "count = 2"), "utf-8")
    with ertis.open_acoustic_maps(tmp_path / "leak.acoustic.h5") as maps:
        assert (len(maps), maps[0].n_measurements) == (1, 2)
        sources = maps[0].bearings
    found: dict[int, float] = {}
    for each in sources:
        found.setdefault(round(each.center_hz / 1e3), each.azimuth_deg)
    assert found[16] == pytest.approx(-40, abs=2)  # the machine
    assert found[63] == pytest.approx(28, abs=0.5)  # the leak
    (code,) = python_in(text)
    assert run_code_here(tmp_path, code).count("\n") == len(sources)


CALLS = {
    "passive.h5": ("none (passive)", None),
    "active.h5": (r"\d+\.\d, \d+\.\d kHz", [50.0, 25.0]),
    "mixed.h5": (r"\d+\.\d, \d+\.\d kHz", [50.0, 25.0]),
}


@pytest.mark.parametrize("name", CALLS)
def test_info_states_no_call_of_passive_measurements(name):
    shown, khz = CALLS[name]
    found = json.loads(run(f"info {name} --json").stdout)
    lines = run(f"info {name}").stdout
    assert re.search(rf"^call +{shown if khz else re.escape(shown)}$", lines, re.MULTILINE), lines
    assert (found["call_khz"] is None) == (khz is None)
    assert ("range_m" in found) == (khz is not None)


def test_info_states_no_call_of_maps_of_passive_measurements():
    run("acoustic passive.h5 --device cpu -o maps.h5")
    assert json.loads(run("info maps.h5 --json").stdout)["call_khz"] is None


def test_images_of_measurements_without_a_call_are_warned_of(in_test_process):  # noqa: ARG001
    done = run("process mixed.h5 -o images.h5 --settings images.toml --device cpu")
    assert "no call was emitted for 2 of 4 measurements, so their images show no echoes of a call" in done.stderr
    assert json.loads(run("info images.h5 --json").stdout)["call_khz"] is not None
    picture = run("process passive.h5 -o silent_images.h5 --settings images.toml --device cpu")
    assert "no call was emitted for 3 of 3 measurements" in picture.stderr
    assert json.loads(run("info silent_images.h5 --json").stdout)["call_khz"] is None
    assert run("process active.h5 -o active_images.h5 --device cpu").stderr.count("no call") == 0

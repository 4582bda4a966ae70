"""Error messages name options as typed, even if the library rejects the value."""

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.storage import GroundTruth, write_energyscapes, write_recording
from tests.files import image, noise

CASES = {
    "export i.h5 -o a.mcap --ascii": "option --ascii is given, but format 'mcap' does not have it; leave it out, or",
    "export i.h5 -o a.ply --topic points": "option --topic is given, but format 'ply' does not have it; leave it out",
    "export i.h5 -o a.npz --top 3": "option --top is given, but format 'npz' does not have it; leave it out, or write",
    "export i.h5 -o a.csv --top 0": "--top is 0; give a whole number of at least 1",
    "export i.h5 -o a.csv --min-level 3": "--min-level is 3; give a number from -1000 to 0",
    "peaks i.h5 --top 0": "--top is 0; give a whole number of at least 1",
    "peaks i.h5 --detector cfar --false-alarm 0": "--false-alarm is 0; give",
    "compare t.h5 --min-level nan": "--min-level is nan; give a finite number",
    "plot i.h5 -o a.png --columns 1": "--columns is 1, which theme 'dark' has none of; give theme 'paper'",
    "plot i.h5 -o a.png --dynamic-range 0": "--dynamic-range is 0; give a number above 0",
    "plot i.h5 -o a.png --kind slices --height 300": "--height is 300, where the image shows nothing",
    "plot i.h5 -o a.png --kind slices --left nan": "--left is nan; give a finite number",
    "plot r.h5 -o a.png --kind signals --microphone -1": "--microphone is -1; give a whole number",
    "plot eRTIS_v2 -o a.png --kind array --frequency 0": "--frequency is 0; give a number above 0",
    "plot eRTIS_v2 -o a.png --kind array --steer 100:0": (
        "Invalid value for '--steer': '100:0' is not a direction; give azimuth and elevation, each from -90"
    ),
    "process r.h5 -o a.h5 --threads 0": "--threads is 0; give a whole number from 1",
    "plot r.h5 -o a.png -m 5": "--measurement is 5; give",  # unchanged name
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("names")
    write_recording(folder / "r.h5", noise())
    write_energyscapes(folder / "i.h5", [image()])
    truth = GroundTruth(scene="", seed=1, reflectors=((),))
    write_energyscapes(folder / "t.h5", [image()], truth={"sensor": truth})
    return folder


@pytest.mark.parametrize("line", CASES)
def test_errors_name_the_option_as_typed(folder, monkeypatch, line):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, line.split())
    assert done.exit_code in {1, 2}
    assert done.stderr.startswith(f"ertis: error: {CASES[line]}"), done.stderr


def test_errors_keep_keys_of_settings_files(folder, monkeypatch):
    """Keys of a settings file are not options, so messages keep them."""
    monkeypatch.chdir(folder)
    (folder / "s.toml").write_text("[air]\ntemperature_c = nan\n")
    done = CliRunner().invoke(cli, ["process", "r.h5", "-o", "a.h5", "--settings", "s.toml"])
    assert "air.temperature_c is nan; give a finite number" in done.stderr


def test_errors_of_environment_variables_name_the_option(folder, monkeypatch):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, ["peaks", "i.h5"], env={"ERTIS_PEAKS_TOP": "0"})
    assert done.stderr.startswith("ertis: error: --top is 0; give a whole number of at least 1")


def test_plot_steer_rejects_a_single_number(folder, monkeypatch):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, ["plot", "eRTIS_v2", "-o", "a.png", "--kind", "array", "--steer", "30"])
    assert done.exit_code == 2
    assert "'30' is not a direction; give azimuth and elevation, each from -90 to 90, as in 30:0" in done.stderr

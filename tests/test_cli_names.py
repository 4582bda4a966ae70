"""Error messages name options as typed, even if the library rejects the value."""

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.storage import GroundTruth, write_energyscapes, write_recording
from tests.files import image, noise

USAGE = {
    "export i.h5 -o a.csv --top 0": "--top is 0; give a whole number of at least 1",
    "export i.h5 -o a.csv --min-level 3": "--min-level is 3; give a number from -1000 to 0",
    "peaks i.h5 --top 0": "--top is 0; give a whole number of at least 1",
    "peaks i.h5 --detector cfar --false-alarm 0": "--false-alarm is 0; give",
    "compare t.h5 --min-level nan": "--min-level is nan; give a finite number",
    "plot i.h5 -o a.png --dynamic-range 0": "--dynamic-range is 0; give a number above 0",
    "plot i.h5 -o a.png --kind slices --left nan": "--left is nan; give a finite number",
    "plot eRTIS_v2 -o a.png --kind array --frequency 0": "--frequency is 0; give a number above 0",
    "plot eRTIS_v2 -o a.png --kind array --steer 100:0": (
        "Invalid value for '--steer': '100:0' is not a direction; give azimuth and elevation, each from -90"
    ),
    "process r.h5 -o a.h5 --threads 0": "--threads is 0; give a whole number from 1",
    "plot r.h5 -o a.png --kind signals --microphone -1": "--microphone is -1; give a whole number",
    "simulate s.toml --layout x": "No such option '--layout'",
    "process r.h5 -o a.h5 --max-error 300": "--max-error is 300; give",
    "status tcp://127.0.0.1:9 --patience 0": "--patience is 0; give a number above 0",
    "listen localhost": "address 'localhost' cannot be used; give tcp://HOST:PORT",
}
"""Values that are wrong whatever the files contain."""

FAILURES = {
    "export i.h5 -o a.mcap --ascii": "option --ascii is given, but format 'mcap' does not have it; leave it out, or",
    "export i.h5 -o a.ply --topic points": "option --topic is given, but format 'ply' does not have it; leave it out",
    "export i.h5 -o a.npz --top 3": "option --top is given, but format 'npz' does not have it; leave it out, or write",
    "plot i.h5 -o a.png --columns 1": "--columns is 1, which theme 'dark' has none of; give theme 'paper'",
    "plot i.h5 -o a.png --kind slices --height 300": "--height is 300, where the image shows nothing",
    "plot r.h5 -o a.png --kind signals --microphone 77": "microphone 77 is none of the 32 enabled ones; give",
    "plot r.h5 -o a.png -m 5": "--measurement is 5; give",
    "process r.h5 -o a.h5 --sensor left": "r.h5 has no sensor 'left'",
    "process r.h5 -o a.h5 --range 0.5:50": "processing.range_m ends at 50 m, but the record",
    "process r.h5 -o a.h5 --directions none.csv": "directions none.csv: No such file",
}
"""Values that do not suit a file or other options."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("names")
    write_recording(folder / "r.h5", noise())
    write_energyscapes(folder / "i.h5", [image()])
    truth = GroundTruth(scene="", seed=1, reflectors=((),))
    write_energyscapes(folder / "t.h5", [image()], truth={"sensor": truth})
    return folder


@pytest.mark.parametrize(("line", "code"), [*((line, 2) for line in USAGE), *((line, 1) for line in FAILURES)])
def test_errors_name_the_option_as_typed(folder, monkeypatch, line, code):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, line.split())
    assert done.stderr.startswith(f"ertis: error: {(USAGE | FAILURES)[line]}"), done.stderr
    assert done.exit_code == code
    assert ("; see 'ertis " in done.stderr) == (code == 2)


def test_errors_keep_keys_of_settings_files(folder, monkeypatch):
    """Keys of a settings file are not options, so messages keep them."""
    monkeypatch.chdir(folder)
    (folder / "s.toml").write_text("[air]\ntemperature_c = nan\n")
    done = CliRunner().invoke(cli, ["process", "r.h5", "-o", "a.h5", "--settings", "s.toml"])
    assert "air.temperature_c is nan; give a finite number" in done.stderr


def test_errors_of_environment_variables_name_the_option(folder, monkeypatch):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, ["peaks", "i.h5"], env={"ERTIS_PEAKS_TOP": "0"})
    expected = (
        "--top is 0; give a whole number of at least 1 (from the variable ERTIS_PEAKS_TOP); see 'ertis peaks --help'"
    )
    assert (done.exit_code, done.stderr) == (2, f"ertis: error: {expected}\n")


def test_plot_steer_rejects_a_single_number(folder, monkeypatch):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, ["plot", "eRTIS_v2", "-o", "a.png", "--kind", "array", "--steer", "30"])
    assert done.exit_code == 2
    assert "'30' is not a direction; give azimuth and elevation, each from -90 to 90, as in 30:0" in done.stderr

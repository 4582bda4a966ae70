"""Error messages name options as typed, even if the library rejects the value."""

import click
import pytest
from click.testing import CliRunner
from ertis_cli import _naming, options
from ertis_cli.main import cli

from ertis_numba.storage import GroundTruth, write_acoustic_maps, write_energyscapes, write_recording
from tests.files import image, noise
from tests.storage.test_acoustic_map_files import acoustic_map

USAGE = {
    "export i.h5 -o a.csv --top 0": "--top is 0; use a whole number of at least 1",
    "export i.h5 -o a.csv --min-level 3": "--min-level is 3; use a number from -1000 to 0",
    "peaks i.h5 --top 0": "--top is 0; use a whole number of at least 1",
    "peaks i.h5 --detector cfar --false-alarm 0": "--false-alarm is 0; use",
    "compare t.h5 --min-level nan": "--min-level is nan; use a finite number",
    "plot i.h5 -o a.png --dynamic-range 0": "--dynamic-range is 0; use a number above 0",
    "plot i.h5 -o a.png --dynamic-range 1e300": "Invalid value for '--dynamic-range': 1e+300 is not in the range",
    "plot eRTIS_v2 -o a.png --kind array --frequency 1e300": "Invalid value for '--frequency': 1e+300 is not in the",
    "plot i.h5 -o a.png --kind slices --left nan": "--left is nan; use a finite number",
    "plot eRTIS_v2 -o a.png --kind array --frequency 0": "--frequency is 0; use a number above 0",
    "plot eRTIS_v2 -o a.png --kind array --steer 100:0": (
        "Invalid value for '--steer': '100:0' is not a direction; use azimuth and elevation, each from -90"
    ),
    "process r.h5 -o a.h5 --threads 0": "--threads is 0; use a whole number from 1",
    "plot r.h5 -o a.png --kind signals --microphone -1": "--microphone is -1; use a whole number",
    "simulate s.toml --layout x": "No such option '--layout'",
    "process r.h5 -o a.h5 --max-error 300": "--max-error is 300; use",
    "acoustic r.h5 -o a.h5 --bands 0:2000": "--bands is 0; use a number from 1 to 1e+09",
    "acoustic r.h5 -o a.h5 --bands 3000:2000": "--bands runs from 3000 to 2000; use the smaller number first",
    "acoustic r.h5 -o a.h5 --bands 3000:5000,4000:6000": "--bands has overlapping bands 3000 to 5000 Hz and 4000",
    "process r.h5 -o a.h5 --directions 2d:9 --azimuth 200:300": "--azimuth is 200; use a number from -180 to 180",
    "process r.h5 -o a.h5 --directions 3d:9 --elevation 9:0": "--elevation runs from 9 to 0; use the smaller number",
    "process r.h5 -o a.h5 --directions 2d:99999999999": "directions '2d:99999999999' has a count of 11 digits; use",
    "process r.h5 -o a.h5 --array-weights han": "--array-weights 'han' is unknown (did you mean 'hann'?); known are",
    "process r.h5 -o a.h5 --array-weights hann:3": "--array-weights is 'hann:3' although the window hann has no",
    "process r.h5 -o a.h5 --array-weights taylor:90": "parameter of --array-weights taylor is 90; use a number from",
    "process r.h5 -o a.h5 --without -1": (
        "Invalid value for '--without': '-1' is not a list of channels; use integers from 0 to 1023, as in 5,12"
    ),
    "plot m.h5 -o a.png --photo a.jpg --photo-fov 200,40": "--photo-fov is 200; use a number from 1 to 170",
    "plot m.h5 -o a.png -m -1": "Invalid value for '--measurement' / '-m': -1 is not in the range x>=0",
    "export i.h5 -o a.csv -m -1": "Invalid value for '--measurement' / '-m': '-1' is not a measurement; use one",
    "capture --port p -n 1 --to tcp://127.0.0.1:9 --ring nan": "--ring is nan; use a finite number",
    "capture --port p -n 1 --to tcp://127.0.0.1:9 --spool s --spool-size inf": "--spool-size is inf; use a finite",
    "capture --port p -n 1 --wait nan": "--wait is nan; use a finite number",
    "capture --port p -n 1 --emissions 2 --emission-period nan": "--emission-period is nan; use a finite number",
    "sensors emulate r.h5 --sync-rate nan": "--sync-rate is nan; use a finite number",
    "capture --port p -n 1 --emissions 2 --emission-period 0 --dry-run": "--emission-period is 0; use a number",
    "sensors emulate r.h5 --unplug nan:5": "Invalid value for '--unplug': 'nan:5' is not an absence; use two times",
    "sensors emulate r.h5 --unplug -1:5": "Invalid value for '--unplug': '-1:5' is not an absence; use two times",
    "serve --method paper --plan measured": "--plan needs --method fast; method 'paper' has no plan",
    "serve --workers tcp://127.0.0.1:9 --threads 2": "--threads applies to processes on this machine, not",
    "view i.h5 --clean within=nan": "Invalid value for '--clean': 'within=nan': use a finite number",
    "view i.h5 --clean above-mean=6": (
        "Invalid value for '--clean': 'above-mean=6' is not an option of --clean; use within=DB,above_mean=DB, or one"
    ),
    "process r.h5 -o a.h5 --beamformer capon:diagonal_loading=nan": (
        "Invalid value for '--beamformer': 'diagonal_loading=nan': use a finite number"
    ),
    "sensors calibrate r.h5 -o a.toml --gain-tolerance nan": "--gain-tolerance is nan; use a finite number",
    "sensors status tcp://127.0.0.1:9 --patience 0": "--patience is 0; use a number above 0",
    "listen localhost": "address 'localhost' cannot be used; use tcp://HOST:PORT",
    "export i.h5 -o a.mcap --ascii": "option --ascii is given, but format 'mcap' does not have it; leave it out, or",
    "export i.h5 -o a.ply --topic points": "option --topic is given, but format 'ply' does not have it; leave it out",
    "export i.h5 -o a.npz --top 3": "option --top is given, but format 'npz' does not have it; leave it out, or write",
}
"""Values that are wrong whatever the files contain."""

FAILURES = {
    "plot i.h5 -o a.png --columns 1": "--columns is 1, which theme 'dark' does not have; use theme 'paper'",
    "plot i.h5 -o a.png --kind slices --height 300": "--height is 300, where the image shows nothing",
    "plot r.h5 -o a.png --kind signals --microphone 77": "microphone 77 is none of the 32 enabled ones; use",
    "plot r.h5 -o a.png -m 5": "--measurement is 5; use",
    "process r.h5 -o a.h5 --sensor left": "r.h5 has no sensor 'left'",
    "process r.h5 -o a.h5 --range 0.5:50": "--range ends at 50 m, but the record",
    "process r.h5 -o a.h5 --without 99": "--without is 99; use a whole number from 0 to 31",
    "process r.h5 -o a.h5 --array-weights hann --beamformer capon": (
        "--array-weights is 'hann', but --beamformer 'capon' supports only 'uniform'; leave --array-weights out, or"
    ),
    "plot m.h5 -o a.png -m 5": "--measurement is 5; use a whole number from 0 to 0",
    "process r.h5 -o a.h5 --directions none.csv": "directions none.csv: No such file",
}
"""Values that do not suit a file or other options."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("names")
    write_recording(folder / "r.h5", noise())
    write_energyscapes(folder / "i.h5", [image()])
    write_acoustic_maps(folder / "m.h5", [acoustic_map()])
    truth = GroundTruth(scene="", seed=1, reflectors=((),))
    write_energyscapes(folder / "t.h5", [image()], truth={"sensor": truth})
    return folder


@pytest.mark.parametrize(("line", "code"), [*((line, 2) for line in USAGE), *((line, 1) for line in FAILURES)])
def test_errors_name_the_option_as_typed(folder, monkeypatch, line, code):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, line.split())
    stated = done.stderr.removeprefix(f"{options.PREPARING}\n")  # a slow machine prints this note first
    assert stated.startswith(f"ertis: error: {(USAGE | FAILURES)[line]}"), done.stderr
    assert done.exit_code == code
    assert ("; see 'ertis " in done.stderr) == (code == 2)


def test_errors_keep_keys_of_settings_files(folder, monkeypatch):
    """Keys of a settings file are not options, so messages keep them."""
    monkeypatch.chdir(folder)
    (folder / "s.toml").write_text("[air]\ntemperature_c = nan\n")
    done = CliRunner().invoke(cli, ["process", "r.h5", "-o", "a.h5", "--settings", "s.toml"])
    assert "air.temperature_c is nan; use a finite number" in done.stderr


def test_errors_of_environment_variables_name_the_option(folder, monkeypatch):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, ["peaks", "i.h5"], env={"ERTIS_PEAKS_TOP": "0"})
    expected = (
        "--top is 0; use a whole number of at least 1 (from the variable ERTIS_PEAKS_TOP); see 'ertis peaks --help'"
    )
    assert (done.exit_code, done.stderr) == (2, f"ertis: error: {expected}\n")


def test_plot_steer_rejects_a_single_number(folder, monkeypatch):
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(cli, ["plot", "eRTIS_v2", "-o", "a.png", "--kind", "array", "--steer", "30"])
    assert done.exit_code == 2
    assert "'30' is not a direction; use azimuth and elevation, each from -90 to 90, as in 30:0" in done.stderr


@pytest.mark.parametrize(
    ("given", "message", "stated"),
    [
        ("process --method fast", "passive.method is 'music'; choose another", "passive.method"),
        ("process --without 3", "array.disabled is 99; choose another", "array.disabled"),
        ("process --without 99", "array.disabled is 99; choose another", "--without"),
        ("acoustic --method music", "passive.method is 'music'; choose another", "--method"),
        ("acoustic --method music", "processing.method is 'fast'; choose another", "processing.method"),
        ("process --method fast", "processing.method is 'fast'; choose another", "--method"),
        ("acoustic --average 3", "passive.averages is 3; choose another", "--average"),
        ("acoustic --bands octaves", "passive.bands_hz[0] ends at 9 Hz; choose another", "--bands"),
    ],
)
def test_keys_that_are_no_options_keep_their_names(given, message, stated):
    name, *given = given.split()
    ctx = cli.get_command(click.Context(cli, **cli.context_settings), name).make_context(
        name, ["a.h5", "-o", "b.h5", *given]
    )
    assert _naming.named(message, ctx) == f"{stated} {message.partition(' ')[2]}"


@pytest.mark.parametrize(
    ("names", "message", "stated"),
    [
        (
            ("export",),
            "choose one (sensor), or add them (mountings)",
            "choose one (--sensor), or add them (--mounting)",
        ),
        (("keys", "allow"), "choose another name (name)", "choose another name (--name)"),
        (("capture",), "pass its key (server)", "pass its key (--server-key)"),
        (("sensors", "reset"), "reset the sensor (pulse)", "reset the sensor (--hook)"),
        (("capture",), "spool_bytes and ring_bytes", "--spool-size and --ring"),
        (
            ("import", "signals"),
            "use join=True, sync_channel=3 or length_s",
            "use --join, --sync-channel 3 or --length",
        ),
        (("import", "signals"), "length_s.wav, in/length_s and x.length_s", "length_s.wav, in/length_s and x.length_s"),
        (("info",), "replace it (overwrite=True)", "replace it (overwrite=True)"),
    ],
)
def test_with_options_replaces_parameters_but_no_paths(names, message, stated):
    command, ctx = cli, click.Context(cli, **cli.context_settings)
    for name in names:
        command = command.get_command(ctx, name)
        ctx = click.Context(command, parent=ctx)
    assert _naming.with_options(message, ctx) == stated

"""The command `ertis sensors calibrate`, plots of calibrations, and the page docs/how-to/calibrate.md."""

import dataclasses
import importlib.metadata
import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.error_trials.faulty_arrays import faulty_array, record
from ertis_cli.main import cli

from ertis_numba.geometry import layout_file, load_layout
from ertis_numba.geometry.layout_files import LayoutFile
from ertis_numba.settings import Settings
from ertis_numba.simulation.scene import load_scene
from ertis_numba.storage import open_energyscapes, write_recording
from tests.pages import commands_in, page, python_in, run_code_here, run_here

SEED = 3200


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Files of one measurement each, and one file of all."""
    folder = tmp_path_factory.mktemp("recordings")
    measurements = record(faulty_array(SEED), SEED, 8)
    paths = [folder / f"{number}.h5" for number in range(len(measurements))]
    for path, item in zip(paths, measurements, strict=True):
        write_recording(path, [item])
    stamped = (
        dataclasses.replace(item, stamp=dataclasses.replace(item.stamp, sequence=number))
        for number, item in enumerate(measurements)
    )
    write_recording(folder / "all.h5", stamped)
    return paths, folder / "all.h5"


def ertis(*arguments):
    return CliRunner().invoke(cli, ["sensors", "calibrate", *map(str, arguments)])


def test_command_prints_changes_and_writes_a_layout(recordings, tmp_path):
    paths, _ = recordings
    done = ertis(*paths, "-o", tmp_path / "mine.toml")
    assert done.exit_code == 0, done.output
    array = faulty_array(SEED)
    for channel in array.dead:
        assert f"channel {channel} is silent" in done.stdout
    layout = load_layout(tmp_path / "mine.toml")
    assert layout.name == "mine"
    assert tuple(np.flatnonzero(~layout.enabled)) == array.dead
    gain_db = 20 * np.log10(np.abs(layout.gain)) - array.gain_db
    assert np.std(gain_db[layout.enabled]) < 0.02
    assert [line.split()[0] for line in done.stdout.splitlines()[1:4]] == [
        str(channel) for channel in np.flatnonzero(layout.enabled)[:3]
    ]


def test_one_file_of_many_measurements_is_the_same(recordings):
    paths, whole = recordings
    one, many = (json.loads(ertis("--json", *given).stdout) for given in ([whole], paths))
    assert one["channels"] == many["channels"]
    assert one["layout"] is None
    assert one["residuals"]["after_us"] < one["residuals"]["before_us"]


def test_nothing_is_written_if_images_get_worse(tmp_path):
    """The direct sound of the real recording depends on the housing of the sensor."""
    source = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    done = CliRunner().invoke(
        cli,
        [
            "import",
            "signals",
            str(source),
            "-o",
            str(tmp_path / "real.h5"),
            "--preset",
            "default_25_50",
            "--layout",
            "eRTIS_v3D1",
        ],
    )
    assert done.exit_code == 0, done.output
    done = ertis(tmp_path / "real.h5", "--target", "direct", "-o", tmp_path / "real.toml")
    assert done.exit_code == 1
    assert "residuals of 1 measurement" in done.stdout
    assert "not observable: positions" in done.stderr
    assert re.search(r"lowers the contrast of images from .* so it is not written", done.stderr)
    assert not (tmp_path / "real.toml").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["{one}"], "cannot tell positions from delays"),
        (["{all}", "-o", "{folder}/layout.csv"], "does not end in .toml"),
        (["{all}", "-o", "{folder}/kept.toml"], "exists"),
        (["{all}", "--layout", "nonsense"], "eRTIS_v3D1"),
        (["{all}", "--sensor", "nobody"], "nobody"),
        (["{all}", "--first-place", "12:13"], "as in 30:15:1.2"),
        (["{folder}/absent.h5"], "absent.h5"),
        (["{all}", "--poses", "--target", "wall"], "--target is not for --poses"),
        (["{all}", "--poses"], "at least two"),
        (["{all}", "--sensors", "front"], "--sensors requires --poses"),
    ],
)
def test_errors_write_nothing(recordings, tmp_path, arguments, text):
    paths, whole = recordings
    kept = tmp_path / "kept.toml"
    kept.write_text("content")
    places = {"one": paths[0], "all": whole, "folder": tmp_path}
    done = ertis(*(argument.format(**places) for argument in arguments))
    assert done.exit_code in {1, 2}
    assert text in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["kept.toml"]
    assert kept.read_text() == "content"


def test_plot_shows_residuals_and_beam(recordings, tmp_path):
    _, whole = recordings
    done = CliRunner().invoke(cli, ["plot", str(whole), "--kind", "calibration", "-o", str(tmp_path / "cal.svg")])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "cal.svg").stat().st_size > 20_000


def test_layout_file_is_read_back():
    layout = load_layout("uRTIS_v1")
    text = layout_file(layout, name="other", source="test").to_toml()
    again = LayoutFile.from_toml(text, "layout")
    assert len(text.splitlines()) < 2 * len(layout.enabled) + 12 + 2 * len(layout.enabled)
    assert again.name == "other"
    assert np.allclose(np.array(again.positions_mm) / 1000, layout.positions_m, atol=1e-7)


def test_commands_and_code_of_the_page_run(tmp_path):
    text = page("calibrate")
    for name, content in re.findall(r"`([\w.]+)`:\n\n```\w+\n(.*?)```", text, re.DOTALL):
        (tmp_path / name).write_text(content)
    printed = [run_here(tmp_path, command) for command in commands_in(text)]
    (shown,) = re.findall(r"```\n(channel 5 is silent\n.*?)```", text, re.DOTALL)
    for line in shown.splitlines():
        words = re.sub(r"[\d.]+", "#", line)
        assert any(words == re.sub(r"[\d.]+", "#", other) for output in printed for other in str(output).splitlines())
    with open_energyscapes(tmp_path / "calibrated.h5") as images:
        assert not microphone_five(images.settings)
    left = load_scene(tmp_path / "mounting.toml").sensor("left")
    assert np.allclose(left.position_m, (-0.1, 0.2, 0.05), atol=2e-3)
    assert abs(left.yaw_deg - 40) < 0.2
    (code,) = python_in(text)
    assert "channel 5 is silent" in run_code_here(tmp_path, code)


def microphone_five(settings: Settings):
    return settings.array.enabled[5]

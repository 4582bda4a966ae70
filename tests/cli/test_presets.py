"""Shipped presets, by our names and those of RTIS Dev."""

import json
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import direction_grid
from ertis_numba.settings import Processing, Settings, preset_tables, preset_text
from ertis_numba.storage import open_energyscapes, write_recording
from tests.files import noise
from tests.pages import page


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, list(map(str, arguments)))
    assert done.exit_code == code, done.output
    return done


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("presets") / "noise.h5"
    write_recording(path, noise(Settings.from_preset("default_25_50"), 1))
    return path


def rtisdev_presets(kind):
    folder = Path(str(metadata.distribution("rtisdev").locate_file(f"rtisdev/config/premadeSettings/{kind}")))
    return {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}


@pytest.mark.parametrize("name", ertis.presets("processing"))
def test_processing_preset_has_the_directions_and_ranges_of_its_name(name):
    kind, count, last = name.split("_")
    made = Processing.from_preset(name)
    grid = direction_grid(made)
    assert len(grid) == int(count)
    assert made.range_m == (0.5, float(last.removesuffix("m")))
    assert (grid.elevation_rad == 0).all() == (kind == "2d")
    assert abs(grid.azimuth_deg).max() == pytest.approx(90, abs=0 if kind == "2d" else 4)


def test_every_processing_preset_of_rtisdev_is_accepted_by_its_name():
    """Except for its example of custom delays, which is a set of files."""
    theirs = rtisdev_presets("processing")
    del theirs["custom_example_2D_5m_91"]
    assert len(theirs) == len(ertis.presets("processing"))
    for name, content in theirs.items():
        made = Processing.from_preset(name)
        assert len(direction_grid(made)) == content["directions"]
        assert made.directions.startswith("2d" if content["2D"] else "3d")
        assert made.range_m == (content["minRange"], content["maxRange"])


def test_preset_text_is_a_settings_file_with_the_keys_of_the_preset():
    for name in ertis.presets():
        assert tomllib.loads(preset_text(name)) == preset_tables(name)
        Settings.from_toml(preset_text(name))
    assert Settings.from_toml(preset_text("2D_5m_91")).processing == Processing.from_preset("2d_91_5m")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Processing.from_preset("2d_180_5m"), r"preset '2d_180_5m' is unknown \(did you mean '2d_181_5m'\?\)"),
        (lambda: Processing.from_preset("long_20_80"), "'long_20_80', a recording preset; use it with Settings.from"),
        (lambda: Settings.from_preset("2d_181_5m"), "'2d_181_5m', a processing preset; use it with Processing.from"),
        (lambda: Settings.from_preset(None), "preset 'None' is unknown; known are short_20_80"),
        (lambda: ertis.presets("call"), "kind 'call' is unknown; known are recording, processing"),
    ],
)
def test_unknown_presets_and_those_of_the_other_kind_are_refused(make, message):
    with pytest.raises(ArgumentError, match=message):
        make()


def test_presets_command_lists_all_presets():
    rows = json.loads(run("reference", "presets", "--json").stdout)["presets"]
    assert tuple(row["name"] for row in rows) == ertis.presets()
    assert {row["name"]: row["kind"] for row in rows}["2d_181_5m"] == "processing"
    text = run("reference", "presets").stdout
    assert all(name in text for name in ertis.presets())


def test_presets_command_prints_a_usable_settings_file(recording, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(run("reference", "presets", "2D_5m_91").stdout)
    run("process", recording, "-o", tmp_path / "file.h5", "--settings", path, "-q")
    run("process", recording, "-o", tmp_path / "name.h5", "--preset", "2d_91_5m", "-q")
    with open_energyscapes(tmp_path / "file.h5") as by_file, open_energyscapes(tmp_path / "name.h5") as by_name:
        assert by_file.settings == by_name.settings
        assert by_file[0].amplitude.tobytes() == by_name[0].amplitude.tobytes()
        assert by_name[0].amplitude.shape[0] == 91
    assert json.loads(run("reference", "presets", "2d_91_5m", "--json").stdout)["toml"] == preset_text("2d_91_5m")
    assert "preset '2d_19_5m' is unknown (did you mean" in run("reference", "presets", "2d_19_5m", code=1).stderr


def test_options_override_the_preset_which_overrides_the_settings_file(recording, tmp_path):
    settings = tmp_path / "mine.toml"
    settings.write_text(
        "processing.directions = '2d:7'\nprocessing.azimuth_limits_deg = [-10, 10]\nair.humidity_percent = 20"
    )
    run("process", recording, "-o", tmp_path / "a.h5", "--settings", settings, "--preset", "2D_5m_91", "-q")
    with open_energyscapes(tmp_path / "a.h5") as images:
        assert images.settings.processing.azimuth_limits_deg == (-90, 90)
        assert images.settings.processing.directions == "2d:91"
        assert images.settings.air.humidity_percent == 20
    run("process", recording, "-o", tmp_path / "b.h5", "--preset", "2d_91_5m", "--range", "1:2", "-q")
    with open_energyscapes(tmp_path / "b.h5") as images:
        assert images.settings.processing.range_m == (1, 2)
    done = run("process", recording, "-o", tmp_path / "c.h5", "--preset", "long_20_80", code=1)
    assert "--preset is 'long_20_80', a recording preset" in done.stderr
    assert not (tmp_path / "c.h5").exists()
    done = run("process", recording, "-o", tmp_path / "c.h5", "--preset", "3d_3000_10m", code=1)
    assert "processing.range_m ends at 10 m, but the record" in done.stderr


def test_serve_refuses_an_unknown_preset_before_it_listens():
    done = run("serve", "--listen", "tcp://127.0.0.1:0", "--preset", "2d_18_5m", code=2)
    assert "preset '2d_18_5m' is unknown" in done.stderr


def test_settings_of_rtisdev_have_keys_of_the_same_meaning():
    """The table names arguments of rtisdev and keys of processing; its values are the defaults of rtisdev."""
    text = page("settings").partition("## Settings of RTIS Dev")[2].partition("\n## ")[0]
    rows = [row.strip("| ").split(" | ") for row in text.splitlines() if row.startswith("| `")]
    keys = {key for _, here in rows for key in re.findall(r"`([a-z_]+)(?: =[^`]*)?`", here)}
    assert keys <= set(Processing.__struct_fields__)
    assert len(rows) >= 15
    assigned = dict(re.findall(r"`([a-z_]+) = ([\d.]+)`", text))
    assert {"clean_within_db", "clean_above_mean_db", "filter_rate_hz", "delay_rate_hz"} == assigned.keys()
    Processing(**{name: float(value) for name, value in assigned.items()})
    source = Path(str(metadata.distribution("rtisdev").locate_file("rtisdev/RTISDev.py"))).read_text("utf-8")
    for theirs, _ in rows:
        for name in re.findall(r"`(\w+)(?: = [^`]*)?`", theirs):
            assert name in source, name


def test_former_name_of_the_layouts_command_works():
    assert run("reference", "layouts").stdout == run("reference", "layouts").stdout
    assert all(name in run("reference", "layouts").stdout for name in ertis.layout_names())

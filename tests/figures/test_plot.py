"""``ertis plot`` draws each kind of plot from its source file, and the examples of ``docs/how-to/plots.md`` run."""

import contextlib
import dataclasses
import json
import re
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from ertis_cli.plot import _KINDS, _ONLY, plot
from matplotlib.figure import Figure
from PIL import Image

from ertis_numba import figures
from ertis_numba.figures import _images, _slices, style
from ertis_numba.geometry import direction_grid, microphones
from ertis_numba.settings import Processing, Settings
from ertis_numba.storage import write_energyscapes, write_recording
from tests.files import image, noise
from tests.pages import page

ROOT = Path(__file__).parents[2]
PAGE = page("plots")


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def n_colours(picture):
    """Return the number of colours of one in 16 pixels."""
    some = picture.convert("RGB").resize((picture.width // 4, picture.height // 4), Image.NEAREST)
    return len(some.getcolors(some.width * some.height))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plot")
    grid = direction_grid(Processing(directions="3d:200"))
    solid = image(grid.azimuth_rad * 57.29577951308232, grid.elevation_rad * 57.29577951308232)
    write_energyscapes(folder / "img.h5", [image(), image(seed=2)])
    write_energyscapes(folder / "solid.h5", [solid])
    write_recording(folder / "rec.h5", noise())
    (folder / "settings.toml").write_text(Settings().to_toml())
    (folder / "layout.toml").write_text("positions_mm = [[0, 0], [5, 0], [0, 8]]\n")
    (folder / "layout.csv").write_text("y_mm, z_mm\n0, 0\n5, 0\n0, 8\n")
    return folder


@pytest.mark.parametrize(
    ("source", "kind", "options"),
    [
        ("img.h5", "image", "--peaks 2 --font serif"),
        ("solid.h5", "slices", "--peaks 0 -m 0"),
        ("rec.h5", "matched-filter", "-m 1 --sensor eRTIS-7"),
        ("img.h5", "array", "--steer 20:-10 --frequency 25e3 --frequency 40000"),
    ],
)
def test_plots_for_print_have_their_content_and_width(files, tmp_path, source, kind, options):
    target = tmp_path / "a.png"
    command = ["plot", files / source, "--kind", kind, *options.split(), "--theme", "paper", "--columns", 1]
    command += ["-o", target, "--json"]
    report = json.loads(run(*command).stdout)
    assert (report["output"], report["kind"]) == (str(target), kind)
    assert ("measurement" in report) == (kind != "array")
    with Image.open(target) as picture:
        assert picture.getpixel((0, 0))[:3] == (255, 255, 255)
        assert n_colours(picture) > 30
        assert picture.width == pytest.approx(85 / 25.4 * 300, abs=1)


@pytest.mark.parametrize(
    ("source", "n_mics"), [("rec.h5", 32), ("img.h5", 32), ("settings.toml", 32), ("layout.toml", 3), ("layout.csv", 3)]
)
def test_arrays_of_all_sources_are_read(files, tmp_path, monkeypatch, source, n_mics):
    given = []
    monkeypatch.setattr(figures, "array", lambda settings, **_: given.append(settings) or Figure((1, 1)))
    run("plot", files / source, "--kind", "array", "-o", tmp_path / "a.svg")
    [settings] = given
    assert len(microphones(settings.array).enabled) == n_mics


def test_plot_accepts_the_name_of_a_layout(tmp_path):
    with contextlib.chdir(tmp_path):
        stated = run("plot", "uRTIS_v1", "--kind", "array").stderr
    assert stated == "uRTIS_v1.png: array of uRTIS_v1\n"
    assert (tmp_path / "uRTIS_v1.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("command", "code", "match"),
    [
        ("plot img.h5 --kind polar --height 1", 2, "--height is for --kind slices; remove it with polar"),
        ("plot rec.h5 --kind signals --peaks 3", 2, "--peaks is for --kind image, polar, projection, slices"),
        ("plot rec.h5 --kind array -m 1", 2, "--measurement is for --kind image, polar, projection, slices, signals"),
        ("plot img.h5 --frequency 4e4", 2, "--frequency is for --kind array; remove it with image"),
        ("plot img.h5 --columns 1", 1, "--columns is 1, which theme 'dark' does not have; use theme 'paper'"),
        ("plot img.h5 --kind signals", 1, "img.h5 is an energyscape file, wanted a recording"),
        ("plot settings.toml --kind array --sensor x", 2, "--sensor chooses a sensor in a file"),
        (
            "plot eRTIS_v3D2 --kind array",
            1,
            "layout 'eRTIS_v3D2' is unknown (did you mean 'eRTIS_v3D1'?); known are eR",
        ),
        ("plot eRTIS_v3D1", 2, "eRTIS_v3D1 contains no measurement; use --kind array, or a recording, an energyscape"),
        ("plot settings.toml --kind signals", 2, "settings.toml contains no measurement; use --kind array, or a"),
        (
            "plot none.h5 --kind array",
            1,
            "none.h5: No such file or directory; choose a recording, an energyscape file or a file of acoustic maps",
        ),
        ("plot rec.h5 --kind signals --microphone 40", 1, "microphone 40 is none of the 32 enabled ones"),
        ("plot img.h5 --kind slices --left 1", 1, "--left is 1, but a planar image has no upright plane; leave it out"),
        ("plot solid.h5 --kind slices --height 50", 1, "--height is 50, where the image shows nothing"),
    ],
)
def test_plot_refuses_invalid_input(files, tmp_path, command, code, match):
    name, source, *rest = command.split()
    source = files / source if (files / source).exists() else source
    stated = run(name, source, *rest, "-o", tmp_path / "a.png", code=code).stderr
    assert match in stated
    assert not (tmp_path / "a.png").exists()


def test_every_plot_option_names_its_kinds():
    """The help text names the kinds of each option in the table, and every kind of plot."""
    names = {option.opts[0].removeprefix("--") for option in plot.params}
    assert set(_ONLY) <= names
    stated = " ".join(run("plot", "--help").stdout.split())
    assert all(about in stated for about in _KINDS.values())


@pytest.fixture
def _coarse(monkeypatch):
    """Save a quarter of the pixels along each side: other tests check the resolution."""
    coarse = {name: dataclasses.replace(theme, dpi=theme.dpi // 4) for name, theme in style.THEMES.items()}
    monkeypatch.setattr(style, "THEMES", coarse)
    monkeypatch.setattr(_images, "PIXELS", 250)
    monkeypatch.setattr(_slices, "_PIXELS", 125)


@pytest.mark.usefixtures("_coarse")
def test_plot_commands_of_the_page_run(tmp_path):
    commands = re.findall(r"^\$ ertis (.*?)(?:\s+#.*)?$", PAGE, re.MULTILINE)
    with contextlib.chdir(tmp_path):
        for command in commands:
            done = CliRunner().invoke(cli, command.split())
            assert done.exit_code == 0, (command, done.stderr, done.exception)
    pictures = sorted(tmp_path.glob("*.png"))
    assert len(pictures) == sum(command.endswith(".png") for command in commands)
    for path in pictures:
        with Image.open(path) as picture:
            assert n_colours(picture) > 30, path
            assert (picture.getpixel((0, 0))[:3] == (255, 255, 255)) == (path.stem == "polar"), path  # --theme light
    assert {kind for kind in _KINDS if f"--kind {kind}" in PAGE} == {*_KINDS} - {"image"}
    assert all(f"`{kind}`" in PAGE for kind in _KINDS)


@pytest.mark.usefixtures("_coarse")
def test_plot_code_of_the_page_runs(tmp_path):
    shutil.copy(ROOT / "data" / "synthetic" / "reflectors.h5", tmp_path)
    with contextlib.chdir(tmp_path):
        for code in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
            exec(compile(code, "docs/how-to/plots.md", "exec"), {})
    assert (tmp_path / "picture.pdf").read_bytes().startswith(b"%PDF")

"""What the pages of the guide say runs, and they name everything that there is."""

import contextlib
import re
import sys
from pathlib import Path

import pytest

import ertis_numba
from ertis_numba.storage import open_recording
from tests.pages import commands_in, in_background, run, run_here

DOCS = Path(__file__).parents[1] / "docs"
ROOT = DOCS.parent


def page(name):
    return (DOCS / f"{name}.md").read_text("utf-8")


def python_in(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    (tmp_path / "data").symlink_to(ROOT / "data")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


def test_start(place):
    text = page("index")
    with contextlib.ExitStack() as background:
        for command in commands_in(text):
            if command.endswith("&"):
                background.enter_context(in_background(place, command))
            elif command != "doctor":  # test_doctor
                run_here(place, command)
    (code,) = python_in(text)
    assert "1.15 m at" in run(place, sys.executable, "-W", "error", "-c", code).stdout
    assert (place / "image.png").stat().st_size > 10_000
    assert len(open_recording(place / "CAPTURED.h5")) == 10


def test_own_array(place):
    text = page("own-array")
    files = re.findall(r"`([\w.]+)`:\n\n```\w+\n(.*?)```", text, re.DOTALL)
    assert [name for name, _ in files] == ["ring.csv", "mine.toml", "scene.toml"]
    for name, content in files:
        (place / name).write_text(content)
    told = [run_here(place, command) for command in commands_in(text)]
    assert re.search(r"\+14\.\d+ .* 1\.23\d ", told[2])  # 1.2 m ahead and 0.3 m to the left
    (code,) = python_in(text)
    run(place, sys.executable, "-W", "error", "-c", code)
    assert open_recording(place / "mine.h5")[0].words.dtype == "u4"


def test_python_names_all_that_is_public():
    named = re.findall(r"^\.\. auto\w+:: ertis_numba\.(\w+)$", page("python"), re.MULTILINE)
    assert sorted(named) == ertis_numba.__all__


def test_every_page_is_in_the_guide():
    listed = set(" ".join(re.findall(r"```{toctree}\n(.*?)```", page("index"), re.DOTALL)).split())
    pages = {path.stem for path in DOCS.glob("*.md")} - {"index"}
    assert pages <= listed

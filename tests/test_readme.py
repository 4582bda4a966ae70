"""What the README and the pages on simulation and sensors say runs."""

import contextlib
import importlib.metadata
import re
import shutil
import sys
from pathlib import Path

import pytest
from ertis_cli.main import COMMANDS

from ertis_numba.storage import open_recording, write_recording
from tests.files import SMALL, noise
from tests.pages import commands_in, in_background, page, run, run_here

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SIMULATION = page("simulation")
DEVICES = page("devices")
NETWORK = next(block for block in README.split("```") if "ertis serve" in block)
ELSEWHERE = {
    *("completion", "demo", "doctor", "keys", "layout", "listen", "record", "serve", "settings", "status", "view")
}
"""Commands with tests or pages of their own."""

PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md")))]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the files that the README's commands name."""
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    (tmp_path / "data").symlink_to(ROOT / "data")
    real = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    shutil.copy(str(real), tmp_path / "RAW.bin")
    shutil.copy(ROOT / "data" / "synthetic" / "reflectors.h5", tmp_path / "reflectors.h5")
    (tmp_path / "RUNS").mkdir()
    write_recording(tmp_path / "RUNS" / "first.h5", noise(SMALL, 1))
    for name in ("SCENE.toml", "reflectors.toml"):
        shutil.copy(ROOT / "data" / "synthetic" / "reflectors.toml", tmp_path / name)
    return tmp_path


def test_readme_code_runs(place):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    run(place, sys.executable, "-W", "error", "-c", code)
    assert (place / "image.png").stat().st_size > 10_000


def test_readme_describes_every_folder():
    reported = page("architecture")
    folders = {path.parent.name for path in (ROOT / "ertis_numba").glob("*/__init__.py")}
    assert {
        name for name in folders if f"`{name}/`" not in reported and f"`ertis_numba/{name}/`" not in reported
    } == set()


def test_readme_commands_run(place):
    """Each in a process of its own where it is shown first."""
    started = set()
    with contextlib.ExitStack() as background:
        for command in commands_in(README.replace(NETWORK, "")):
            name, *arguments = command.split()
            if name in ELSEWHERE:
                continue
            if (place / "REC.h5").exists() and "REC.h5" in arguments and name in {"import", "simulate"}:
                (place / "REC.h5").unlink()  # each of the two ways to a recording is shown
            if arguments and arguments[-1] == "&":
                background.enter_context(in_background(place, command))
            elif name in started:
                run_here(place, command)
            else:
                run(place, sys.executable, "-m", "ertis_cli.main", name, *arguments)
            started.add(name)
    assert started == {*COMMANDS} - ELSEWHERE - {"bench"}
    assert (place / "IMAGES" / "first.energy.h5").exists()
    assert (place / "picture.png").stat().st_size > 10_000
    assert (place / "shelf.png").stat().st_size > 10_000


def test_commands_of_the_devices_page_run(place):
    with contextlib.ExitStack() as background:
        for command in commands_in(DEVICES):
            if command.endswith("&"):
                background.enter_context(in_background(place, command))
            else:
                run_here(place, command)
    with open_recording(place / "BOTH.h5", sensor="east") as recording:
        assert 10 <= len(recording) <= 20  # a busy emulator ignores pulses while it still measures


def test_readme_example_runs(place):
    """The nearest of the strong reflectors of the recording that is emulated."""
    with in_background(place, "emulate data/synthetic/reflectors.h5 &"):
        reported = run(
            place, sys.executable, "-W", "error", str(ROOT / "examples" / "1_nearest_reflector.py"), "sensor"
        )
    assert reported.stdout.splitlines() == [f"#{number}: 1.15 m at -38°" for number in range(5)]


def test_commands_of_the_simulation_page_run(place):
    (code,) = re.findall(r"```python\n(.*?)```", SIMULATION, re.DOTALL)
    reported = run(place, sys.executable, "-W", "error", "-c", code).stdout
    assert "absorption True" in reported
    assert reported.endswith("() ()\n")  # nothing missed, nothing false
    for command in commands_in(SIMULATION):
        reported = run_here(place, command)
    assert "points[0]" in reported


def test_gallery_starts_like_the_readme():
    gallery = page("gallery")
    assert set(commands_in(gallery)) <= set(commands_in(README))


@pytest.mark.parametrize("name", PAGES)
def test_files_named_on_pages_exist(name):
    path = ROOT / name
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        assert "://" in target or (path.parent / target).exists(), target


@pytest.mark.parametrize(
    "name", ["README.md", "docs/tutorial/quickstart.md", "docs/how-to/network.md", "docs/how-to/applications.md"]
)
def test_emulator_blocks_can_be_pasted_unchanged(name):
    """Commands that follow at once find no sensor, so they wait for it."""
    blocks = [block for block in (ROOT / name).read_text().split("```") if "$ ertis emulate" in block]
    assert blocks
    for block in blocks:
        _, *after = re.findall(r"^\$ ertis (?:emulate .*|capture .*|devices)$", block, re.MULTILINE)
        assert "capture" in after[0]
        assert "--wait" in after[0]


def test_network_blocks_give_the_mounting_of_their_sensors():
    for path in ("README.md", "docs/how-to/network.md", "docs/how-to/applications.md"):
        (captured,) = re.findall(r"^\$ ertis capture .*--to .*$", (ROOT / path).read_text(), re.MULTILINE)
        assert "--mounting platform.toml" in captured

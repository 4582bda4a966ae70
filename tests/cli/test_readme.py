"""Commands and code in the README and in the pages on simulation and sensors run."""

import contextlib
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from ertis_cli.main import COMMANDS

from ertis_numba.storage import open_recording
from tests.emulated import PATIENT, patient
from tests.pages import command_program, commands_in, forking, in_background, page, run_code_here, run_here

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
SIMULATION = page("simulation")
DEVICES = page("devices")
TOUR = page("tour")
NETWORK = next(block for block in TOUR.split("```") if "ertis serve" in block)
ELSEWHERE = {
    *(
        "demo",
        "doctor",
        "fuse",
        "keys",
        "listen",
        "map",
        "odometry",
        "record",
        "reference",
        "ros",
        "serve",
        "view",
    )
}
"""Commands with tests or pages of their own."""

PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md")))]

__all__ = ["patient"]  # A fixture, imported for use here.

pytestmark = PATIENT


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Empty folder, with a folder of its own for links to emulated sensors."""
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    return tmp_path


def test_readme_code_runs(place):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    run_here(place, "example reflectors")
    run_code_here(place, code)
    assert (place / "image.png").stat().st_size > 10_000


def test_readme_describes_every_folder():
    reported = page("architecture")
    folders = {path.parent.name for path in (ROOT / "ertis_numba").glob("*/__init__.py")}
    assert {
        name for name in folders if f"`{name}/`" not in reported and f"`ertis_numba/{name}/`" not in reported
    } == set()


def test_commands_of_the_readme_and_the_tour_run(place, tmp_path_factory):
    """Each command imports its own modules at its first occurrence.

    The emulator replays a recording of its scene, which starts sooner. Two measurements are captured, not ten: the
    others would take half a minute of processor time in the commands that follow, and show nothing else.
    """
    started = set()
    with contextlib.ExitStack() as stack:
        run_forked = stack.enter_context(forking(place, tmp_path_factory.mktemp("output")))
        for command in commands_in(
            (README + TOUR)
            .replace(NETWORK, "")
            .replace("sensors emulate reflectors.toml", "sensors emulate reflectors.h5")
            .replace(" -n 10 ", " -n 2 ")
        ):
            name, *arguments = shlex.split(command)
            if name in ELSEWHERE or command.startswith("sensors calibrate"):
                continue
            if arguments[-1:] == ["&"]:
                stack.enter_context(in_background(place, command))
            elif name in started:
                run_here(place, command)
            else:
                done = run_forked(command_program([name, *arguments]))
                assert done.code == 0, (command, done)
            started.add(name)
    assert started == {*COMMANDS} - ELSEWHERE - {"bench"}
    assert (place / "images" / "captured.energy.h5").exists()
    assert (place / "picture.png").stat().st_size > 10_000
    assert (place / "shelf.png").stat().st_size > 10_000


@pytest.mark.alone  # the emulator keeps a rate of pulses
def test_commands_of_the_devices_page_run(place):
    """The first emulator replays a recording of its scene, which starts sooner."""
    with contextlib.ExitStack() as background:
        for command in commands_in(DEVICES.replace("sensors emulate reflectors.toml", "sensors emulate reflectors.h5")):
            if command.endswith("&"):
                background.enter_context(in_background(place, command))
            else:
                run_here(place, command)
    with open_recording(place / "BOTH.h5", sensor="east") as recording:
        assert 10 <= len(recording) <= 20  # A busy emulator ignores pulses during a measurement.


def test_readme_example_runs(place, monkeypatch):
    """The example prints the nearest strong reflector of the emulated recording."""
    example = ROOT / "examples" / "1_nearest_reflector.py"
    shutil.copy(ROOT / "data" / "synthetic" / "reflectors.h5", place)
    monkeypatch.setattr(sys, "argv", [str(example), "sensor"])
    with in_background(place, "sensors emulate reflectors.h5 &"):
        reported = run_code_here(place, example.read_text("utf-8"), str(example))
    assert reported.splitlines() == [f"#{number}: 1.15 m at -38°" for number in range(5)]


def test_commands_of_the_simulation_page_run(place):
    for command in commands_in(SIMULATION):
        reported = run_here(place, command)
    assert "points[0]" in reported
    (code,) = re.findall(r"```python\n(.*?)```", SIMULATION, re.DOTALL)
    reported = run_code_here(place, code)
    assert "absorption True" in reported
    assert reported.endswith("() ()\n")  # No missed reflector and no ghost.


def test_gallery_starts_like_the_readme():
    gallery = page("gallery")
    assert set(commands_in(gallery)) <= set(commands_in(README))


@pytest.mark.parametrize("name", PAGES)
def test_files_named_on_pages_exist(name):
    path = ROOT / name
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        assert "://" in target or (path.parent / target).exists(), target


@pytest.mark.parametrize(
    "name",
    ["docs/tutorial/tour.md", "docs/tutorial/quickstart.md", "docs/how-to/network.md", "docs/how-to/applications.md"],
)
def test_emulator_blocks_can_be_pasted_unchanged(name):
    """Pasted commands run before the emulator is ready, so each block waits for its sensor."""
    blocks = [block for block in (ROOT / name).read_text().split("```") if "$ ertis sensors emulate" in block]
    assert blocks
    for block in blocks:
        _, *after = re.findall(r"^\$ ertis (?:sensors emulate .*|capture .*|sensors list)$", block, re.MULTILINE)
        assert "capture" in after[0]
        assert "--wait" in after[0]


def test_network_blocks_give_the_mounting_of_their_sensors():
    for path in ("docs/tutorial/tour.md", "docs/how-to/network.md", "docs/how-to/applications.md"):
        (captured,) = re.findall(r"^\$ ertis capture .*--to .*$", (ROOT / path).read_text(), re.MULTILINE)
        assert "--mounting platform.toml" in captured

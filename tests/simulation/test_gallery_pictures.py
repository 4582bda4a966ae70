"""Pictures of the gallery are the outputs of the commands beside them."""

import re

import numpy as np
import pytest
from PIL import Image

from ertis_numba.simulation import load_scene
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import write_recording
from tests.pages import DOCS, page, run_here

PICTURES = DOCS / "pictures" / "gallery"
PICTURE, COMMAND = re.compile(r"!\[[\w ]+\]\(\.\./pictures/gallery/(\w+)\.png\)"), re.compile(r"`(ertis plot [^`]+)`")
WITHOUT = dict(re.findall(r"\(`grep -v (\w+ \w+)\.toml > (\w+)\.toml`\)", page("gallery")))
COMMANDS = dict(
    zip(PICTURE.findall(page("gallery")), COMMAND.findall(page("gallery").partition("<!-- scene")[2]), strict=True)
)
SCENES = sorted({command.split()[2].partition(".")[0] for command in COMMANDS.values()})
BLOCK_PX = 12


def test_every_picture_has_its_command():
    assert {path.stem for path in PICTURES.iterdir()} == COMMANDS.keys()
    assert all(re.fullmatch(rf"{COMMANDS[name].split()[2].partition('.')[0]}(_\d)?", name) for name in COMMANDS)


def write_scene(name, folder):
    """Write a scene as the page describes."""
    for words, target in WITHOUT.items():
        if name == target:
            word, origin = words.split()
            run_here(folder, f"example {origin}")
            lines = (folder / f"{origin}.toml").read_text("utf-8").splitlines(keepends=True)
            (folder / f"{name}.toml").write_text("".join(line for line in lines if word not in line), "utf-8")
            return
    run_here(folder, f"example {name}")


def write_measurements(name, folder, shown):
    """Write a recording of some measurements of the scene, given the sensor and the number of each; no others matter.

    `ertis simulate` would render several times as many.
    """
    scene = load_scene(folder / f"{name}.toml").replace(count=1 + max(number for _, number in shown))
    simulators = {sensor: Simulator(scene, sensor=sensor) for sensor in {sensor for sensor, _ in shown}}
    write_recording(folder / f"{name}.h5", [simulators[sensor].render(number) for sensor, number in shown])


@pytest.mark.parametrize("scene", SCENES)
def test_pictures_are_the_outputs_of_their_commands(scene, tmp_path):
    commands = {name: command for name, command in COMMANDS.items() if f" {scene}.energy.h5" in command}
    options = {name: dict(re.findall(r"--(sensor|measurement) (\w+)", command)) for name, command in commands.items()}
    places = {name: (each.get("sensor"), int(each.get("measurement", 0))) for name, each in options.items()}
    shown = sorted({*places.values()}, key=str)
    write_scene(scene, tmp_path)
    write_measurements(scene, tmp_path, shown)
    run_here(tmp_path, f"process {scene}.h5 --quiet")
    for name, command in commands.items():
        sensor, number = places[name]
        stored = [each for each in shown if each[0] == sensor].index((sensor, number))
        words = command.removeprefix("ertis ").replace(f"--measurement {number}", f"--measurement {stored}")
        run_here(tmp_path, f"{words} -o {name}.png")
        kept, drawn = (Image.open(folder / f"{name}.png").convert("L") for folder in (PICTURES, tmp_path))
        size = kept.width // BLOCK_PX, kept.height // BLOCK_PX
        first, second = (np.asarray(each.resize(size, Image.Resampling.BOX), float) for each in (kept, drawn))
        assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.995, name
        assert np.corrcoef(first.ravel(), second[:, ::-1].ravel())[0, 1] < 0.6, name

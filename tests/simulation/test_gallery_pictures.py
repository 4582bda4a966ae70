"""Pictures of the gallery are the outputs of the commands beside them."""

import re

import numpy as np
import pytest
from PIL import Image

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


@pytest.mark.parametrize("scene", SCENES)
def test_pictures_are_the_outputs_of_their_commands(scene, tmp_path):
    commands = {name: command for name, command in COMMANDS.items() if f" {scene}.energy.h5" in command}
    write_scene(scene, tmp_path)
    count = 1 + max(
        int(word) for command in commands.values() for word in re.findall(r"--measurement (\d+)", command) or [0]
    )
    sensors = {word for command in commands.values() for word in re.findall(r"--sensor (\w+)", command)}
    only = f"--sensor {sensors.pop()}" if len(sensors) == 1 else ""
    run_here(tmp_path, f"simulate {scene}.toml --count {count} --quiet {only}")
    run_here(tmp_path, f"process {scene}.h5 --quiet")
    for name, command in commands.items():
        run_here(tmp_path, f"{command.removeprefix('ertis ')} -o {name}.png")
        kept, drawn = (Image.open(folder / f"{name}.png").convert("L") for folder in (PICTURES, tmp_path))
        size = kept.width // BLOCK_PX, kept.height // BLOCK_PX
        first, second = (np.asarray(each.resize(size, Image.Resampling.BOX), float) for each in (kept, drawn))
        assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.995, name
        assert np.corrcoef(first.ravel(), second[:, ::-1].ravel())[0, 1] < 0.6, name

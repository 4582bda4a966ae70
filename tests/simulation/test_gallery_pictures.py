"""Pictures of the gallery are the outputs of the commands below them."""

import re

import numpy as np
import pytest
from PIL import Image

from tests.pages import DOCS, page, run_here

COMMANDS = dict(re.findall(r"\.\./pictures/gallery/(\w+)\.png\)\n\n(?:!.*\n\n)?`(ertis plot [^`]*)`", page("gallery")))
BLOCK = 12  # pixels
PROCESSED = ("faulty_array", "moving_platform", "two_facing_sensors")
"""Scenes whose first measurement is simulated and processed in seconds."""


def test_every_scene_has_its_command():
    shown = {path.stem for path in (DOCS / "pictures" / "gallery").iterdir()}
    assert {name for name in shown if not name.endswith("_healthy")} == {
        re.match(r"ertis plot (\w+)\.energy\.h5", command)[1] for command in COMMANDS.values()
    }


@pytest.mark.parametrize("name", PROCESSED)
def test_picture_is_the_output_of_its_command(name, tmp_path):
    (command,) = (each for each in COMMANDS.values() if f" {name}.energy.h5" in each)
    for line in (f"example {name}", f"simulate {name}.toml --count 1 --quiet", f"process {name}.h5 --quiet"):
        run_here(tmp_path, line)
    run_here(tmp_path, f"{command.removeprefix('ertis ')} -o drawn.png")
    kept = Image.open(DOCS / "pictures" / "gallery" / f"{name}.png").convert("L")
    drawn = Image.open(tmp_path / "drawn.png").convert("L")
    # The first of pictures side by side lacks its colour bar and its list. Both are compared in blocks.
    width = round(drawn.width * kept.height / drawn.height)
    box = (0, 0, round(0.75 * width), kept.height)
    size = (box[2] // BLOCK, box[3] // BLOCK)
    again = drawn.resize((width, kept.height), Image.Resampling.BOX)
    first, second = (np.asarray(each.crop(box).resize(size, Image.Resampling.BOX), float) for each in (kept, again))
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.95
    assert np.corrcoef(first.ravel(), second[:, ::-1].ravel())[0, 1] < 0.6

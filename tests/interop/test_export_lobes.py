"""Side lobes as points, as docs/how-to/export.md describes them, with eight microphones on a ring."""

import csv
import math

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

SCENE = """
seed = 1

[[sensors]]
array.layout = "ring"
array.word_bits = 8
array.positions_m = {positions}
processing.directions = "2d:181"

[[points]]
azimuth_deg = -38.0
range_m = 1.15
strength_db = -24.0

[[points]]
azimuth_deg = 22.5
range_m = 1.6
strength_db = -18.0
"""
RADIUS_M = 0.02


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lobes")
    turns = [2 * math.pi * mic / 8 for mic in range(8)]
    positions = [[0.0, RADIUS_M * math.cos(turn), RADIUS_M * math.sin(turn)] for turn in turns]
    (folder / "ring.toml").write_text(SCENE.format(positions=positions))
    done = CliRunner().invoke(cli, ["simulate", str(folder / "ring.toml"), "-o", str(folder / "ring.h5")])
    assert done.exit_code == 0, done.output
    return folder / "ring.h5"


def points(recording, tmp_path, *options):
    target = tmp_path / "points.csv"
    done = CliRunner().invoke(cli, ["export", str(recording), "-o", str(target), *options])
    assert done.exit_code == 0, done.output
    with target.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_reflectors_have_small_uncertainty_and_side_lobes_that_of_no_echo(recording, tmp_path):
    found = points(recording, tmp_path)
    strongest = sorted(found, key=lambda row: -float(row["amplitude"]))
    reflectors, lobes = strongest[:2], strongest[2:]
    assert len(lobes) >= 4
    assert max(float(row["uncertainty_range_m"]) for row in reflectors) < 1e-4
    assert min(float(row["uncertainty_range_m"]) for row in lobes) > 1e-3


@pytest.mark.parametrize("options", [["--min-level", "-5"], ["--top", "2"]])
def test_options_omit_side_lobes(recording, tmp_path, options):
    found = points(recording, tmp_path, *options)
    ranges_m = sorted(math.hypot(*(float(row[name]) for name in ("x_m", "y_m", "z_m"))) for row in found)
    assert ranges_m == pytest.approx([1.15, 1.6], abs=0.01)

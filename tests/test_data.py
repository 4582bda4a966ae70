"""The shipped recordings: what they hold, that they can be made again, and that they show their reflectors."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import Scene, load_scene, true_peaks
from ertis_numba.simulation.render import render
from ertis_numba.stages.detect import find_peaks
from ertis_numba.storage import open_recording

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "data" / "synthetic"
NAMES = ("line", "reflectors", "reflectors_3d")


def test_all_scenes_are_built_and_small():
    assert {path.stem for path in FOLDER.glob("*.toml")} == set(NAMES)
    assert sum(path.stat().st_size for path in FOLDER.iterdir() if path.is_file()) < 3e6


def test_sums():
    lines = (FOLDER / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in (line.split("  ") for line in lines)}
    assert set(sums) == {f"{name}.{kind}" for name in NAMES for kind in ("h5", "json", "toml")}
    for name, digest in sums.items():
        assert hashlib.sha256((FOLDER / name).read_bytes()).hexdigest() == digest, f"{name}: run make data"


@pytest.mark.parametrize("name", NAMES)
def test_recording_is_its_scene(name):
    scene = load_scene(FOLDER / f"{name}.toml")
    report = json.loads((FOLDER / f"{name}.json").read_text())
    with open_recording(FOLDER / f"{name}.h5") as recording:
        (measurement,) = recording
        truth = recording.truth
    assert_array_equal(measurement.words, render(scene).words)
    assert hashlib.sha256(measurement.words.tobytes()).hexdigest() == report["words_sha256"]
    assert Scene.from_toml(truth.scene) == scene
    assert (truth.seed, report["seed"]) == (scene.seed, scene.seed)
    reflectors = report["reflectors"]
    assert [reflector["range_m"] for reflector in reflectors] == [peak.range_m for peak in true_peaks(scene)]
    for field, stored in {
        "azimuth_deg": np.degrees(truth.azimuth_rad),
        "elevation_deg": np.degrees(truth.elevation_rad),
        "range_m": truth.range_m,
        "level_db": truth.level_db,
    }.items():
        assert_allclose(stored, [[reflector[field] for reflector in reflectors]], atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("method", ["fast", "paper"])
def test_recording_shows_its_reflectors(name, method):
    """Places and levels below the strongest; the paper's far field and integer delays cost a little."""
    with open_recording(FOLDER / f"{name}.h5") as recording:
        settings = recording.settings.replace(processing=recording.settings.processing.replace(method=method))
        image = Pipeline(settings).process(recording[0])
    found = find_peaks(image, top=None)
    expected = json.loads((FOLDER / f"{name}.json").read_text())["reflectors"]
    angle_deg, range_m, level_db = (0.2, 0.001, 0.3) if method == "fast" else (2.0, 0.01, 1.0)
    for wanted in expected:
        near = min(found, key=lambda peak: abs(peak.range_m - wanted["range_m"]) - peak.level_db / 100)
        assert abs(near.azimuth_deg - wanted["azimuth_deg"]) < angle_deg
        assert abs(near.elevation_deg - wanted["elevation_deg"]) < angle_deg
        assert abs(near.range_m - wanted["range_m"]) < range_m
        assert abs(near.level_db - wanted["level_db"]) < level_db
    if method == "fast":
        assert len(find_peaks(image)) == len(expected)  # one entry per reflector, none for a side lobe
    strongest = sorted(peak.range_m for peak in found[: len(expected)])
    assert_allclose(strongest, sorted(wanted["range_m"] for wanted in expected), atol=range_m)


def test_make_data_makes_the_same_words(tmp_path):
    paths = os.pathsep.join(str(ROOT / folder) for folder in (".", "cli"))
    subprocess.run(
        [sys.executable, str(FOLDER / "build.py"), str(tmp_path)], env=os.environ | {"PYTHONPATH": paths}, check=True
    )
    for name in NAMES:
        assert (tmp_path / f"{name}.json").read_text() == (FOLDER / f"{name}.json").read_text()
    sums = (tmp_path / "SHA256SUMS").read_text().splitlines()
    assert {line.split("  ")[1] for line in sums} == {f"{name}.{kind}" for name in NAMES for kind in ("h5", "json")}

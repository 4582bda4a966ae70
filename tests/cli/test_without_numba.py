"""Functions that work without Numba and llvmlite, tried in processes that cannot import either."""

import configparser
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

import ertis_numba as ertis
from tests.pages import ROOT, command_program, commands_in, forking, page

BLOCKED = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        root = name.partition(".")[0]
        if root in {"numba", "llvmlite"}:
            raise ModuleNotFoundError(f"No module named {root!r}", name=root)

sys.meta_path.insert(0, Blocked())
"""
COMMANDS = """
ertis process reflectors.h5 -o images.h5 --device numpy
ertis process reflectors.h5 -o auto.h5
ertis peaks images.h5 --top 5
ertis plot images.h5 -o image.png
ertis export images.h5 -o image.ply
ertis info reflectors.h5 --health
"""
POINTS = """
import sys
import ertis_numba as ertis
import numpy as np

recording = ertis.open_recording("reflectors.h5")
pipeline = ertis.Pipeline(recording.settings, device="numpy")
cloud = ertis.PointExtractor(recording.settings)(pipeline.process(recording[0]))
np.savez("points.npz", range_m=cloud.range_m, azimuth_rad=cloud.azimuth_rad, uncertainty_m=cloud.uncertainty_m)
assert "numba" not in sys.modules
"""


@pytest.fixture(scope="module")
def run_forked(tmp_path_factory):
    """Run programs that cannot import Numba in the folder of the module."""
    preload = ("numpy", "scipy.fft", "scipy.spatial", "h5py", "click", "msgspec")
    folder = tmp_path_factory.mktemp("without_numba")
    with forking(folder, tmp_path_factory.mktemp("output"), preload, unloaded=("numba", "llvmlite")) as run_forked:
        yield folder, lambda program: run_forked(BLOCKED + program)


@pytest.fixture(scope="module")
def place(run_forked):
    """Return a folder with the results of all commands, and the texts that they printed to stderr."""
    folder, run = run_forked
    texts = {}
    for line in ("ertis example reflectors", *COMMANDS.strip().splitlines()):
        done = run(command_program(line.split()[1:]))
        assert done.code == 0, done.stderr
        texts[line] = done.stderr
    done = run(POINTS)
    assert done.code == 0, done.stderr
    return folder, texts


def test_commands_without_numba_process_a_scene_as_compiled_kernels_do(place):
    folder, _ = place
    (image,), (automatic,) = (ertis.open_energyscapes(folder / name) for name in ("images.h5", "auto.h5"))
    np.testing.assert_array_equal(image.amplitude, automatic.amplitude)
    with ertis.open_recording(folder / "reflectors.h5") as recording:
        (measurement,) = recording
    compiled = ertis.Pipeline(image.settings, device="cpu").process(measurement)
    assert np.abs(image.amplitude - compiled.amplitude).max() < 1e-3 * image.amplitude.max()
    assert (measurement.data == ertis.render(ertis.load_scene(folder / "reflectors.toml")).data).mean() > 0.99
    assert (folder / "image.png").stat().st_size
    assert (folder / "image.ply").stat().st_size


def test_points_without_numba_are_at_the_reflectors_of_the_scene(place):
    folder, _ = place
    found = np.load(folder / "points.npz")
    for azimuth_deg, range_m in ((-38, 1.15), (22.5, 1.6), (-8.3, 2.45), (51, 3.3), (-21.7, 4.4)):
        across_m = range_m * (found["azimuth_rad"] - np.radians(azimuth_deg))
        errors = np.stack([found["range_m"] - range_m, across_m], axis=1) / found["uncertainty_m"]
        assert np.abs(errors).max(axis=1).min() < 4


def test_each_command_that_chooses_numpy_by_itself_says_so_once(place):
    _, texts = place
    for line, text in texts.items():
        warned = text.count("NumPy replaces Numba, which cannot be imported (No module named 'numba')")
        assert warned == ("example" in line or "auto.h5" in line), line


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("process reflectors.h5 -o no.h5 --device cpu", "devices 'cpu' and 'cuda' need Numba"),
        ("demo", "'ertis demo', which renders 120 measurements, needs Numba"),
        ("bench paper", "'ertis bench' needs Numba"),
    ],
)
@pytest.mark.usefixtures("place")
def test_a_command_that_needs_numba_ends_with_one_line(run_forked, line, message):
    done = run_forked[1](command_program(line.split()))
    assert done.code == 1
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert "install it with 'pip install numba'" in done.stderr


def test_doctor_notes_a_missing_numba(run_forked):
    done = run_forked[1](command_program(["doctor", "--json"]))
    found = {each["check"]: each for each in json.loads(done.stdout)["findings"]}
    assert found["Numba"]["state"] == "note"
    assert found["processing"]["state"] == "good"
    assert "processor" not in found


def test_install_page_names_all_dependencies_but_numba_and_commands_that_run_without_it(place):
    text = page("install")
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    needed = [each.partition(">")[0] for each in config["options"]["install_requires"].split()]
    (listed,) = re.findall(r"pip install (click .*)", text)
    assert listed.split() == [each for each in needed if each != "numba"]
    _, texts = place
    commands = commands_in(text.partition("## Without Numba")[2])
    assert [f"ertis {each}" for each in commands] == list(texts)[:2]


def test_broken_numba_counts_as_missing_and_the_error_names_the_reason(tmp_path):
    (tmp_path / "numba.py").write_text("raise ImportError('Numba needs NumPy 2.3 or less')")
    code = "from ertis_numba import kernels; print(kernels.load('auto').device); kernels.load('cpu')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "numpy\n"
    assert "cannot be imported (Numba needs NumPy 2.3 or less); install it" in done.stderr.splitlines()[-1]

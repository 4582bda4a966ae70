"""The examples of ``docs/how-to/numpy.md`` run, and are short."""

import ast
import re
import subprocess
import sys

import numpy as np
import pytest

from ertis_numba.analysis.compare import compare
from ertis_numba.storage import open_recording
from tests.pages import ROOT, commands_in, page, python_in, run_code_here

PAGE = page("numpy")
EXAMPLES = python_in(PAGE)
RECORDING = ROOT / "data" / "synthetic" / "reflectors.h5"


@pytest.fixture
def place(tmp_path):
    (tmp_path / "reflectors.h5").symlink_to(RECORDING)
    return tmp_path


def test_page_has_short_examples():
    assert commands_in(PAGE) == ["example reflectors"]  # writes the recording of the other tests
    assert len(EXAMPLES) == 6
    assert max(len(example.splitlines()) for example in EXAMPLES) <= 12
    assert max(map(len, "".join(EXAMPLES).splitlines())) <= 120


@pytest.mark.parametrize("number", range(5))
def test_page_examples_run(place, number):
    code = "import matplotlib; matplotlib.use('Agg')\n" + EXAMPLES[number]
    shown = run_code_here(place, code)
    if number == 1:
        assert (place / "numpy.png").stat().st_size > 10_000
    if number == 2:
        with open_recording(RECORDING) as recording:
            assert len(re.findall(r"measurement \d+: -?\d+\.\d dBFS", shown)) == len(recording)
    if number == 4:
        with open_recording(RECORDING) as recording, np.load(place / "beams.npz", allow_pickle=False) as data:
            assert data["beam"].shape == (len(recording), len(data["azimuth_rad"]), len(data["range_m"]))


def test_own_beamformer_finds_the_reflectors(place):
    """Its image agrees with an image of the pipeline."""
    code = EXAMPLES[0] + (
        "from ertis_numba.storage import write_energyscapes\n"
        "near = (signals.range_m >= 0.5) & (signals.range_m <= 5)\n"
        "made = ertis.Pipeline(signals.settings).process(recording_of(0))\n"
        "made = made.replace(amplitude=image[:, near].astype('f4'), azimuth_rad=azimuth_rad,\n"
        "                    elevation_rad=0 * azimuth_rad, range_m=signals.range_m[near])\n"
        "write_energyscapes('own.h5', [made])\n"
    )
    before = (
        "import ertis_numba\n"
        "def recording_of(index):\n"
        "    with ertis_numba.open_recording('reflectors.h5') as recording:\n"
        "        return recording[index]\n"
    )
    run_code_here(place, before + code)
    from ertis_numba.storage import open_energyscapes  # noqa: PLC0415

    with open_recording(RECORDING) as recording, open_energyscapes(place / "own.h5") as images:
        found = compare(images[0], recording.truth.reflectors[0], min_level_db=-20)
    assert len(found.matched) >= 3
    assert not found.missed


def test_page_example_of_workers_runs_as_a_script(place):
    (place / "script.py").write_text(EXAMPLES[5])
    done = subprocess.run([sys.executable, "script.py"], cwd=place, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(ast.literal_eval(done.stdout)) == 2

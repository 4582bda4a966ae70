"""Promised processor times and sizes of whole processes. The best of a few runs counts, because caches are shared."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import unit_vectors
from ertis_numba.settings import Processing, Recording, Settings
from tests import reference
from tests.cases import noise
from tests.promises import best_ratio
from tests.simulation.test_real import RAW

ERTIS = [sys.executable, "-m", "ertis_cli"]


def ratio(command, *, times, promised, **options):
    """Return the least processor time of some runs relative to the imports, and the output of the last one."""
    stated = []

    def once():
        done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=True, **options)
        stated.append(done.stderr)

    return best_ratio(once, times=times, promised=promised), stated[-1]


@pytest.fixture(autouse=True)
def _environment_of_a_user(monkeypatch):
    """Give child processes the threads of BLAS that users have.

    Tests that import ``ertis bench`` set one thread for it, which takes a third off the imports, and nothing off other
    commands.
    """
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """One default measurement."""
    path = tmp_path_factory.mktemp("figures") / "recording.h5"
    ertis.write_recording(path, [noise(Settings.from_preset("default_25_50"))])
    return path


def test_help_takes_less_time_than_importing_the_libraries():
    assert ratio([*ERTIS, "--help"], times=5, promised=0.75)[0] < 0.75


@pytest.mark.alone
def test_warm_process_of_one_measurement_takes_less_time_than_four_imports(recording, tmp_path):
    """One thread, because threads that wait for each other on a busy machine use processor time."""
    command = [*ERTIS, "process", recording, "-o", tmp_path / "image.h5", "--directions", "3000", "--threads", "1"]
    assert ratio([*command, "--force"], times=6, promised=3.75)[0] < 3.75


@pytest.mark.alone
def test_first_run_takes_less_time_than_30_imports_and_reports_compilation(recording, tmp_path):
    for run in ("first", "again"):  # nothing of the first one is left to the other
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / run)}
        command = [*ERTIS, "process", recording, "-o", tmp_path / f"{run}.h5", "--directions", "3000"]
        found, stated = ratio(command, times=1, promised=30, env=environment)
        assert "a first run compiles kernels" in stated
        if found < 30:
            break
    assert found < 30
    with ertis.open_energyscapes(tmp_path / f"{run}.h5") as images, ertis.open_recording(recording) as measurements:
        (given,) = measurements
        settings = given.settings.replace(processing=given.settings.processing.replace(directions="3000"))
        again = ertis.Pipeline(settings).process(Measurement(given.data, settings))
        assert again.amplitude.tobytes() == images[0].amplitude.tobytes()  # kernels of this process are from a cache


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux says how large a process ever was")
def test_memory_is_independent_of_the_recording_length(tmp_path):
    """220 long measurements are 460 MB; using half of that would be too much."""
    settings = Settings.from_preset("default_25_50").replace(
        recording=Recording(n_samples=2**19), processing=Processing(directions="2d:5", range_m=(0.5, 1.0))
    )
    words = noise(settings).data
    path = tmp_path / "long.h5"
    ertis.write_recording(path, (Measurement(words, settings, Stamp(sequence=n)) for n in range(220)))
    code = (
        "import sys; from ertis_cli.main import cli\n"
        "try: cli.main(sys.argv[1:])\n"
        "finally: print(open('/proc/self/status').read(), file=sys.stderr)"
    )
    command = [sys.executable, "-c", code, "process", str(path), "-o", str(tmp_path / "image.h5"), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    # Not getrusage: what it says begins with the size of the process that started this one.
    (peak_kb,) = re.findall(r"VmHWM:\s+(\d+) kB", done.stderr)
    assert int(peak_kb) * 1024 < 400e6


@pytest.fixture(scope="module", params=["2d:181", "3000"])
def real(request):
    """The real measurement, and the exact image of some directions of a grid."""
    settings = Settings.from_preset("default_25_50")
    settings = settings.replace(processing=settings.processing.replace(directions=request.param, wavefront="plane"))
    measurement = Measurement(np.fromfile(RAW, dtype="<u4"), settings)
    axes = ertis.Pipeline(settings, predict=False)
    some = np.unique(np.linspace(0, len(axes.grid) - 1, 24).astype(int))
    directions = unit_vectors(axes.grid.azimuth_rad[some], axes.grid.elevation_rad[some])
    return measurement, some, reference.exact(measurement.data, settings, directions, axes.range_m)


@pytest.mark.usefixtures("sound_unchecked")
@pytest.mark.parametrize("budget", ["draft", "standard", "fine", "exact"])
def test_images_of_the_real_measurement_keep_their_budget(real, budget):
    """Plans without knowledge of the signals keep their budget; 'standard' is that of the default settings."""
    measurement, some, exact = real
    budget_db = {"draft": -20, "standard": -35, "fine": -60, "exact": -100}[budget]
    pipeline = ertis.Pipeline(measurement.settings, max_error_db=None if budget == "standard" else budget_db)
    image = pipeline.process(measurement).amplitude[some]
    assert reference.error_db(image, exact) < budget_db

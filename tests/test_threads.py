"""Bits do not depend on the number of threads: the whole chain, in a process that has four."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import hashlib, sys
from ertis_numba.pipeline import Pipeline
from tests.cases import SHORT, noise
processing = SHORT.processing.replace(directions="3d:700", precision=sys.argv[1])
settings = SHORT.replace(processing=processing)
for threads in (1, 2, 3, 4):
    image = Pipeline(settings, threads=threads).process(noise(settings))
    print(hashlib.sha256(image.energy.tobytes()).hexdigest())
"""


def digests(precision, **environment):
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])} | environment
    command = [sys.executable, "-c", CODE, precision]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if "no 16-bit dot product" in done.stderr:
        pytest.skip("this processor has no 16-bit dot product (AVX-512 VNNI or AVX-VNNI)")
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize("precision", ["float32", "int16"])
def test_any_number_of_threads_gives_the_same_bits(precision):
    found = digests(precision, NUMBA_NUM_THREADS="4")
    assert len(found) == 4
    assert len(set(found)) == 1


def test_layer_without_reentrance_gives_the_same_bits():
    """Numba falls back to its workqueue where there is neither OpenMP nor TBB."""
    usual = digests("float32", NUMBA_NUM_THREADS="4")
    assert digests("float32", NUMBA_NUM_THREADS="4", NUMBA_THREADING_LAYER="workqueue") == usual


def test_what_numba_cannot_do_is_said_in_a_line():
    code = "from ertis_numba import kernels; kernels.load('cpu')"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert re.search("DeviceError: NUMBA_DISABLE_JIT is set, .* use device 'numpy'", done.stderr.splitlines()[-1])


def test_processor_with_fewer_features_is_served(tmp_path):
    """Numba may be told to compile for an older processor; what that lacks is not used."""
    older = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_NUM_THREADS": "4"}
    assert len(set(digests("auto", **older))) == 1

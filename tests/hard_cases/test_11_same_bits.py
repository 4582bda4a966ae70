"""The same bits whatever the threads, the processor and the way through a file; devices agree within a stated bound."""

import functools
import hashlib
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.frames import Stamp
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Settings
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from tests import reference
from tests.cases import CASES, SHORT, noise
from tests.hard_cases.tuned import tuned

CODE = """
import hashlib, sys
from ertis_numba.pipeline import Pipeline
from tests.cases import SHORT, noise
from tests.hard_cases.tuned import tuned
settings = SHORT.replace(processing=SHORT.processing.replace(directions="3d:700"))
settings = tuned(settings, precision=sys.argv[1])
for threads in (1, 2, 3, 4):
    image = Pipeline(settings, threads=threads).process(noise(settings))
    print(hashlib.sha256(image.amplitude.tobytes()).hexdigest())
"""

MODULATE = """
import hashlib, sys
import numpy as np
from ertis_numba import kernels
cpu, random = kernels.load(sys.argv[1]), np.random.default_rng(1)
signals, keys = random.uniform(-0.6, 0.6, (37, 2000)), random.integers(0, 2**64, 37, np.uint64)
mics = np.append(np.arange(37, dtype=np.int32), [-1] * 11).astype(np.int32).reshape(6, 8)
loop = np.array([0.8, 0.4, 0.2, 0.1, 0.02, 0.1, 0.5, 2.0])
for threads in range(1, cpu.max_threads + 1):
    octets, states = np.empty((2000, 6), np.uint8), np.zeros((37, 4))
    with cpu.threads(threads):
        cpu.modulate_pdm(signals, mics, keys, np.linspace(0, 0.1, 37), states, loop, 0, octets)
    print(hashlib.sha256(octets.tobytes() + states.tobytes()).hexdigest())
"""

COMBINE = """
import hashlib
import numpy as np
from ertis_numba import kernels
cpu, random = kernels.load("cpu"), np.random.default_rng(1)
noise = lambda *shape: (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(np.complex64)
signals, weights, first = noise(32, 2, 400), noise(20, 32), random.integers(0, 100, (20, 32))
offsets = (np.arange(32) * 800 + first).astype(np.int32)
for kernel, given in ((cpu.combine_dmas, (2,)), (cpu.combine_coherence, ()), (cpu.combine_capon, (3, 0.1))):
    out = np.empty((20, 300), np.float32)
    kernel(signals, offsets, weights, *given, out)
    print(hashlib.sha256(out.tobytes()).hexdigest())
short, folded = np.empty((20, 40), np.float32), np.empty((32, 2, 64), np.complex64)
cpu.delay_and_sum_envelope(signals, offsets, weights, 0, 40, short)
cpu.multiply_and_fold(signals[:, 0].copy(), noise(1, 2, 90), 5, folded)
print(hashlib.sha256(short.tobytes() + folded.tobytes()).hexdigest())
"""


def digests(argument, code=CODE, **environment):
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])} | environment
    command = [sys.executable, "-c", code, argument]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if argument == "int16" and "no 16-bit dot product" in done.stderr:
        pytest.skip("this processor has no 16-bit dot product (AVX-512 VNNI or AVX-VNNI)")
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize("precision", ["float32", "auto"])
def test_same_bits_for_one_and_two_threads(precision):
    """Of directions and ranges that do not fill the last tile."""
    settings = Settings.from_preset("short_25_50").replace(
        processing=Processing(directions="3d:301", range_m=(0.5, 1.5))
    )
    settings = tuned(settings, precision=precision)
    images = [Pipeline(settings, threads=n).process(noise(settings)).amplitude for n in (1, 2)]
    assert images[0].tobytes() == images[1].tobytes()


@functools.cache
def usual_digests(precision):
    return digests(precision, NUMBA_NUM_THREADS="4")


@pytest.mark.parametrize("precision", ["float32", "int16"])
def test_results_are_independent_of_the_number_of_threads(precision):
    found = usual_digests(precision)
    assert len(found) == 4
    assert len(set(found)) == 1


def test_workqueue_threading_layer_gives_the_same_bits():
    """Numba falls back to its workqueue where there is neither OpenMP nor TBB."""
    found = digests("float32", NUMBA_NUM_THREADS="4", NUMBA_THREADING_LAYER="workqueue")
    assert found == usual_digests("float32")


def test_compiled_and_cached_kernels_give_the_same_bits(tmp_path):
    """A kernel from the cache is optimised once more; where its sums leave a choice, it may be taken the other way."""
    fresh, kept = (digests("", COMBINE, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2))
    assert len(fresh) == 4
    assert fresh == kept


def test_numba_limits_are_reported_in_one_line():
    code = "from ertis_numba import kernels; kernels.load('cpu')"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert re.search("DeviceError: NUMBA_DISABLE_JIT is set, .* use device 'numpy'", done.stderr.splitlines()[-1])


def test_processor_with_fewer_features_is_supported(tmp_path):
    """Numba may be told to compile for an older processor; what that lacks is not used."""
    older = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_NUM_THREADS": "4"}
    assert len(set(digests("auto", **older))) == 1


def test_modulators_give_the_same_bits_on_every_processor(tmp_path):
    """Without AVX, fused multiplication or an instruction that rounds; the states agree as well, to the last bit."""
    older = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path)}
    found = digests("cpu", MODULATE, NUMBA_NUM_THREADS="4")
    assert len(found) == 4
    assert set(found) == set(digests("cpu", MODULATE, NUMBA_NUM_THREADS="2", **older))
    assert set(found) == set(digests("numpy", MODULATE))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(("precision", "bound_db"), [("float32", -120), ("int16", -95)])
def test_devices_agree_within_rounding(name, precision, bound_db):
    """Numba and NumPy add up in other orders: -131 dB in float32 and -106 dB through 16 bits at the worst."""
    settings = tuned(CASES[name], precision=precision)
    if precision == "int16" and not all(kernels.load(device).tile_ranges for device in ("cpu", "numpy")):
        pytest.skip("this processor has no 16-bit dot product (AVX-512 VNNI or AVX-VNNI)")
    compiled = Pipeline(settings, device="cpu")
    plain = Pipeline(compiled.settings, device="numpy")  # by the same plan
    images = [pipeline.process(noise(settings)).amplitude for pipeline in (compiled, plain)]
    assert np.array_equal(*images) or reference.error_db(*images) < bound_db


def test_replay_of_a_file_gives_the_same_hash(tmp_path):
    """Live, from the recording, from a copy of the recording, and from the image's own file."""
    measurements = [replace(noise(SHORT, seed), stamp=Stamp(sequence=seed)) for seed in range(3)]

    def digest(images):
        return hashlib.sha256(b"".join(image.amplitude.tobytes() for image in images)).hexdigest()

    def replay(path):
        with open_recording(path) as recording:
            pipeline = Pipeline(recording.settings, threads=1)
            return [pipeline.process(measurement) for measurement in recording]

    live = Pipeline(SHORT)
    wanted = digest([live.process(measurement) for measurement in measurements])
    first = write_recording(tmp_path / "first.h5", measurements)
    with open_recording(first) as recording:
        second = write_recording(tmp_path / "second.h5", recording)
    write_energyscapes(tmp_path / "images.h5", replay(second))
    assert digest(replay(first)) == digest(replay(second)) == wanted
    with open_energyscapes(tmp_path / "images.h5") as images:
        assert digest(images) == wanted

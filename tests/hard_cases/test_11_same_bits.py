"""Bit-identical results for any number of threads, processor and file round trip; devices agree within a bound."""

import hashlib
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ertis_bench import instruction_sets

from ertis_numba.frames import Stamp
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Settings
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from tests import reference
from tests.cases import CASES, SHORT, noise
from tests.hard_cases.tuned import tuned

CODE = """
import hashlib, json, sys
import numpy as np
from ertis_numba import kernels
from ertis_numba.pipeline import Pipeline
from tests.cases import SHORT, noise
from tests.hard_cases.tuned import tuned

settings = SHORT.replace(processing=SHORT.processing.replace(directions="3d:700"))
cpu, random = kernels.load("cpu"), np.random.default_rng(1)


def digest(*arrays):
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def imaged(precision, threads):
    given = tuned(settings, precision=precision)
    return digest(Pipeline(given, threads=threads, predict=False).process(noise(given)).amplitude)


def modulated(device, threads):
    kernel_set, random = kernels.load(device), np.random.default_rng(1)
    signals, keys = random.uniform(-0.6, 0.6, (37, 2000)), random.integers(0, 2**64, 37, np.uint64)
    mics = np.append(np.arange(37, dtype=np.int32), [-1] * 11).astype(np.int32).reshape(6, 8)
    loop = np.array([0.8, 0.4, 0.2, 0.1, 0.02, 0.1, 0.5, 2.0])
    octets, states = np.empty((2000, 6), np.uint8), np.zeros((37, 4))
    with kernel_set.threads(threads):
        kernel_set.modulate_pdm(signals, mics, keys, np.linspace(0, 0.1, 37), states, loop, 0, octets)
    return digest(octets, states)


def whole_sums():
    random = np.random.default_rng(3)
    n_ranges, starts = 250, np.arange(0, 250, cpu.tile_ranges, dtype=np.int32)
    width = cpu.tile_ranges + 9
    tiles = random.integers(-4000, 4000, (len(starts), 32, 2, width, 2), np.int16)
    rows, first = random.integers(0, 64, (70, 64)), random.integers(0, 9, (70, 64))
    offsets, weights = (rows * width + first).astype(np.int32), random.integers(-900, 900, (70, 64, 2, 2), np.int16)
    places = np.repeat(random.integers(0, 29, (14, 8)), 5, axis=0).astype(np.int32)
    taps, order = random.integers(-8000, 8000, (70, 8, 2), np.int16), random.permutation(70).astype(np.int32)
    given = (tiles, np.float32(random.random(len(starts))), starts, n_ranges)
    outs = np.empty((2, 70, n_ranges), np.float32)
    cpu.delay_and_sum_envelope_int16(*given, offsets, weights, np.float32(1), outs[0])
    beams = (offsets[:30], weights[:30], places, taps, order)
    cpu.interpolated_beams_envelope_int16(*given, *beams, np.float32(1), 2, outs[1])
    return digest(outs)


def delayed_and_summed():
    signals = (random.standard_normal((32, 2, 400)) + 1j * random.standard_normal((32, 2, 400))).astype(np.complex64)
    weights = (random.standard_normal((20, 32)) + 1j * random.standard_normal((20, 32))).astype(np.complex64)
    offsets = (np.arange(32) * 800 + random.integers(0, 100, (20, 32))).astype(np.int32)
    envelope = np.empty((20, 40), np.float32)
    cpu.delay_and_sum_envelope(signals, offsets, weights, 0, 40, envelope)
    return digest(envelope)


def combined():
    def noise(*shape):
        return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(np.complex64)

    random = np.random.default_rng(2)
    signals, weights = noise(32, 2, 400), noise(20, 32)
    offsets = (np.arange(32) * 800 + random.integers(0, 100, (20, 32))).astype(np.int32)
    outs = np.empty((3, 20, 300), np.float32)
    outs[0] = 1
    cpu.weight_coherence(signals, offsets, weights, outs[0])
    cpu.combine_dmas(signals, offsets, weights, 2, outs[1])
    cpu.combine_capon(signals, offsets, weights, 3, 0.1, outs[2])
    return digest(outs)


found, counts = {}, range(1, cpu.max_threads + 1)
for name in sys.argv[1:]:
    if name == "delay_and_sum":
        found[name] = delayed_and_summed()
    elif name == "whole_sums":
        found[name] = whole_sums()
    elif name == "combined":
        found[name] = combined()
    elif name in {"cpu", "numpy"}:
        found[name] = [modulated(name, threads) for threads in (counts if name == "cpu" else (1,))]
    else:
        found[name] = [imaged(name, threads) for threads in counts]
print(json.dumps(found))
"""


def digests(*names, **environment):
    """Digests of results by name, from another process with 4 threads."""
    paths = {"PYTHONPATH": str(Path(__file__).parents[2]), "NUMBA_NUM_THREADS": "4"}
    command = [sys.executable, "-c", CODE, *names]
    done = subprocess.run(command, env=os.environ | paths | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def usual():
    """Digests of all results on this processor."""
    return digests("float32", "int16", "cpu", "numpy", "whole_sums", "delay_and_sum", "combined")


@pytest.fixture(scope="module")
def workqueue(usual):  # noqa: ARG001 - its process has filled the cache, so that this one compiles nothing
    """Digests with the threading layer that Numba falls back to without OpenMP and TBB."""
    return digests("float32", "delay_and_sum", "combined", NUMBA_THREADING_LAYER="workqueue")


@pytest.fixture(scope="module")
def older(tmp_path_factory):
    """Digests on an older processor, for which Numba can compile, without the features that it lacks."""
    cache = tmp_path_factory.mktemp("older")
    return digests("auto", "cpu", "whole_sums", NUMBA_CPU_NAME="generic", NUMBA_CACHE_DIR=str(cache))


@pytest.fixture(scope="module")
def avx2(tmp_path_factory):
    """Digest of the 16-bit sums without AVX-512."""
    if "AVX2" not in instruction_sets.lesser():
        pytest.skip("this processor has nothing beyond AVX2")
    restricted = instruction_sets.environment("AVX2")
    return digests("whole_sums", **restricted, NUMBA_CACHE_DIR=str(tmp_path_factory.mktemp("avx2")))


@pytest.mark.parametrize("precision", ["float32", "auto"])
def test_one_and_two_threads_give_the_same_bits(precision):
    """Directions and ranges do not fill the last tile."""
    settings = Settings.from_preset("short_25_50").replace(
        processing=Processing(directions="3d:301", range_m=(0.5, 1.5))
    )
    settings = tuned(settings, precision=precision)
    images = [Pipeline(settings, threads=n, predict=False).process(noise(settings)).amplitude for n in (1, 2)]
    assert images[0].tobytes() == images[1].tobytes()


@pytest.mark.parametrize("precision", ["float32", "int16"])
def test_results_are_independent_of_the_number_of_threads(usual, precision):
    assert len(usual[precision]) == 4
    assert len(set(usual[precision])) == 1


def test_workqueue_threading_layer_gives_the_same_bits(usual, workqueue):
    assert workqueue["float32"] == usual["float32"]


def test_compiled_and_cached_kernels_give_the_same_bits(workqueue, tmp_path):
    """Numba optimises a cached kernel once more, which could change the order of sums.

    The first run of a command compiles the kernels of the default chain, see tests/figures/test_figures_to_reach.py.
    """
    compiled = digests("delay_and_sum", "combined", NUMBA_CACHE_DIR=str(tmp_path))
    for name in ("delay_and_sum", "combined"):
        assert compiled[name] == workqueue[name]


def test_numba_limits_are_reported_in_one_line():
    code = "from ertis_numba import kernels; kernels.load('cpu')"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert re.search("DeviceError: NUMBA_DISABLE_JIT is set, .* use device 'numpy'", done.stderr.splitlines()[-1])


def test_processor_with_fewer_features_is_supported(older):
    assert len(older["auto"]) == 4
    assert len(set(older["auto"])) == 1


def test_modulators_give_the_same_bits_on_every_processor(usual, older):
    """Bits and states agree without AVX, fused multiply-add or a rounding instruction."""
    assert len(usual["cpu"]) == len(older["cpu"]) == 4
    assert set(usual["cpu"]) == set(older["cpu"]) == set(usual["numpy"])


@pytest.mark.parametrize("processor", ["avx2", "older"])
def test_whole_sums_have_the_same_bits_on_every_processor(usual, processor, request):
    """Registers, passes and instructions differ, but integers have no rounding."""
    assert request.getfixturevalue(processor)["whole_sums"] == usual["whole_sums"]


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(("precision", "bound_db"), [("float32", -120), ("int16", -95)])
def test_devices_agree_within_rounding(name, precision, bound_db):
    """Numba and NumPy add in different orders: -131 dB in float32 and -106 dB with 16 bits in the worst case."""
    settings = tuned(CASES[name], precision=precision)
    compiled = Pipeline(settings, device="cpu", predict=False)
    plain = Pipeline(compiled.settings, device="numpy", predict=False)  # the same plan
    images = [pipeline.process(noise(settings)).amplitude for pipeline in (compiled, plain)]
    assert np.array_equal(*images) or reference.error_db(*images) < bound_db


def test_replay_of_a_file_gives_the_same_hash(tmp_path):
    """Images are computed live, from a recording and from its copy, and read from an image file."""
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

"""The whole chain on the GPU or in the simulator, compared with the chain on the CPU."""

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.pipeline import Pipeline
from tests import reference
from tests.cases import noise
from tests.cuda.plans import PLANS, TINY


@pytest.fixture(scope="module", params=PLANS)
def pair(request):
    """Pipelines of one plan on CPU and GPU, and the largest difference of their images in dB."""
    settings, bound_db = PLANS[request.param]
    with Pipeline(settings, device="cuda") as cuda:
        yield Pipeline(settings, device="cpu"), cuda, bound_db


def test_gpu_image_equals_cpu_image(pair):
    cpu, cuda, bound_db = pair
    assert cuda.settings == cpu.settings
    measurement = noise(cuda.settings)
    images = [pipeline.process(measurement).amplitude for pipeline in (cpu, cuda)]
    assert images[0].any()
    assert np.array_equal(cuda.process(measurement).amplitude, images[1])  # a GPU replays a graph now
    assert np.array_equal(*images) or reference.error_db(*images) < bound_db


@pytest.mark.parametrize("plan", [plan for plan in PLANS if plan.split(",")[0] not in {"delay matrix", "rows"}])
def test_gpu_image_in_level_directions_equals_cpu_image(plan):
    """The GPU gets other tables for each image. Delay matrices and rows need fixed directions."""
    settings, bound_db = PLANS[plan]
    settings = settings.replace(**{"processing.level_directions": True})
    measurement, turn = noise(settings), np.array([0.3, -0.4, 0.1, 1.0])
    turn /= np.linalg.norm(turn)
    with Pipeline(settings, device="cpu") as cpu, Pipeline(settings, device="cuda") as cuda:
        plain = cuda.process(measurement, attitude_xyzw=(0.0, 0.0, 0.0, 1.0)).amplitude
        images = [pipeline.process(measurement, attitude_xyzw=turn).amplitude for pipeline in (cpu, cuda)]
    assert not np.array_equal(plain, images[1])
    assert np.array_equal(*images) or reference.error_db(*images) < bound_db


@pytest.fixture(scope="module")
def cuda():
    with Pipeline(PLANS["float32"][0], device="cuda") as pipeline:
        yield pipeline


def test_batch_beyond_the_lanes_equals_single_measurements(cuda):
    measurements = [noise(cuda.settings, seed) for seed in range(4)]
    single = [cuda.process(measurement).amplitude.copy() for measurement in (measurements[0], measurements[3])]
    batch = [image.amplitude for image in cuda.process_batch(measurements)]
    assert [batch[0].tobytes(), batch[3].tobytes()] == [amplitude.tobytes() for amplitude in single]
    assert len({amplitude.tobytes() for amplitude in batch}) == 4


def test_image_is_written_to_the_given_array(cuda):
    out = np.full((len(cuda.grid), len(cuda.range_m)), -1.0, dtype=np.float32)
    measurement = noise(cuda.settings)
    assert cuda.process(measurement, out).amplitude is out
    assert (out == cuda.process(measurement).amplitude).all()


def test_gpu_signals_equal_cpu_signals():
    settings = PLANS["float32"][0]
    words = noise(settings).data.reshape(-1, 1)
    signals = 0.5 * np.random.default_rng(3).standard_normal((2, settings.recording.n_samples))
    found = {}
    for device in ("cpu", "cuda"):
        chain = FastChain(settings, kernels.load(device), threads=1)
        image, heard = chain.new_image(), chain.new_image()
        analytic, lead = chain.analytic(words)
        chain.process(words, image)
        chain.process_signals(signals, heard)
        found[device] = (analytic.view(np.float32), image, heard, lead)
    for mine, theirs in zip(found["cuda"][:3], found["cpu"][:3], strict=True):
        assert reference.error_db(theirs, mine) < -120
    assert found["cuda"][3] == found["cpu"][3]


def test_image_can_stay_on_the_gpu():
    settings = PLANS["float32"][0]
    chain = FastChain(settings, kernels.load("cuda"), threads=1)
    words = noise(settings).data.reshape(-1, 1)
    chain.process_batch([words, words], [None, None])
    image = chain.new_image()
    chain.process(words, image)
    assert image.any()


def test_plan_chosen_for_the_gpu_keeps_its_error_budget():
    """The simulator chooses by nominal costs, and the chosen plan still keeps its error budget."""
    with Pipeline(TINY.replace(accuracy=TINY.accuracy.replace(max_error_db=-50.0)), device="cuda") as pipeline:
        image = pipeline.process(noise(pipeline.settings)).amplitude
    exact = Pipeline(pipeline.settings.replace(accuracy=TINY.accuracy.replace(max_error_db=-100.0)), device="cpu")
    assert reference.error_db(exact.process(noise(exact.settings)).amplitude, image) < -50

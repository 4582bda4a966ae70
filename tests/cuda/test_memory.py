"""GPU memory of a pipeline: allocated once, freed by `close`, and reported with a remedy if it is too small."""

import gc
import threading
import weakref

import numpy as np
import pytest
from numba import cuda
from numba.cuda.cudadrv.driver import CudaAPIError

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError, DeviceError
from ertis_numba.kernels import _images
from ertis_numba.pipeline import Pipeline
from tests.cases import noise
from tests.cuda.plans import PLANS, TINY

SETTINGS = PLANS["float32, nodes"][0]
MAKERS = ("to_device", "device_array", "pinned_array")


@pytest.fixture
def made(monkeypatch):
    """Weak references to all device and pinned arrays created during the test."""
    found = []
    for name in MAKERS:
        make = getattr(cuda, name)

        def watched(*arguments, make=make, **options):
            array = make(*arguments, **options)
            found.append(weakref.ref(array))
            return array

        monkeypatch.setattr(cuda, name, watched)
    return found


def test_no_memory_is_allocated_after_the_first_measurement(made):
    with Pipeline(SETTINGS, device="cuda") as pipeline:
        images = pipeline.process_batch([noise(SETTINGS)] * 3)
        n_made = len(made)
        assert n_made > 10
        del images
        pipeline.process_batch([noise(SETTINGS)] * 2)
        assert len(made) == n_made


def test_close_frees_gpu_memory_without_garbage_collection(made):
    pipeline = Pipeline(SETTINGS, device="cuda")
    image = pipeline.process(noise(SETTINGS))
    before = image.amplitude.copy()
    gc.disable()
    try:
        pipeline.close()
        alive = [array for array in (reference() for reference in made) if array is not None]
    finally:
        gc.enable()
    assert len(alive) == 1  # the memory of the image that the test still holds
    assert (image.amplitude == before).all()


def test_several_pipelines_share_a_gpu():
    settings = [SETTINGS, PLANS["float32"][0]]
    with Pipeline(settings[0], device="cuda") as first, Pipeline(settings[1], device="cuda") as second:
        images = [pipeline.process(noise(TINY)).amplitude.copy() for pipeline in (first, second, first, second)]
    assert (images[0] == images[2]).all()
    assert (images[1] == images[3]).all()
    assert not (images[0] == images[1]).all()


@pytest.mark.parametrize("n_before", [0, 5])
def test_too_little_gpu_memory_is_reported_with_size_and_remedy(monkeypatch, n_before):
    left = [n_before]

    def full(array, *_, make=cuda.to_device):
        if not left[0]:
            raise CudaAPIError(2, "Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")
        left[0] -= 1
        return make(array)

    monkeypatch.setattr(cuda, "to_device", full)
    with pytest.raises(DeviceError) as caught:
        Pipeline(SETTINGS, device="cuda")
    text = str(caught.value)
    assert "\n" not in text
    assert "MB free, but this pipeline needs" in text
    assert "use fewer directions, a shorter processing.range_m or a lower accuracy.oversampling" in text


@pytest.mark.parametrize("use", [lambda lane, _: lane.send(np.zeros(5)), lambda _, memory: memory.image((3, 4))])
def test_unpinnable_memory_is_reported(monkeypatch, use):
    def full(*_):
        raise CudaAPIError(2, "CUDA_ERROR_OUT_OF_MEMORY")

    memory = kernels.load("cuda").memory()
    lane = memory.lane()
    monkeypatch.setattr(cuda, "pinned_array", full)
    with pytest.raises(DeviceError, match="the host cannot pin 0 MB for device 'cuda'; raise its limit"):
        use(lane, memory)
    monkeypatch.undo()
    assert [memory.image((3, 4)).shape for _ in range(9)] == [(3, 4)] * 9


def test_failed_allocation_is_freed_when_its_error_is_caught(monkeypatch, made):
    """A caller can then create a smaller pipeline in the exception handler."""
    left = [6]

    def full(array, *_, make=cuda.to_device):
        left[0] -= 1
        if left[0] < 0:
            raise CudaAPIError(2, "CUDA_ERROR_OUT_OF_MEMORY")
        return make(array)

    monkeypatch.setattr(cuda, "to_device", full)
    try:
        Pipeline(SETTINGS, device="cuda")
    except DeviceError:
        alive = [reference for reference in made if reference() is not None]
    assert len(made) == 6
    assert not alive


def test_close_waits_for_running_measurements():
    """The running measurement yields a complete image, and later measurements are refused."""
    pipeline = Pipeline(SETTINGS, device="cuda")
    expected = pipeline.process(noise(SETTINGS)).amplitude.copy()
    chain, begun, images = pipeline._chain, threading.Event(), []  # noqa: SLF001 - to close during processing
    finish = chain._finish  # noqa: SLF001

    def slow(buffers):
        begun.set()
        closing.join(0.2)  # `close` must not return before this measurement is finished
        assert closing.is_alive()
        finish(buffers)

    chain._finish = slow  # noqa: SLF001
    working = threading.Thread(target=lambda: images.append(pipeline.process(noise(SETTINGS)).amplitude))
    closing = threading.Thread(target=lambda: (begun.wait(), pipeline.close()))
    working.start()
    closing.start()
    working.join()
    closing.join()
    assert (images[0] == expected).all()
    with pytest.raises(ArgumentError, match="the pipeline is closed"):
        chain.process(noise(SETTINGS).data.reshape(-1, 1), images[0])


def test_other_driver_errors_are_not_hidden(monkeypatch):
    def broken(*_):
        raise CudaAPIError(700, "CUDA_ERROR_ILLEGAL_ADDRESS")

    monkeypatch.setattr(cuda, "to_device", broken)
    with pytest.raises(CudaAPIError):
        Pipeline(SETTINGS, device="cuda")


def test_image_memory_is_reused_once_no_view_of_it_exists():
    memory = kernels.load("cuda").memory()
    first = memory.image((3, 4))
    first[:] = 1
    row, place = first[1], first.__array_interface__["data"]
    del first
    second = memory.image((3, 4))
    second[:] = 2
    assert (row == 1).all()
    del row
    assert memory.image((3, 4)).__array_interface__["data"] == place
    assert (second == 2).all()


def test_number_of_pinned_images_is_limited(made, monkeypatch):
    monkeypatch.setattr(_images, "_MAX_BYTES", 9 * 48)
    memory = kernels.load("cuda").memory()
    images = [memory.image((3, 4)) for _ in range(50)]
    assert len(made) < 10
    for number, image in enumerate(images):
        image[:] = number
    assert [int(image[2, 3]) for image in images] == list(range(50))


def test_image_outlives_its_memory():
    memory = kernels.load("cuda").memory()
    image = memory.image((3, 4))
    memory.close()
    image[:] = 7
    del memory
    assert np.all(image == 7)

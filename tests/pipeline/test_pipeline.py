"""The whole chain equals the exact image, on random words.

The chain is linear up to the magnitude. Noise therefore tests all ranges and directions at once, and needs no
simulator.
"""

import concurrent.futures
import gc
import multiprocessing
import os
import subprocess
import sys
import tracemalloc
import types
from pathlib import Path

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError, DataError, DeviceError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Processing, Settings
from tests import cases, reference
from tests.cases import CASES, SHORT, noise, process_noise
from tests.hard_cases.tuned import tuned

DEVICES = ("cpu", "numpy")


def exact(pipeline: Pipeline, measurement: Measurement):
    directions = unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad)
    return reference.exact(measurement.data, pipeline.settings, directions, pipeline.range_m)


@pytest.mark.parametrize("precision", ["float32", "int16"])
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", [*CASES, "one range"])
def test_pipeline_image_is_exact(name, device, precision):
    one_range = SHORT.replace(processing=SHORT.processing.replace(range_m=(0.7, 0.7)))
    settings = tuned(CASES.get(name, one_range), precision=precision)
    pipeline = Pipeline(settings, device=device, predict=False)
    measurement = noise(settings)
    image = pipeline.process(measurement)
    assert image.amplitude.shape == (len(pipeline.grid), len(pipeline.range_m))
    assert np.isfinite(image.amplitude).all()
    assert reference.error_db(image.amplitude, exact(pipeline, measurement)) < settings.accuracy.max_error_db


def test_error_falls_by_6_db_per_doubling_of_phases():
    settings = SHORT.replace(processing=SHORT.processing.replace(directions="2d:41"))
    measurement = noise(settings)
    errors_db = []
    for oversampling in (8, 16, 32):
        plan = {"oversampling": oversampling, "delay_taps": 1, "beam_taps": 0, "stopband_attenuation_db": 80.0}
        pipeline = Pipeline(tuned(settings, precision="float32", max_error_db=0.0, **plan), predict=False)
        errors_db.append(reference.error_db(pipeline.process(measurement).amplitude, exact(pipeline, measurement)))
    assert np.diff(errors_db) == pytest.approx([-6, -6], abs=1)


def test_window_omits_unneeded_samples():
    whole = Pipeline(SHORT.replace(processing=SHORT.processing.replace(range_m=(0.0, 1.5))), predict=False)
    part = Pipeline(SHORT, predict=False)
    measurement = noise(SHORT)
    expected = exact(part, measurement)
    assert len(part.range_m) < len(whole.range_m) / 2
    assert reference.error_db(part.process(measurement).amplitude, expected) < SHORT.accuracy.max_error_db


@pytest.mark.parametrize(
    ("device", "method"), [("cpu", "fast"), ("numpy", "fast"), ("cpu", "paper"), ("numpy", "paper")]
)
def test_record_of_a_delayed_call_is_imaged_like_that_of_an_immediate_one(device, method):
    settings = SHORT.replace(processing=SHORT.processing.replace(method=method))
    measurement, n_late = noise(settings), 4500
    words = np.concatenate([noise(settings, seed=3).data[:n_late], measurement.data])[: len(measurement.data)]
    late = settings.replace(call=settings.call.replace(delay_s=n_late / settings.recording.sample_rate_hz))
    image = Pipeline(settings, device=device, predict=False).process(measurement)
    pipeline = Pipeline(late, device=device, predict=False)
    found = pipeline.process(Measurement(words, late))
    np.testing.assert_allclose(found.range_m, image.range_m)
    assert reference.error_db(found.amplitude, image.amplitude) < settings.accuracy.max_error_db
    if method == "fast":
        expected = exact(pipeline, Measurement(words, late))
        assert reference.error_db(found.amplitude, expected) < settings.accuracy.max_error_db


def test_record_that_ends_before_the_echoes_of_a_delayed_call_is_refused():
    with pytest.raises(ArgumentError, match=r"processing\.range_m ends at .* m, but the record .* shorten"):
        Pipeline(SHORT.replace(call=SHORT.call.replace(delay_s=SHORT.recording.duration_s - 3e-3)), predict=False)


@pytest.mark.parametrize("method", ["fast", "paper"])
def test_each_image_owns_its_axes(method):
    settings = SHORT.replace(processing=SHORT.processing.replace(method=method))
    image = Pipeline(settings, predict=False).process(noise(settings))
    step_m = sound_speed_m_s(settings.air) / (2 * 45_000)
    assert np.diff(image.range_m) == pytest.approx(step_m)
    assert image.range_m[0] == pytest.approx(0.4, abs=step_m)
    assert 0.9 - step_m < image.range_m[-1] <= 0.9
    assert np.degrees(image.azimuth_rad) == pytest.approx(np.linspace(-90, 90, 7))
    assert image.stamp.sequence == 5


def test_default_image_has_the_range_axis_of_the_paper():
    pipeline = Pipeline(Settings(), predict=False)
    assert pipeline.range_m[0] == 0.5
    assert len(pipeline.range_m) == 1178  # 4.5 m at 3.82 mm: 343.87 m/s at 20 °C and 50 %


def test_one_pipeline_serves_several_threads_at_a_time():
    pipeline = Pipeline(SHORT)
    measurements = [noise(SHORT, seed) for seed in range(16)]
    alone = [pipeline.process(measurement).amplitude.copy() for measurement in measurements]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        together = list(pool.map(pipeline.process, measurements))
    for one, other in zip(alone, together, strict=True):
        assert one.tobytes() == other.amplitude.tobytes()


def test_spawned_process_gives_the_same_bits():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(process_noise, [3, 4]) == [process_noise(3), process_noise(4)]


def test_output_array_is_reused_without_allocation():
    settings = Settings(processing=Processing(directions="3000"))
    pipeline = Pipeline(settings, predict=False)
    measurement = noise(settings)
    out = np.empty((3000, len(pipeline.range_m)), dtype=np.float32)
    first = pipeline.process(measurement)
    tracemalloc.start()
    image = pipeline.process(measurement, out=out)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert image.amplitude is out
    assert image.amplitude.tobytes() == first.amplitude.tobytes()
    assert peak < out.nbytes / 4  # the spectra, which SciPy returns in a new array


@pytest.mark.parametrize(
    ("settings", "device", "threads", "error", "match"),
    [
        (SHORT, "gpu", None, ArgumentError, "device 'gpu' is unknown"),
        (SHORT, "cpu", 0, ArgumentError, "threads is 0; use a whole number from 1"),
        (SHORT, "cpu", 4096, ArgumentError, "threads is 4096; use a whole number from 1"),
        (
            SHORT.replace(processing=Processing(range_m=(0.5, 5.0))),
            "cpu",
            None,
            ArgumentError,
            "processing.range_m ends at 5 m, but the record of 9.102 ms covers 1.565 m",
        ),
        (
            SHORT.replace(processing=Processing(range_m=(0.5, 1.0), directions="2d:0")),
            "cpu",
            None,
            ArgumentError,
            "count of directions '2d:0' is 0",
        ),
        (SHORT.replace(array=Array(layout="eRTIS_v9")), "cpu", None, ArgumentError, "layout 'eRTIS_v9' is unknown"),
    ],
)
def test_pipeline_refuses_invalid_arguments(settings, device, threads, error, match):
    with pytest.raises(error, match=match):
        Pipeline(settings, device=device, threads=threads)


def test_cuda_without_a_gpu_is_refused_with_a_remedy():
    """In a separate process that sees no GPU, even if the machine has one."""
    code = "from ertis_numba import kernels; print(kernels.usable()); kernels.load('cuda')"
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "-1", "NUMBA_ENABLE_CUDASIM": "0"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "('cpu', 'numpy')\n"
    error = done.stderr.strip().splitlines()[-1]
    assert "DeviceError: device 'cuda' finds no NVIDIA GPU" in error
    assert "use device 'cpu', or install ertis-numba[cu12] or [cu13]" in error


def fails_to_import(monkeypatch, module: str):
    """Let the import of the CUDA kernels fail because of ``module``."""

    def fail(_name):
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    kernels.load("cpu")
    monkeypatch.setattr("ertis_numba.kernels._dispatch.importlib", types.SimpleNamespace(import_module=fail))


def test_cuda_without_numbas_target_is_refused_with_a_remedy(monkeypatch):
    fails_to_import(monkeypatch, "numba.cuda")
    with pytest.raises(DeviceError, match=r"'cuda' cannot be loaded \(No module named 'numba.cuda'\); use device"):
        kernels.load.__wrapped__("cuda")


def test_missing_module_of_a_cuda_kernel_is_not_taken_for_a_missing_gpu(monkeypatch):
    fails_to_import(monkeypatch, "ertis_numba.kernels._cuda.lost")
    with pytest.raises(ModuleNotFoundError, match="lost"):
        kernels.load.__wrapped__("cuda")


def test_batch_equals_single_measurements():
    pipeline, measurements = Pipeline(SHORT), [noise(SHORT, seed) for seed in range(5)]
    single = [pipeline.process(measurement) for measurement in measurements]
    batch = pipeline.process_batch(iter(measurements))
    assert [image.amplitude.tobytes() for image in batch] == [image.amplitude.tobytes() for image in single]
    assert [image.stamp for image in batch] == [measurement.stamp for measurement in measurements]
    assert len({image.amplitude.tobytes() for image in batch}) == len(batch)


def test_batch_is_written_into_the_given_array():
    pipeline, measurements = Pipeline(SHORT, predict=False), [noise(SHORT, seed) for seed in range(3)]
    new = pipeline.process_batch(measurements)
    given = np.full((4, *new[0].amplitude.shape), 7.0, np.float32)
    batch = pipeline.process_batch(measurements, given)
    assert [image.amplitude.tobytes() for image in batch] == [image.amplitude.tobytes() for image in new]
    assert all(np.shares_memory(image.amplitude, each) for image, each in zip(batch, given, strict=False))
    assert (given[3] == 7.0).all()


@pytest.mark.parametrize(
    ("cut", "dtype", "message"),
    [
        (np.s_[:1], np.float32, "use 2 or more images"),
        (np.s_[0], np.float32, "use 2 or more images"),
        (np.s_[:, 1:], np.float32, "use contiguous float32 of shape"),
        (np.s_[:], np.float64, "use contiguous float32 of shape"),
    ],
)
def test_batch_refuses_arrays_that_do_not_fit(cut, dtype, message):
    with Pipeline(SHORT, predict=False) as pipeline:
        given = np.full((2, len(pipeline.grid), len(pipeline.range_m)), 7.0, dtype)
        with pytest.raises(ArgumentError, match=message):
            pipeline.process_batch([noise(SHORT), noise(SHORT, 1)], given[cut])
    assert (given == 7.0).all()


def test_batch_with_a_wrong_measurement_processes_none():
    wrong = Measurement(np.zeros(10, np.uint32), SHORT)
    with pytest.raises(DataError, match="uint32 words of shape"):
        Pipeline(SHORT, predict=False).process_batch([noise(SHORT), wrong])


@pytest.mark.parametrize("device", DEVICES)
def test_cuda_graphs_are_refused_without_cuda(device):
    with pytest.raises(ArgumentError, match="graphs is True, but only device 'cuda' has CUDA graphs"):
        Pipeline(SHORT, device, graphs=True)


def test_empty_batch_gives_no_images():
    assert Pipeline(SHORT, predict=False).process_batch([]) == []


@pytest.mark.parametrize("method", ["fast", "paper"])
def test_closed_pipeline_refuses_work_and_keeps_its_axes(method):
    settings = SHORT.replace(processing=SHORT.processing.replace(method=method))
    with Pipeline(settings, predict=False) as pipeline:
        image = pipeline.process(noise(settings))
    pipeline.close()
    assert (len(pipeline.grid), len(pipeline.range_m)) == image.amplitude.shape
    for refused in (lambda: pipeline.process(noise(settings)), lambda: pipeline.process_batch([noise(settings)])):
        with pytest.raises(ArgumentError, match="the pipeline is closed; create another one"):
            refused()


@pytest.mark.parametrize(
    "words", [np.zeros(10, np.uint32), np.zeros(40_960, np.uint16), np.zeros((40_960, 2), np.uint32)]
)
def test_pipeline_refuses_samples_of_other_settings(words):
    with pytest.raises(DataError, match=r"words of shape .* its settings describe uint32 of shape \(40960,\)"):
        Pipeline(SHORT, predict=False).process(Measurement(words, SHORT))


@pytest.mark.parametrize("out", [np.zeros((7, 3), np.float32), np.zeros((7, 131)), np.zeros((131, 7), np.float32).T])
def test_pipeline_refuses_out_of_another_shape(out):
    with pytest.raises(ArgumentError, match=r"use contiguous float32 of shape \(7, 131\)"):
        Pipeline(SHORT, predict=False).process(noise(SHORT), out=out)


def test_tests_package_is_this_project():
    """The wheel of rtisdev has a top-level package of the same name."""
    assert Path(cases.__file__).parent == Path(__file__).parents[1] == Path(reference.__file__).parent


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        (
            SHORT.replace(air=SHORT.air.replace(temperature_c=-10.0)),
            r"has air.temperature_c -10.0, but 20.0 is in use; process it with its own settings",
        ),
        (
            SHORT.replace(call=SHORT.call.replace(duration_s=1e-3)),
            "has call.duration_s 0.001, but 0.0025 is in use",
        ),
        (
            SHORT.replace(array=Array(layout="eRTIS_v2")),
            "has array 'eRTIS_v2', but another one, 'eRTIS_v3D1', is in use",
        ),
    ],
)
def test_pipeline_refuses_measurements_of_other_settings(settings, match):
    with pytest.raises(DataError, match=match):
        Pipeline(SHORT, predict=False).process(noise(settings))


def test_named_and_written_layouts_are_equal():
    written_out = SHORT.replace(array=microphones(SHORT.array).to_array())
    named, other = Pipeline(SHORT, predict=False), Pipeline(written_out, predict=False)
    assert named.process(noise(written_out)).amplitude.tobytes() == other.process(noise(SHORT)).amplitude.tobytes()


@pytest.mark.parametrize("device", ["cpu", "numpy"])
def test_paper_method_runs_on_the_given_device(device):
    paper = SHORT.replace(processing=SHORT.processing.replace(method="paper"))
    assert Pipeline(paper, device=device, predict=False).device == device


def test_read_only_samples_cause_no_compilation():
    pipeline = Pipeline(SHORT, predict=False)
    compiled = kernels.load("cpu").demodulate_words.signatures
    before = len(compiled)
    words = np.frombuffer(noise(SHORT).data.tobytes(), dtype=np.uint32)
    image = pipeline.process(Measurement(words, SHORT))
    assert image.amplitude.tobytes() == pipeline.process(noise(SHORT)).amplitude.tobytes()
    assert len(kernels.load("cpu").demodulate_words.signatures) == before


@pytest.mark.parametrize("changes", [{}, {"beamformer": "dmas"}, {"method": "paper"}], ids=["default", "DMAS", "paper"])
def test_pipeline_is_freed_without_the_garbage_collector(changes):
    """Plans had references to themselves, which kept their tables."""
    settings = SHORT.replace(processing=SHORT.processing.replace(**changes))
    Pipeline(settings, "numpy", predict=False).close()  # fills the caches of the package
    gc.collect()
    gc.disable()
    try:
        with Pipeline(settings, "numpy", predict=False) as pipeline:
            pipeline.process(noise(settings))
        del pipeline
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        own = [type(each).__name__ for each in gc.garbage if type(each).__module__.startswith("ertis_numba")]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert own == []

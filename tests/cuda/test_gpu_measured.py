"""GPU benchmarks. The simulator runs the same code but reports no times."""

import dataclasses

import numpy as np
import pytest
from ertis_bench import timing
from ertis_bench.gpu_trials import gpu_parts, gpu_stages, rivals
from numba import cuda

from ertis_numba import kernels
from ertis_numba.base.errors import DataError, DeviceError
from ertis_numba.kernels.benchmarks import ceilings_of_cuda as ceilings
from ertis_numba.kernels.benchmarks.stopwatch import Stopwatch
from ertis_numba.pipeline import Pipeline
from tests.cases import noise
from tests.cuda.plans import DIRECT, TINY

TINIEST = TINY.replace(
    call=TINY.call.replace(duration_s=2e-4),
    array=TINY.array.replace(positions_m=TINY.array.positions_m[:1]),
    processing=TINY.processing.replace(directions="2d:2", range_m=(0.3, 0.32)),
    accuracy=DIRECT,
)
SIMULATED = "cuda" not in kernels.usable() or kernels.load("cuda").simulated
SMALL = {} if not SIMULATED else {"turns": 2, "copy_bytes": 64, "threads": 2}
SCALE = gpu_parts.Scale(
    subject=lambda: (noise(TINIEST), "white noise, seed 5"),
    directions=("2d:2",),
    range_m=(0.3, 0.32),
    count=1,
    stream=1,
    streams=1,
    rivals=1,
    ceilings=tuple(SMALL.items()),
)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(timing, "_WARM_UP", 0)
    monkeypatch.setattr(timing, "_WARM_UP_S", 0.0)


def test_gpu_ceiling_kernels_compute_correct_values():
    sums = cuda.to_device(np.zeros(4, np.float32))
    ceilings.multiply_add(3, sums)  # each of the eight sums converges to 1 / (1 - 1/2)
    assert sums.copy_to_host() == pytest.approx(16)
    samples = np.arange(2048 + 256, dtype=np.uint64) ** np.uint64(3)
    found = cuda.to_device(np.zeros(4, np.uint64))
    ceilings.load(cuda.to_device(samples), 2, 1, found)
    lanes, turns, loads = np.ogrid[:4, :2, :8]
    loaded = samples[1 + lanes + 32 * (turns + loads)]
    assert np.array_equal(found.copy_to_host(), np.bitwise_xor.reduce(loaded.reshape(4, -1), axis=1))
    rates = ceilings.ceilings(1, **SMALL)
    assert set(rates) == {"copy_gb_s", "float32_gop_s", "load_gb_s", "load_unaligned_gb_s"}
    assert SIMULATED or min(rates.values()) > 0


def test_gpu_benchmark_compares_acoustic_maps_with_those_of_the_cpu():
    small = {
        "processing__directions": "2d:3",
        "recording__n_samples": 256,
        "passive__bands_hz": [[25e3, 40e3]],
        "passive__resolution_hz": 8e3,
        "array": TINY.array,
    }
    scale = dataclasses.replace(SCALE, listening=tuple(small.items()), methods=("delay_and_sum", "clean_sc"))
    rows = list(gpu_parts.acoustic_maps(scale))
    assert [row["method"] for row in rows] == ["delay_and_sum", "clean_sc"]
    assert all(row["directions"] == 3 and row["ours_ms"] > 0 and row["off_cpu_db"] < -50 for row in rows)


def test_stopwatch_adds_parts_of_the_same_name():
    watch, lane = Stopwatch(), kernels.load("cuda").memory().lane()
    with lane.entered():
        for _ in range(2):  # `start` resets the stopwatch in the second pass
            watch.start()
            for name in ("one", "two", "one"):
                watch.mark(name)
    assert list(watch.read_ms()) == ["one", "two"]


def test_gpu_benchmark_reports_paper_and_ceiling_rows():
    (row,) = list(gpu_parts.paper(SCALE))[:1]
    assert row["plan"] == "float32, 2 samples of 2 per range, 40 dB"
    assert row["off_cpu_db"] <= -100
    assert row["error_db"] <= -25
    assert set(row["one_at_a_time"]) == {"plain", "graphs"}
    assert len(row["streamed_ms"]) == 4
    assert tuple(row["stages_ms"]) == gpu_stages.STAGES
    assert SIMULATED or min(row["stages_ms"].values()) > 0
    moved_ms = sum(row["stages_ms"][name] for name in gpu_stages.TRANSFERS)
    assert row["sum_ms"] == pytest.approx(row["without_transfers_ms"] + moved_ms, abs=1e-3)
    first, reached = gpu_parts.ceilings_of(SCALE)
    assert set(first["ceilings"]) == {"copy_gb_s", "float32_gop_s", "load_gb_s", "load_unaligned_gb_s"}
    assert (reached["terms"], reached["directions"]) == (2, "2d:2")  # one microphone, two samples


def test_rival_images_are_compared_before_timing(monkeypatch):
    monkeypatch.setattr(rivals, "LIBRARIES", {"NumPy": "numpy", "Louder": "numpy", "Missing": "no_such_module"})
    library = rivals.numpy_library()
    louder = dataclasses.replace(library, rfft=lambda signals: 1.01 * library.rfft(signals))
    monkeypatch.setattr(rivals, "_MAKERS", {"NumPy": rivals.numpy_library, "Louder": lambda: louder})
    good, bad, missing = gpu_parts.side_by_side(SCALE)
    assert good["off_db"] < -100
    assert good["times_faster"] == pytest.approx(good["theirs_ms"] / good["ours_ms"], rel=0.1, abs=0.01)
    assert bad["status"].startswith("failed: image of Louder differs from this package's by -40.0 dB; the limit is")
    assert missing == {"library": "Missing", "directions": "2d:2", "status": "not installed"}


def test_gpu_benchmark_refuses_to_time_a_wrong_image(monkeypatch):
    process = Pipeline.process

    def louder(self, measurement, out=None):
        image = process(self, measurement, out)
        return image.replace(amplitude=1.001 * image.amplitude) if self.device == "cuda" else image

    monkeypatch.setattr(Pipeline, "process", louder)
    with pytest.raises(DataError, match=r"on 'cuda' differs from that on 'cpu' by -60.0 dB; the limit is -100 dB"):
        next(gpu_parts.paper(SCALE))


def test_gpu_benchmark_refuses_the_simulator():
    if not SIMULATED:
        pytest.skip("a GPU is not refused")
    with pytest.raises(DeviceError, match="device 'cuda' is simulated here, so its times are meaningless"):
        next(gpu_parts.machine(SCALE))

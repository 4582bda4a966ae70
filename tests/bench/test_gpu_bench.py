"""`ertis bench gpu` without a GPU: it refuses, keeps rows before a failure, and compares the images of its rivals."""

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.gpu_trials import gpu, gpu_tables, rival_mach, rivals
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.base.errors import DeviceError
from ertis_numba.pipeline import Pipeline, verification
from tests.cases import CASES, SHORT, noise

MARKED = "# Mine\n\n<!-- ertis bench {0} -->\nold\n<!-- /ertis bench {0} -->\n"
GPU = {
    "name": "NVIDIA Test GPU",
    "multiprocessors": 132,
    "compute_capability": "9.0",
    "cuda_driver": "12.8",
    "cuda_runtime": "12.9",
    "packages": {"numba-cuda": "0.30.4"},
    "driver_version": "570.1",
}
STAGES = {"upload": 0.02, "demodulate": 0.03, "download": 0.2}
ROW = {
    "directions": "1850",
    "ranges": 1181,
    "plan": "float32, 2 samples of 2 per range, 40 dB",
    "error_db": -36.1,
    "off_cpu_db": -121.0,
    "one_at_a_time": {name: {"mean_ms": 1.0, "std_ms": 0.1, "median_ms": 0.516} for name in ("plain", "graphs")},
    "stages_ms": STAGES,
    "sum_ms": 0.25,
    "without_transfers_ms": 0.03,
    "queued": False,
    "streamed_ms": {
        f"{where}, {how}": 0.4 for where in ("to the host", "stay on the GPU") for how in ("plain", "graphs")
    },
    "times_faster_than_published": 100.0,
}
PARTS = {
    "tests": {"status": "done", "passed": 9, "passed_on_gpu": 4, "failed": 0, "skipped": 1, "wall_s": 70.0},
    "memcheck": {"status": "not available: no compute-sanitizer on PATH or in CUDA_HOME", "wall_s": 0.0},
    "paper": {"status": "failed (1): DataError", "rows": [ROW], "wall_s": 60.0},
    "side by side": {
        "status": "done",
        "rows": [
            {"library": "PyTorch", "directions": "", "status": "not installed"},
            {
                "library": "CuPy",
                "directions": "90",
                "what": "host to host",
                "plan": "a plan",
                "off_db": -130.0,
                "theirs_ms": 9.0,
                "ours_ms": 0.5,
                "times_faster": 18.0,
            },
            {
                "library": "mach",
                "directions": "90",
                "what": "delay-and-sum",
                "plan": "a plan",
                "off_db": -48.0,
                "theirs_ms": 0.262,
                f"theirs_per_frame_of_{rival_mach.FRAMES}_ms": 0.023,
                "ours_ms": 0.073,
                "times_faster": 3.59,
            },
        ],
        "wall_s": 20.0,
    },
    "acoustic maps": {
        "status": "done",
        "rows": [
            {
                "method": "clean_sc",
                "directions": 3000,
                "bands": 10,
                "bins": 190,
                "ours_ms": 3.0,
                "cpu_ms": 40.0,
                "off_cpu_db": -46.0,
            }
        ],
        "wall_s": 20.0,
    },
    "ceilings": {
        "status": "done",
        "rows": [
            {
                "ceilings": {
                    "copy_gb_s": 4000.0,
                    "float32_gop_s": 60000.0,
                    "load_gb_s": 30000.0,
                    "load_unaligned_gb_s": 2e4,
                },
                "clocks.sm": "1980 MHz",
            },
            {
                "directions": "3000",
                "ranges": 1181,
                "terms": 64,
                "plan": "float32",
                "delay_and_sum_ms": 0.1,
                "shares": {"float32_gop_s": 0.3, "load_gb_s": 0.61},
            },
        ],
        "wall_s": 20.0,
    },
}


@pytest.fixture
def report(monkeypatch, tmp_path):
    """Report of a run whose parts end in the given ways, and its output."""
    stated = []
    monkeypatch.setattr(gpu, "part", lambda name: {"status": "done", "rows": [GPU]} if name == "machine" else None)
    monkeypatch.setattr(gpu, "parts", lambda: {name: dict(part).copy for name, part in PARTS.items()})
    report = gpu.run(results=tmp_path / "results", say=stated.append)
    return report, stated


def test_gpu_benchmark_without_a_gpu_writes_nothing(tmp_path):
    if "cuda" in kernels.usable():
        pytest.skip("there is a GPU here")
    done = CliRunner().invoke(cli, ["bench", "gpu", "--results", str(tmp_path / "results")])
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr.startswith("ertis: error: device 'cuda' finds no NVIDIA GPU")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "results").exists()


def test_gpu_benchmark_refuses_the_simulator(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_ENABLE_CUDASIM", "1")
    with pytest.raises(DeviceError, match="is simulated here, so its times are meaningless; unset NUMBA"):
        gpu.run(results=tmp_path / "results", say=lambda _: None)


def test_results_file_is_named_after_gpu_and_time(report, tmp_path):
    found, stated = report
    (path,) = (tmp_path / "results").iterdir()
    assert path.name.startswith("nvidia-test-gpu-20")
    assert json.loads(path.read_text("utf-8")) == found
    assert found["gpu"] == GPU
    assert list(found["parts"]) == list(PARTS)
    assert {"revision", "date", "machine", "source", "wall_s"} <= set(found)
    assert "memcheck: not available: no compute-sanitizer on PATH or in CUDA_HOME" in stated


def test_tables_show_the_newest_results_without_a_gpu(report, tmp_path):
    found, _ = report
    folder, full = tmp_path / "results", tmp_path / "full.md"
    (folder / "a.json").write_text(json.dumps(found | {"date": "2020-01-01", "gpu": GPU | {"name": "Old"}}), "utf-8")
    full.write_text(MARKED.format("gpu"), "utf-8")
    command = ["bench", "gpu", "--newest", "--results", folder, "--update", full]
    done = CliRunner().invoke(cli, [str(part) for part in command])
    assert done.exit_code == 0, done.stderr
    text = full.read_text("utf-8")
    for line in (
        "| one at a time, words to image | not measured | 0.516 | not measured |",
        "| paper's time / shortest single time | – | 100× | – |",
        "| upload | 0.0200 |",
        "| PyTorch: not installed |  | – | – | – | – | – | – | – |",
        "| CuPy: host to host | 90 | a plan | 9.000 | – | 0.500 | 18.0× | – | -130 |",
        "| mach: delay-and-sum | 90 | a plan | 0.262 | 0.023 | 0.073 | 3.6× | 0.32× | -48 |",
        "| float32 multiply-add, Gop/s | 60,000 | 30 % |",
        "- paper: failed (1): DataError (0 s)",
        "- tests: done; 9 passed, 4 of them on the GPU; 0 failed, 1 skipped (0 s)",
    ):
        assert line in text
    assert "with gaps in which the GPU waited for launches" in text
    assert "driver 570.1, CUDA of the driver 12.8" in text
    assert "clock right after load 1980 MHz" in text
    assert "No GPU has run" not in text
    assert "\nold\n" not in text


NEWEST = json.loads(max((Path(__file__).parents[2] / "bench" / "results").glob("*.json")).read_text("utf-8"))


# The tables print medians, and what was reached as a share of the ceilings.
NOT_PRINTED = {"mean_ms", "std_ms", "queued", "tighter", "float32_gop_s", "load_gb_s"}


def _leaves(value):
    """Return the numbers and texts of nested dictionaries that a table has to print."""
    if isinstance(value, dict):
        return [leaf for key, part in value.items() if key not in NOT_PRINTED for leaf in _leaves(part)]
    return [value]


def _is_printed(leaf, numbers):
    """Return True if a figure, or its percentage, is among numbers, rounded as they are."""
    exact = [leaf, 100 * leaf]
    return any(
        float(each) and float(each) in [round(x, len(each.partition(".")[2])) for x in exact] for each in numbers
    )


@pytest.mark.parametrize("part", [name for name, found in NEWEST["parts"].items() if "rows" in found])
def test_no_measured_figure_is_left_out_of_the_tables(part):
    text = gpu_tables.gpu(NEWEST).replace(",", "")
    numbers = re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", text)
    for leaf in (leaf for row in NEWEST["parts"][part]["rows"] for leaf in _leaves(row)):
        is_printed = leaf.replace(",", "") in text if isinstance(leaf, str) else _is_printed(leaf, numbers)
        assert is_printed, leaf


def test_tables_without_results_state_not_measured(tmp_path):
    done = CliRunner().invoke(cli, ["bench", "gpu", "--newest", "--results", str(tmp_path)])
    assert done.stdout.count("not measured") == 7 * 3
    assert "| the paper's GTX 1080 Ti | 5.93 | 51.58 | 77.02 |" in done.stdout
    assert "No GPU has run these kernels yet" in done.stdout


@pytest.mark.parametrize(
    "results", [{}, {"parts": {}}, {"parts": {"paper": {"status": "not finished after 9 s", "rows": []}}}]
)
def test_tables_show_all_existing_parts(report, results):
    found = report[0] | results if results else report[0]
    for part in found["parts"].values():
        part.setdefault("wall_s", 9.0)
    assert gpu_tables.gpu(found).startswith("| ms per measurement, median |")


@pytest.mark.alone
def test_hanging_part_is_ended_with_its_children():
    begin_s = time.monotonic()
    done = gpu.execute(["sh", "-c", "echo begun; sleep 100; echo ended"], 3.0)  # A shell begins at once.
    assert time.monotonic() - begin_s < 10
    assert done == gpu.FinishedProcess(None, "begun\n")


def test_rows_before_a_failure_are_kept(monkeypatch):
    script = "import sys; open(sys.argv[1], 'w').write('{\"a\": 1}\\n{\"b\": 2}\\n{\"c'); sys.exit('no more')"
    execute = gpu.execute
    monkeypatch.setattr(
        gpu, "execute", lambda command, limit_s: execute([command[0], "-c", script, command[-1]], limit_s)
    )
    assert gpu.part("paper") == {"status": "failed (1): no more", "rows": [{"a": 1}, {"b": 2}]}


def test_test_part_counts_gpu_tests_only(monkeypatch, tmp_path):
    """Tests of other devices do not run; if none remains, the part has not passed."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_it.py").write_text(
        "import pytest\n@pytest.mark.parametrize('device', ['cpu', 'cuda'])\ndef test_a(device): pass\n"
        "def test_b_cuda(): pytest.skip('x')\ndef test_c_cuda(): assert False\n",
        "utf-8",
    )
    (tmp_path / "tests" / "test_other.py").write_text("def test_a(): pass\n", "utf-8")
    monkeypatch.setattr(gpu, "_ROOT", tmp_path)
    monkeypatch.setattr(gpu, "_TESTED", ("tests/test_it.py",))
    found = gpu.tested()
    assert found["status"].startswith("failed (1): ")
    assert (found["passed"], found["passed_on_gpu"], found["failed"], found["skipped"]) == (1, 1, 1, 1)
    assert found["names_failed"] == ["tests.test_it::test_c_cuda"]
    monkeypatch.setattr(gpu, "_TESTED", ("tests/test_other.py",))
    assert gpu.tested()["status"].startswith("failed (5): ")


@pytest.mark.parametrize(
    ("says", "code", "status"),
    [
        ("3 passed in 1 s\n========= ERROR SUMMARY: 0 errors", 0, "done"),
        ("3 passed in 1 s\n========= ERROR SUMMARY: 2 errors", 9, "failed (9): ========= ERROR SUMMARY: 2 errors"),
        ("3 deselected\n========= ERROR SUMMARY: 0 errors", 5, "failed (5): ========= ERROR SUMMARY: 0 errors"),
        ("no attachable process", 1, "failed (1): no attachable process"),
    ],
)
def test_sanitizer_passes_only_with_tests_and_without_errors(monkeypatch, tmp_path, says, code, status):
    tool = tmp_path / "compute-sanitizer"
    tool.write_text(f"#!/bin/sh\nprintf '{says}\\n'\nexit {code}\n".replace("\n=", "\\n="), "utf-8")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert gpu.sanitized("memcheck")["status"] == status


def test_missing_sanitizer_is_not_a_pass(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(gpu.shutil, "which", lambda *_, **__: None)
    assert gpu.sanitized("racecheck")["status"].startswith("not available: ")


def test_time_limits_total_less_than_ten_minutes():
    assert sum(gpu.BUDGETS_S.values()) < 600
    assert set(gpu.BUDGETS_S) == {"machine", *gpu.parts()}


@pytest.mark.parametrize("name", ["default", "first sample", "last sample", "64 bits, two words", "decimated by 15"])
def test_array_library_rivals_compute_the_same_image(monkeypatch, name):
    settings = CASES[name]
    settings = settings.replace(accuracy=settings.accuracy.replace(precision="float32", beam_taps=0))
    plan = Pipeline(settings, device="cpu").settings
    measurement = noise(settings)
    found = rivals.tables_of(plan, measurement)
    out = np.full_like(found.image, np.nan)
    monkeypatch.setattr(rivals, "_GATHERED_BYTES", 2**18)  # some directions at a time
    rivals.ArrayChain(found, rivals.numpy_library())(measurement.data.reshape(len(measurement.data), -1), out)
    assert verification.error_db(out, found.image) < -120


def like_mach(*, channel_data, rx_coords_m, scan_coords_m, tx_wave_arrivals_s, rx_start_s, sampling_freq_hz, **given):
    """Computation of mach's kernel for one frame, after its source (src/mach/kernel.cu, version 0.2)."""
    assert given["tukey_alpha"] == 0
    beams = np.zeros(len(scan_coords_m), np.complex128)
    aperture_m = scan_coords_m[:, 2] / (2 * given["f_number"])
    for samples, position_m in zip(channel_data[:, :, 0], rx_coords_m, strict=True):
        away_m = position_m - scan_coords_m
        assert (np.hypot(away_m[:, 0], away_m[:, 1]) <= aperture_m).all()
        delay_s = tx_wave_arrivals_s + np.linalg.norm(away_m, axis=1) / given["sound_speed_m_s"]
        place = (delay_s - rx_start_s) * sampling_freq_hz
        assert place.min() >= 0
        assert place.max() <= len(samples) - 1
        lower = np.floor(place).astype(int)
        between = samples[lower] + (place - lower) * (samples[np.ceil(place).astype(int)] - samples[lower])
        beams += between * np.exp(2j * np.pi * given["modulation_freq_hz"] * delay_s)
    return beams


def test_mach_rival_gets_the_same_input():
    settings = rival_mach.settings_for(SHORT.replace(processing=SHORT.processing.replace(directions="3d:20")))
    plan = Pipeline(settings, device="cpu").settings
    arguments, image = rival_mach.problem(plan, noise(settings), "cpu")
    found = np.abs(like_mach(**arguments)).reshape(image.shape) / len(arguments["rx_coords_m"])
    assert verification.error_db(found.astype(np.float32), image) < -35

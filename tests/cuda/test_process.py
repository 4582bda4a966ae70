"""``ertis process --device cuda`` compared with ``--device cpu``."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.campaign import sensor_processing
from ertis_numba.settings import Accuracy
from ertis_numba.storage import open_energyscapes, write_recording
from tests import reference
from tests.cuda.plans import DIRECT, TINY
from tests.files import noise

COUNT = 2
BUDGET_DB = -40.0
TINIER = TINY.replace(processing=TINY.processing.replace(directions="2d:3", range_m=(0.3, 0.4)))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Reports and amplitudes of recordings processed with and without an explicit plan, on both devices."""
    folder, found = tmp_path_factory.mktemp("process"), {}
    free = Accuracy(max_error_db=BUDGET_DB)
    for plan, accuracy in {"explicit": DIRECT, "chosen": free, "exact": Accuracy(max_error_db=-100.0)}.items():
        count = COUNT if plan == "explicit" else 1
        recording = write_recording(folder / f"{plan}.h5", noise(TINIER.replace(accuracy=accuracy), count=count))
        for device in ("cpu", "cuda") if plan != "exact" else ("cpu",):
            found[plan, device] = run(recording, device)
    return found


def run(recording, device):
    target = recording.with_name(f"{recording.stem} {device}.h5")
    command = ["process", recording, "-o", target, "--device", device, "--force", "--json"]
    done = CliRunner().invoke(cli, [str(argument) for argument in command])
    assert done.exit_code == 0, (done.stderr, done.exception)
    with open_energyscapes(target) as images:
        return json.loads(done.stdout), np.array([image.amplitude for image in images])


def test_cuda_process_reports_device_and_all_measurements(made):
    for (plan, device), (report, amplitudes) in made.items():
        count = COUNT if plan == "explicit" else 1
        assert (report["device"], report["measurements"]) == (device, count)
        assert report["median_ms"] > 0
        assert len({amplitude.tobytes() for amplitude in amplitudes}) == count


def test_cpu_and_cuda_images_differ_by_rounding_only(made):
    """The devices add single-precision terms in different orders: -100 dB at most."""
    for cpu, cuda in zip(made["explicit", "cpu"][1], made["explicit", "cuda"][1], strict=True):
        assert reference.error_db(cpu, cuda) < -100


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_cuda_plan_keeps_its_error_budget(made, device):
    for exact, image in zip(made["exact", "cpu"][1], made["chosen", device][1], strict=True):
        assert reference.error_db(exact, image) < BUDGET_DB


def test_images_of_cpu_and_cuda_plans_differ_by_their_errors_at_most(made):
    for cpu, cuda in zip(made["chosen", "cpu"][1], made["chosen", "cuda"][1], strict=True):
        assert reference.error_db(cpu, cuda) < BUDGET_DB + 6.1  # both errors at their limit, with opposite signs


def test_cuda_file_is_independent_of_the_batch_size(made, tmp_path, monkeypatch):
    recording = write_recording(tmp_path / "rec.h5", noise(TINIER.replace(accuracy=DIRECT), count=COUNT))
    monkeypatch.setattr(sensor_processing, "MAX_WAITING_BYTES", 1)  # one image at a time
    report, amplitudes = run(recording, "cuda")
    assert report["measurements"] == COUNT
    assert amplitudes.tobytes() == made["explicit", "cuda"][1].tobytes()


def test_cuda_process_refuses_threads(tmp_path):
    recording = write_recording(tmp_path / "rec.h5", noise(TINIER, count=1))
    done = CliRunner().invoke(cli, ["process", str(recording), "--device", "cuda", "--threads", "2"])
    assert done.exit_code == 2  # options that exclude each other
    assert done.stderr.startswith("ertis: error: --threads is 2; ")


def test_auto_device_never_selects_the_simulator(tmp_path):
    if not kernels.load("cuda").simulated:
        pytest.skip("a GPU is chosen by itself")
    recording = write_recording(tmp_path / "rec.h5", noise(TINIER, count=1))
    assert run(recording, "auto")[0]["device"] == "cpu"

"""Batched processing: the batch size changes the processing time but not the images."""

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.campaign import sensor_processing
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air
from ertis_numba.storage import open_energyscapes, write_recording
from tests.files import SMALL, noise

pytestmark = pytest.mark.usefixtures("sound_unchecked")

COUNT = 7
FAST = ["--range", "0.5:0.8", "--directions", "2d:9"]


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "rec.h5", noise(count=COUNT))


@pytest.fixture
def limit(recording, tmp_path, monkeypatch):
    """Return a function that limits the number of measurements per batch by the memory for their images."""
    run(recording, "-o", tmp_path / "img.h5", *FAST)
    with open_energyscapes(tmp_path / "img.h5") as images:
        image_bytes = images[0].amplitude.nbytes
    (tmp_path / "img.h5").unlink()
    return lambda count: monkeypatch.setattr(sensor_processing, "MAX_WAITING_BYTES", count * image_bytes)


@pytest.fixture
def sizes(monkeypatch):
    """Record the number of measurements in each pipeline call, and count closed pipelines."""
    calls = {"sizes": [], "closed": 0}
    one, many, close = Pipeline.process, Pipeline.process_batch, Pipeline.close

    def count_one(self, measurement, **options):
        calls["sizes"].append(1)
        return one(self, measurement, **options)

    def count_many(self, measurements):
        calls["sizes"].append(len(measurements))
        return many(self, measurements)

    def count_close(self):
        calls["closed"] += 1
        close(self)

    monkeypatch.setattr(Pipeline, "process", count_one)
    monkeypatch.setattr(Pipeline, "process_batch", count_many)
    monkeypatch.setattr(Pipeline, "close", count_close)
    return calls


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, ["process", *(str(argument) for argument in arguments)])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def test_file_is_independent_of_the_batch_size(recording, tmp_path, monkeypatch, limit):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")  # Otherwise the creation times differ.
    files = []
    for batch in (1, 3, 100):
        target = tmp_path / "img.h5"
        limit(batch)
        run(recording, "-o", target, *FAST, "--force")
        files.append(target.read_bytes())
    assert len(set(files)) == 1
    with open_energyscapes(target) as images:
        assert [image.stamp.sequence for image in images] == [10 + index for index in range(COUNT)]
        assert len({image.amplitude.tobytes() for image in images}) == COUNT


@pytest.mark.parametrize(
    ("room", "wanted"), [(9, [7]), (3, [3, 3, 1]), (2.5, [2, 2, 2, 1]), (1, [1] * 7), (0.5, [1] * 7)]
)
def test_batch_is_as_large_as_its_images_allow(recording, tmp_path, limit, sizes, room, wanted):
    limit(room)
    run(recording, "-o", tmp_path / "img.h5", *FAST)
    predicted, *made = sizes.pop("sizes")  # The first image is also processed to predict its error.
    assert (predicted, made, sizes) == (1, wanted, {"closed": 1})


def test_reported_time_is_per_measurement(recording, tmp_path, monkeypatch):
    clock_s = iter(np.arange(0.0, 100.0, 0.7).tolist())  # Each batch takes 0.7 s.
    monkeypatch.setattr(sensor_processing.time, "perf_counter", lambda: next(clock_s))
    done = run(recording, "-o", tmp_path / "img.h5", *FAST)
    assert "7 measurements, 9 directions" in done.stderr
    assert "100.0 ms each (median)" in done.stderr


@pytest.mark.parametrize("batch", [1, 3, 8])
def test_damage_within_a_batch_is_reported_and_leaves_no_file(recording, tmp_path, limit, batch):
    limit(batch)
    with h5py.File(recording, "r+") as file:
        file["sensors/eRTIS-7/pdm"][4, 777] ^= 1 << 9
    done = run(recording, "-o", tmp_path / "img.h5", *FAST, code=1)
    lines = done.stderr.splitlines()
    assert [line for line in lines if line.startswith("ertis: error: ")] == lines[-1:]
    assert "rec.h5: measurement 4 has CRC-32" in lines[-1]
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_failure_within_a_batch_leaves_no_file(recording, tmp_path, limit):
    limit(2)
    measurements = noise(count=5)
    warm = SMALL.replace(air=Air(temperature_c=35.0))
    measurements[3] = noise(warm, count=5)[3]
    write_recording(recording, measurements, overwrite=True)
    done = run(recording, "-o", tmp_path / "img.h5", *FAST, code=1)
    assert "measurement 13 was taken at 35 °C" in done.stderr
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]

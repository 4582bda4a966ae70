"""Measured costs of the processing steps: measured once, cached, and measured again if the cache file is invalid."""

import json
import logging
import math

import pytest

from ertis_numba import kernels
from ertis_numba.chain import costs
from ertis_numba.pipeline import Pipeline
from tests.cases import SHORT, noise

CPU = kernels.load("cpu")
WORK = {
    "n_mics": 32, "n_words": 1, "n_samples": 5000, "n_taps": 101, "tap_bits": 16, "n_fft": 6000, "n_bins": 800,
    "n_phases": 2, "n_outputs": 1500, "n_directions": 500, "n_ranges": 1200, "n_computed": 1248, "n_beams": 300,
    "n_terms": 64, "n_pairs": 8, "precision": "float32",
}  # fmt: skip


@pytest.fixture
def measured(monkeypatch, tmp_path):
    """An empty cache folder, no costs in memory, and a list of the measurements made."""
    found = costs.measured_costs(CPU, 1)
    times = []

    def once_more(kernel_set, threads):
        times.append((kernel_set.device, threads))
        return found

    monkeypatch.setattr(costs, "_KNOWN", {})
    monkeypatch.setattr(costs, "measure", once_more)
    monkeypatch.setenv("ERTIS_CACHE_DIR", str(tmp_path / "cache"))
    return times


def forget():
    costs._KNOWN.clear()  # noqa: SLF001 - as in a new process


@pytest.mark.parametrize("device", kernels.usable())
def test_measured_costs_are_times(device):
    found = costs.measure(kernels.load(device), 1).seconds
    assert all(0 < value < math.inf for value in found.values())
    assert 1e-13 < found["sum_float32_few"] < 1e-6
    assert found["demodulate_16"] < 1e-4


def test_measured_costs_are_cached(measured, caplog):
    with caplog.at_level(logging.INFO, logger="ertis_numba"):
        first = costs.measured_costs(CPU, 1)
    assert "measuring the costs of the kernels of device 'cpu'; they are stored in" in caplog.text
    path = costs.cache_file("cpu", 1)
    assert json.loads(path.read_text("utf-8")) == first.seconds
    assert list(path.parent.iterdir()) == [path]  # no partial file is left
    assert costs.measured_costs(CPU, 1) is first
    forget()
    assert costs.measured_costs(CPU, 1) == first
    assert measured == [("cpu", 1)]


@pytest.mark.usefixtures("measured")
def test_concurrent_processes_use_the_first_stored_costs(monkeypatch):
    """Different costs could lead to different plans, and so to different images."""
    found = costs.measure(CPU, 1)
    path = costs.cache_file("cpu", 1)
    theirs = {name: value / 2 for name, value in found.seconds.items()}

    def overtaken(kernel_set, threads):  # noqa: ARG001
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(theirs), "utf-8")
        return found

    monkeypatch.setattr(costs, "measure", overtaken)
    assert costs.measured_costs(CPU, 1).seconds == theirs
    assert list(path.parent.iterdir()) == [path]


def test_costs_are_cached_on_disks_without_hard_links(measured, monkeypatch):
    def refused(*_):
        raise PermissionError("no links here")

    monkeypatch.setattr(costs.os, "link", refused)
    first = costs.measured_costs(CPU, 1)
    path = costs.cache_file("cpu", 1)
    assert json.loads(path.read_text("utf-8")) == first.seconds
    assert list(path.parent.iterdir()) == [path]
    assert measured == [("cpu", 1)]


def test_costs_are_cached_per_device_and_thread_count(measured):
    costs.measured_costs(CPU, 1)
    costs.measured_costs(CPU, 2)
    costs.measured_costs(kernels.load("numpy"), 1)
    assert measured == [("cpu", 1), ("cpu", 2), ("numpy", 1)]
    assert len(list(costs.cache_file("cpu", 1).parent.iterdir())) == 3


@pytest.mark.parametrize(
    "spoil",
    [
        lambda _: "",
        lambda text: text[: len(text) // 2],
        lambda _: "[1, 2]",
        lambda _: "null",
        lambda text: text.replace('"image"', '"imago"'),
        lambda text: text.replace('"image": ', '"image": -'),
        lambda text: text.replace('"image": ', '"image": NaN, "was": '),
        lambda text: text.replace('"image": ', '"image": "fast", "was": '),
        lambda text: text.replace('"image": ', '"image": [], "was": '),
        lambda text: text.replace('"image": ', '"image": 1e999, "was": '),
        lambda _: b"\xff\xfe\x00",
    ],
)
def test_invalid_cost_file_is_measured_again(measured, spoil):
    found = costs.measured_costs(CPU, 1)
    path = costs.cache_file("cpu", 1)
    spoilt = spoil(path.read_text("utf-8"))
    path.write_bytes(spoilt if isinstance(spoilt, bytes) else spoilt.encode())
    forget()
    assert costs.measured_costs(CPU, 1) == found
    assert len(measured) == 2
    assert json.loads(path.read_text("utf-8")) == found.seconds


def test_costs_work_without_a_writable_cache_folder(measured, monkeypatch, tmp_path, caplog):
    (tmp_path / "file").write_text("no folder", "utf-8")
    monkeypatch.setenv("ERTIS_CACHE_DIR", str(tmp_path / "file" / "below"))
    with caplog.at_level(logging.INFO, logger="ertis_numba"):
        pipeline = Pipeline(SHORT, device="cpu", threads=1, plan="measured")
    assert "measured costs cannot be stored (" in caplog.text
    assert pipeline.process(noise(SHORT)).amplitude.any()
    assert ("cpu", CPU.max_threads) in measured


@pytest.mark.usefixtures("measured")
def test_costs_work_when_a_folder_blocks_the_cache_file():
    costs.cache_file("cpu", 1).mkdir(parents=True)
    assert costs.measured_costs(CPU, 1).seconds
    assert list(costs.cache_file("cpu", 1).parent.iterdir()) == [costs.cache_file("cpu", 1)]


def test_predicted_time_grows_with_work():
    found = costs.measured_costs(CPU, 1)
    usual_ms = sum(found.stages_ms(costs.Work(**WORK)).values())
    assert usual_ms > 0
    for name in WORK.keys() - {"precision", "tap_bits"}:
        more = WORK | {name: 2 * WORK[name]}
        assert sum(found.stages_ms(costs.Work(**more)).values()) > usual_ms, name


def test_many_phases_of_many_microphones_cost_more():
    """Their samples exceed every cache, although each image point has as many terms as with few phases."""
    plans = {n: costs.Work(**WORK | {"n_mics": 1024, "n_terms": 1024, "n_phases": n}) for n in (2, 8, 32)}
    sums_ms = [costs.nominal_costs(CPU).stages_ms(plan)["sums"] for plan in plans.values()]
    assert sums_ms[0] < sums_ms[1] < sums_ms[2]

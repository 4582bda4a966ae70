"""Memory of plans: 2 GiB first, then the memory of the machine; a refusal states both numbers."""

import tracemalloc

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain import planner
from ertis_numba.chain.memory import available_bytes
from ertis_numba.chain.planner import Planner
from ertis_numba.chain.signal_model import signal_model_of
from ertis_numba.frames import Measurement
from ertis_numba.settings import Accuracy, Processing, Recording, Settings

CPU = kernels.load("cpu")
SETTINGS = Settings(
    processing=Processing(directions="2d:9", range_m=(0.5, 1.0)),
    accuracy=Accuracy(precision="float32", oversampling=4, delay_taps=4, beam_taps=0, stopband_attenuation_db=60.0),
)


def sources(folder, *, limit, used):
    (folder / "meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    4000 kB\n")
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    return folder / "meminfo", folder


@pytest.mark.parametrize(("limit", "expected"), [("max", 4_096_000), ("3000000", 2_000_000), ("500", 0)])
def test_available_memory_keeps_the_limit_of_the_container(tmp_path, limit, expected):
    assert available_bytes(*sources(tmp_path, limit=limit, used=1_000_000)) == expected


def test_available_memory_is_zero_if_unknown(tmp_path):
    assert available_bytes(tmp_path / "none", tmp_path) == 0


def test_plans_beyond_the_usual_limit_use_the_memory_of_the_machine(monkeypatch):
    usual = Planner(SETTINGS, CPU, threads=1).choose()
    monkeypatch.setattr(planner, "_USUAL_BYTES", 1)
    assert Planner(SETTINGS, CPU, threads=1).choose().settings == usual.settings


def test_planner_names_both_numbers_if_no_plan_fits(monkeypatch):
    monkeypatch.setattr(planner, "_USUAL_BYTES", 1)
    monkeypatch.setattr(planner, "available_bytes", lambda: 5_000)
    with pytest.raises(ArgumentError, match=r"the smallest needs \d+ MB, this machine has available 0 MB"):
        Planner(SETTINGS, CPU, threads=1).choose()
    with pytest.raises(ArgumentError, match=r"the smallest needs \d+ MB, the limit is 0 MB"):
        Planner(SETTINGS, CPU, threads=1, max_bytes=1_000).choose()


def test_memory_of_a_signal_model_does_not_grow_with_the_record():
    def peak_bytes(n_samples):
        settings = SETTINGS.replace(recording=Recording(n_samples=n_samples))
        words = np.random.default_rng(1).integers(0, 2**32, n_samples, dtype=np.uint32)
        image = np.ones((9, 100), dtype=np.float32)
        tracemalloc.start()
        signal_model_of(Measurement(words, settings), settings, CPU, amplitude=image)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    peak_bytes(2**19)  # Compiled code and caches are allocated once.
    assert peak_bytes(2**21) < peak_bytes(2**19) + 2**20  # Samples of one microphone have four bytes.

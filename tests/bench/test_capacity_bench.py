"""The search for the largest number of sensors that a machine sustains."""

import pytest
from ertis_bench.network_trials import capacity


@pytest.mark.parametrize("true", [0, 1, 3, 8, 9, 37, 100, 255, 256])
@pytest.mark.parametrize("first", [2, 8])
def test_largest_number_is_within_a_tenth_of_the_true_one(true, first):
    tried = []
    found = capacity.largest(first, 256, lambda count: tried.append(count) or count <= true)
    assert true - max(1, round(0.1 * true)) < found <= true or found == true == 0
    assert len(tried) == len(set(tried)) <= 14


def test_numbers_that_fail_after_a_while_are_lowered_and_reported(monkeypatch):
    def trial(_folder, duration_s, _seed, count):
        lasts = count <= (20 if duration_s < 60 else 16)
        return {"faults": {} if lasts else {"superseded": 3}, "p50_ms": 5.0, "p99_ms": 9.0, "cpu_percent": {"node": 7}}

    monkeypatch.setattr(capacity, "_PARTS", {"stored": ("sensors, stored", 8, 256, trial)})
    said = []
    report = capacity.run(say=said.append)
    (row,) = report["rows"]
    assert (row["count"], row["beyond"], row["faults"]) == (16, 18, {"superseded": 3})
    assert said[-1] == "16 sensors, stored, 60 s: no loss"
    assert "| sensors, stored | 16 | 5 / 9 | node 7 | 18: 3 superseded |" in capacity.capacity(report)


def test_late_images_are_a_failure(monkeypatch):
    late = {"faults": {}, "p50_ms": 400.0, "p99_ms": 600.0, "cpu_percent": {"node": 7}}
    monkeypatch.setattr(capacity, "_PARTS", {"stored": ("sensors, stored", 8, 256, lambda *_: dict(late))})
    report = capacity.run(say=lambda _: None)
    assert (report["rows"][0]["count"], report["rows"][0]["faults"]) == (0, {"late": 1})
    assert "| sensors, stored | 0 | – | – | 1: 1 late |" in capacity.capacity(report)

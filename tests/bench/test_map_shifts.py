"""Maps of shifted poses: cell edges change the number of occupied cells, and hardly the occupied places."""

import numpy as np
import pytest
from ertis_bench.platform_trials import map_shifts, mapping

PLACES_M = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])


def test_maps_are_compared_by_places_rather_than_by_numbers():
    found = map_shifts.compared([PLACES_M, PLACES_M[:2] + 0.05])
    assert (found["mean"], found["least"], found["most"]) == (2.5, 2, 3)
    assert found["shared"] == pytest.approx((2 / 3 + 1) / 2)
    assert found["least_shared"] == pytest.approx(2 / 3)


def test_occupied_places_of_the_example_do_not_depend_on_cell_edges(monkeypatch):
    monkeypatch.setattr(map_shifts, "_N_PULSES", (2,))
    monkeypatch.setattr(map_shifts, "_N_SHIFTS", 6)
    report = mapping.run(count=0, poses=1, length_m=0.0, rate_hz=1.0, seed=2, say=str, only=("shifts",))
    (row,) = report["shifts"]["rows"]
    assert row["least"] > 10
    assert row["least_shared"] > 0.85
    assert "| 2 |" in mapping.form(report)

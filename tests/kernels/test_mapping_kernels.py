"""Compiled kernels of occupancy maps against NumPy in double precision."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ertis_numba import kernels
from ertis_numba.kernels import _numpy_mapping

CELLS = 7, 9, 11
SETS = {"compiled": kernels.load_mapping, "numpy": lambda: _numpy_mapping.KERNELS}


def found_by(name, kernel, *given, out):
    getattr(SETS[name](), kernel)(*given, out)
    return out


def test_walls_are_the_first_occupied_cells():
    draws = np.random.default_rng(1)
    log_odds = draws.normal(size=CELLS).astype(np.float32)
    directions = draws.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    given = log_odds, np.array([5.2, 4.1, 3.3]), directions, 0.5, np.float32(1.5), 9
    one, other = (found_by(name, "find_walls", *given, out=np.empty(40, np.int64)) for name in SETS)
    assert np.array_equal(one, other)
    assert 0 <= one.min() < one.max() == 9


def test_echoes_have_the_density_of_their_distribution():
    draws = np.random.default_rng(2)
    place = draws.uniform(-2.0, 12.0, (20, 3))
    roots = draws.normal(size=(20, 3, 3))
    precision = roots @ roots.transpose(0, 2, 1) + np.eye(3)
    given = place, precision, np.full((20, 3), 3.0), draws.uniform(0.1, 1.0, 20), np.full(20, 0.4)
    compiled = found_by("compiled", "spread_echoes", *given, out=np.zeros(CELLS, np.float32))
    exact = found_by("numpy", "spread_echoes", *given, out=np.zeros(CELLS))
    np.testing.assert_allclose(compiled, exact, atol=1e-6)
    assert exact.max() > 0.1


@pytest.mark.parametrize("n_elevations", [1, 12])
def test_evidence_is_that_of_the_direction_and_range_of_each_cell(n_elevations):
    draws = np.random.default_rng(3)
    cells = CELLS if n_elevations > 1 else (1, *CELLS[1:])
    occupied = np.maximum(draws.normal(size=cells), 0).astype(np.float32)
    free = draws.uniform(-0.5, 1.0, (n_elevations, 24, 14)).astype(np.float32)
    turn = Rotation.from_euler("zyx", [40.0, 20.0, 10.0] if n_elevations > 1 else [40.0, 0.0, 0.0], degrees=True)
    place = np.array([5.2, 4.1, 3.3 if n_elevations > 1 else 0.0])
    numbers = np.float32(0.1), np.float32(0.6), free, place, turn.as_matrix(), 0.5, 1.3, np.float32(0.5), np.float32(2)
    start = draws.normal(scale=1.5, size=cells).clip(-2, 2).astype(np.float32)
    compiled = found_by("compiled", "add_evidence", occupied, *numbers, out=start.copy())
    exact = found_by("numpy", "add_evidence", occupied, *numbers, out=start.astype(np.float64))
    np.testing.assert_allclose(compiled, exact, atol=1e-6)
    assert np.ptp(exact - start) > 0.5


def test_cells_without_evidence_keep_their_value():
    start = np.full(CELLS, 1.0, np.float32)
    nothing = np.zeros((12, 24, 14), np.float32)
    numbers = np.float32(0.1), np.float32(0.6), nothing, np.ones(3), np.eye(3), 0.5, 0.0, np.float32(0.6), np.float32(4)
    for name in SETS:
        out = found_by(name, "add_evidence", np.zeros(CELLS, np.float32), *numbers, out=start.copy())
        assert np.array_equal(out, start)

"""Compiled kernel of steering against NumPy and the definition."""

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from ertis_numba import kernels

SETS = {"compiled": kernels.load_steering, "numpy": lambda: kernels.load_steering("numpy")}


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("shape", [(9, 1, 4), (7, 5, 16), (1, 1, 1)])
@pytest.mark.parametrize("n_places", [1, 64, 131])
def test_sums_of_polynomials_equal_their_definition(name, shape, n_places):
    draws = np.random.default_rng(1)
    places, coefficients = draws.uniform(-1.0, 1.0, (n_places, 2)), draws.normal(size=shape)
    out = np.full((n_places, shape[2]), np.nan)
    SETS[name]().sum_polynomials(places, coefficients, out)
    np.testing.assert_allclose(out, chebyshev.chebval2d(*places.T, coefficients).T, atol=1e-12)

"""Transforms of SciPy without the package ``scipy.fft``: equal to NumPy's, and with another version of SciPy too."""

import sys
import types

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.base import fourier

RNG = np.random.default_rng(7)
REAL = RNG.normal(size=(3, 4, 30))
COMPLEX = REAL + 1j * REAL[::-1]


@pytest.fixture(params=["extension", "public"])
def library(request, monkeypatch):
    if request.param == "public":
        monkeypatch.setattr(fourier, "_LIBRARY", fourier._DocumentedFunctions)  # noqa: SLF001
    return request.param


@pytest.mark.parametrize("n", [None, 30, 20, 48])
@pytest.mark.parametrize(("dtype", "rtol"), [(np.complex64, 1e-5), (np.complex128, 1e-13)])
@pytest.mark.usefixtures("library")
def test_transforms_are_those_of_numpy(n, dtype, rtol):
    given = COMPLEX.astype(dtype)
    before = given.copy()
    for made, expected in (
        (fourier.fft(given, n), np.fft.fft(given, n)),
        (fourier.ifft(given, n, workers=2), np.fft.ifft(given, n)),
        (fourier.ifft(given, n, normalised=False), np.fft.ifft(given, n, norm="forward")),
        (fourier.fft(given.real, n), np.fft.fft(given.real, n)),
        (fourier.rfft(given.real, n), np.fft.rfft(given.real, n)),
    ):
        assert made.dtype == dtype
        assert_allclose(made, expected, rtol=0, atol=rtol * np.abs(expected).max())
    assert_array_equal(given, before)
    assert_allclose(fourier.ifft(given, n, overwrite=True), np.fft.ifft(before, n), rtol=0, atol=rtol)


@pytest.mark.usefixtures("library")
def test_next_fast_len_has_small_factors():
    assert fourier.next_fast_len(13) == 14
    assert fourier.next_fast_len(13, real=True) == 15
    assert fourier.next_fast_len(16) == 16


def test_extension_of_this_version_of_scipy_is_used():
    assert fourier._LIBRARY is sys.modules[fourier._EXTENSION]  # noqa: SLF001


def wrong(*_):
    return np.zeros(2)


@pytest.mark.parametrize(
    "other", [types.ModuleType("empty"), types.SimpleNamespace(c2c=wrong, r2c=wrong, good_size=lambda *_: 15)]
)
def test_public_functions_replace_another_extension(monkeypatch, other):
    monkeypatch.setitem(sys.modules, fourier._EXTENSION, other)  # noqa: SLF001
    assert fourier._extension() is fourier._DocumentedFunctions  # noqa: SLF001


@pytest.mark.parametrize("found", [None, types.SimpleNamespace(submodule_search_locations=["/none"])])
def test_public_functions_replace_a_missing_extension(monkeypatch, found):
    monkeypatch.delitem(sys.modules, fourier._EXTENSION)  # noqa: SLF001
    monkeypatch.setattr(fourier, "find_spec", lambda _: found)
    assert fourier._extension() is fourier._DocumentedFunctions  # noqa: SLF001

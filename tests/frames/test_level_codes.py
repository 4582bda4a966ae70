"""8-bit levels: rounding, limits, and amplitudes that have no level."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as arrays

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames.level_codes import LevelCodes, as_dtype, rounding_np
from ertis_numba.kernels import _numpy_points

USUAL = LevelCodes(-122.0, 0.5)
SLACK_DB = 0.001  # single precision
AMPLITUDES = arrays.arrays(np.float32, (3, 50), elements=st.floats(0, 1.78125, width=32))


def level_db(amplitude):
    with np.errstate(divide="ignore"):
        return 20 * np.log10(np.asarray(amplitude, np.float64))


@given(AMPLITUDES)
def test_levels_are_within_half_a_step_and_zeros_are_below_the_floor(amplitude):
    codes = USUAL.encode(amplitude)
    wanted_db = level_db(amplitude)
    stated_db = USUAL.floor_db + (codes - 1.0) * USUAL.step_db
    is_level = codes > 0
    assert (np.abs(stated_db - wanted_db)[is_level] <= USUAL.step_db / 2 + SLACK_DB).all()
    assert (wanted_db[~is_level] < USUAL.floor_db - USUAL.step_db / 2 + SLACK_DB).all()
    decoded = USUAL.decode(codes)
    assert decoded.dtype == np.float32
    np.testing.assert_allclose(level_db(decoded[is_level]), stated_db[is_level], atol=SLACK_DB)
    assert not decoded[~is_level].any()
    np.testing.assert_array_equal(USUAL.encode(decoded), codes)


def test_every_code_is_read_back_and_all_levels_are_uniformly_rounded():
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(USUAL.encode(USUAL.decode(codes)), codes)
    draws_db = np.random.default_rng(3).uniform(-122, 5, 100_000)
    amplitude = (10 ** (draws_db / 20)).astype(np.float32)
    error_np = (level_db(USUAL.decode(USUAL.encode(amplitude))) - draws_db) * math.log(10) / 20
    assert np.std(error_np) == pytest.approx(rounding_np(0.5), rel=0.01)
    assert rounding_np(0.5) == pytest.approx(0.0166, abs=1e-4)


@pytest.mark.parametrize("name", ["compiled", "numpy"])
def test_kernels_round_as_double_precision_does(name):
    made = kernels.load_points() if name == "compiled" else _numpy_points.KERNELS
    amplitude = np.concatenate(
        [
            np.exp(np.random.default_rng(5).uniform(-25, 1.5, 70_001)).astype(np.float32),
            np.array([0.0, 1e-45, 1e-38, -0.0, -1.0, np.inf, -np.inf, np.nan], np.float32),
        ]
    )
    out = np.empty(len(amplitude), np.uint8)
    made.encode_levels(amplitude.view(np.int32), np.float32(-122 / 6.0206), np.float32(6.0206 / 0.5), out)
    exact = 1 + (level_db(amplitude[:-8]) + 122) / 0.5
    is_clear = np.abs(exact - np.floor(exact) - 0.5) > 0.005
    np.testing.assert_array_equal(out[:-8][is_clear], np.rint(exact.clip(0, 255))[is_clear])
    np.testing.assert_array_equal(out[-8:], [0, 0, 0, 255, 255, 255, 255, 255])


@pytest.mark.parametrize("wrong", [1.9, 1e30, -1e-9, -1.0, np.nan, np.inf, -np.inf])
def test_amplitudes_without_a_level_are_refused(wrong):
    amplitude = np.full((2, 9), 0.5, np.float32)
    amplitude[1, 4] = wrong
    with pytest.raises(ArgumentError, match=r"do not fit 8-bit levels from -122 to 5 dBFS; use dtype float32"):
        USUAL.encode(amplitude)


def test_negative_zeros_and_noncontiguous_images_are_accepted():
    amplitude = np.array([[0.0, -0.0, 1.0], [1.0, 0.5, 0.1]], np.float32)
    np.testing.assert_array_equal(USUAL.encode(amplitude)[0], [0, 0, 245])
    np.testing.assert_array_equal(USUAL.encode(amplitude.T), USUAL.encode(amplitude).T)
    assert USUAL.encode(np.zeros((0, 4), np.float32)).shape == (0, 4)


@pytest.mark.parametrize(
    ("highest_dbfs", "headroom_db", "top_db"),
    [
        *[(-20.0, 0.0, 5.0), (5.0, 0.0, 5.0), (5.1, 0.0, 5.5), (40.2, 0.0, 40.5), (-130.0, 0.0, -130.0)],
        *[(-20.0, 12.0, 5.0), (0.0, 12.0, 12.0), (-130.0, 12.0, 5.0)],
    ],
)
def test_scale_fits_the_image(highest_dbfs, headroom_db, top_db):
    """Louder images raise it; a single quieter one lowers it, but not the first of many."""
    highest = np.array([[0.0, 10 ** ((highest_dbfs - 1e-4) / 20)]], np.float32)
    levels = LevelCodes.of(highest, headroom_db=headroom_db)
    assert (levels.top_db, levels.step_db) == (top_db, 0.5)
    levels.encode(highest)


@pytest.mark.parametrize("highest", [0.0, np.nan, np.inf])
def test_images_without_a_level_have_the_usual_scale(highest):
    assert LevelCodes.of(np.full((1, 2), highest, np.float32)) == USUAL


def test_levels_near_zero_are_below_the_floor():
    amplitude = np.array([[0.0, 1e-40, 1e-45]], dtype=np.float32)
    codes = LevelCodes.of(amplitude)
    assert LevelCodes.checked(*codes, "message") == codes
    assert not codes.encode(amplitude).any()


def test_other_types_have_no_scale():
    amplitude = np.full((2, 3), 0.1, np.float32)
    same, none = as_dtype(amplitude, "float32")
    assert same is amplitude
    assert none is None
    assert as_dtype(amplitude, "float16")[0].dtype == np.float16
    codes, levels = as_dtype(amplitude, "uint8")
    np.testing.assert_allclose(levels.decode(codes), amplitude, rtol=0.03)


@pytest.mark.parametrize(
    ("floor_db", "step_db"),
    [(None, 0.5), (-122.0, None), (np.nan, 0.5), (-122.0, 0.0), (-122.0, -0.5), (-1e9, 0.5), (-122.0, 11.0), ("", "")],
)
def test_unknown_scales_are_refused(floor_db, step_db):
    with pytest.raises(DataError, match=r"a file has 8-bit levels from .* dB in steps of .* dB; state finite numbers"):
        LevelCodes.checked(floor_db, step_db, "a file")

"""Argument errors state the value, the accepted values and the remedy in one line."""

import math

import numpy as np
import pytest

from ertis_numba.base import checks, errors
from ertis_numba.base.errors import ArgumentError

REFUSED = [
    (checks.finite, ("x", math.nan), "x is nan; use a finite number"),
    (checks.finite, ("x", -math.inf), "x is -inf; use a finite number"),
    (checks.finite, ("x", "3"), "x is '3'; use a number"),
    (checks.finite, ("x", True), "x is True; use a number"),
    (checks.finite, ("x", None), "x is None; use a number"),
    (checks.finite, ("x", 10**400), "x is inf; use a finite number"),
    (checks.positive, ("x", 0), "x is 0; use a number above 0"),
    (checks.positive, ("x", -1.5), "x is -1.5; use a number above 0"),
    (checks.between, ("x", 3, 0, 2), "x is 3; use a number from 0 to 2"),
    (checks.between, ("x", -0.1, 0, 2), "x is -0.1; use a number from 0 to 2"),
    (checks.between, ("x", math.nan, 0, 2), "x is nan; use a finite number"),
    (checks.interval, ("x", (2.0, 1.0), 0, 5), "x runs from 2 to 1; use the smaller number first"),
    (checks.interval, ("x", (0.0, 6.0), 0, 5), "x is 6; use a number from 0 to 5"),
    (checks.integer, ("x", 1.0, 0), "x is 1.0; use a whole number"),
    (checks.integer, ("x", True, 0), "x is True; use a whole number"),
    (checks.integer, ("x", -1, 0), "x is -1; use a whole number of at least 0"),
    (checks.integer, ("x", 9, 0, 8), "x is 9; use a whole number from 0 to 8"),
    (checks.choice, ("layout", "eRTIS_v3D", ["eRTIS_v2", "eRTIS_v3D1"]), "did you mean 'eRTIS_v3D1'"),
    (checks.choice, ("device", "abacus", ["cpu"]), "device 'abacus' is unknown; known are cpu"),
    (checks.finite_array, ("x", np.array([[0.0, 1.0], [np.nan, 2.0]])), "x holds nan at [1, 0]; pass finite numbers"),
    (checks.finite_array, ("x", np.array([np.inf])), "x holds inf at [0]; pass finite numbers"),
    (checks.shape, ("x", (2,), (3, 4)), "x has shape (2,); pass shape (3, 4)"),
]


@pytest.mark.parametrize(("check", "arguments", "message"), REFUSED)
def test_check_rejects_invalid_value_in_one_line(check, arguments, message):
    with pytest.raises(ArgumentError) as caught:
        check(*arguments)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_checks_return_valid_values():
    assert checks.finite("x", 2) == 2.0
    assert isinstance(checks.finite("x", np.float32(2)), float)
    assert checks.positive("x", 1e-300) == 1e-300
    assert checks.between("x", 2, 0, 2) == 2.0
    assert checks.integer("x", np.int64(7), 0) == 7
    assert isinstance(checks.integer("x", np.int64(7), 0), int)
    checks.interval("x", (1.0, 1.0), 0, 5)
    checks.choice("x", 32, (8, 32))
    checks.finite_array("x", np.zeros(0))
    checks.shape("x", (2, 3), (2, 3))


def test_reason_unreadable_states_the_reason_without_the_path():
    error = FileNotFoundError(2, "No such file or directory", "array.csv")
    assert checks.reason_unreadable(error) == "No such file or directory"


def test_errors_derive_from_standard_exceptions():
    assert issubclass(errors.ArgumentError, ValueError)
    assert issubclass(errors.SettingsError, errors.ArgumentError)
    assert issubclass(errors.FormatVersionError, errors.DataError)
    assert issubclass(errors.DataError, ValueError)
    assert issubclass(errors.DeviceError, RuntimeError)
    for name in errors.__all__:
        assert issubclass(getattr(errors, name), errors.ErtisError | UserWarning)

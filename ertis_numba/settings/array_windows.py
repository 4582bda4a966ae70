"""Window functions of ``processing.array_weights``."""

from typing import Final, NamedTuple

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["WINDOWS", "ArrayWindow", "parse_window"]


class _Parameter(NamedTuple):
    default: float
    low: float
    high: float


WINDOWS: Final[dict[str, _Parameter | None]] = {
    "uniform": None,
    "cosine": None,
    "hann": None,
    "hamming": None,
    "blackman": None,
    "taylor": _Parameter(30.0, 20.0, 80.0),
    "kaiser": _Parameter(6.0, 0.0, 20.0),
}
"""Windows with the default and limits of their parameter: side-lobe attenuation in dB for Taylor, beta for Kaiser."""


class ArrayWindow(NamedTuple):
    """Window and its parameter; 0 if it has none."""

    window: str
    parameter: float


def parse_window(name: str) -> ArrayWindow:
    """Parse the name of a window, such as ``hann`` or ``taylor:35``."""
    window, colon, given = name.partition(":")
    checks.choice("processing.array_weights", window, WINDOWS)
    parameter = WINDOWS[window]
    if parameter is None:
        if colon:
            raise ArgumentError(
                f"processing.array_weights is {name[:80]!r} although the window {window} has no parameter; use "
                f"{window!r}"
            )
        return ArrayWindow(window, 0.0)
    if not colon:
        return ArrayWindow(window, parameter.default)
    try:
        value = float(given)
    except ValueError:
        raise ArgumentError(
            f"processing.array_weights is {name[:80]!r}; use a number after the colon, such as "
            f"'{window}:{parameter.default:g}'"
        ) from None
    return ArrayWindow(window, checks.between(f"parameter of processing.array_weights {window}", value, *parameter[1:]))

"""Arguments of scripts for RTIS Dev as arrays and numbers; errors name the argument, its value and the remedy."""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["as_array", "delay_matrix", "disabled", "filter_taps", "rows", "spectra", "text", "whole", "words"]

_MAX_DELAY: Final = 2**31 - 1
_WORD_BYTES: Final = 4
Real = NDArray[np.float32]


def as_array(name: str, given: ArrayLike, kinds: str = "iuf") -> NDArray[Any]:
    """Return an array of numbers of the kinds ``kinds``, which are those of `numpy.dtype.kind`."""
    try:
        array = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"the rows of {name} differ in length; pass rows of equal length") from error
    if array.dtype.kind not in kinds:
        # An object may have a long text.
        kind = f"of type {type(given).__name__}" if array.dtype.kind == "O" else f"of {array.dtype}"
        raise ArgumentError(f"{name} is {kind}; pass an array of {'real' if 'f' in kinds else 'whole'} numbers")
    return array


def whole(name: str, given: Any, low: int, high: int | None = None) -> int:
    """Return a whole number of any type, such as 3.0 or an array of one number."""
    array = as_array(name, given, "biuf")
    if array.size != 1:
        raise ArgumentError(f"{name} has shape {array.shape}; pass one whole number")
    number = array.reshape(-1)[0].item()
    if isinstance(number, float) and not number.is_integer():
        raise ArgumentError(f"{name} is {number}; use a whole number")
    return checks.integer(name, int(number), low, high)


def text(name: str, given: Any) -> str:
    """Return a text."""
    if not isinstance(given, str):
        raise ArgumentError(f"{name} is of type {type(given).__name__}; pass a string")
    return given


def filter_taps(name: str, given: ArrayLike) -> Real:
    """Return the taps of a filter, which may be a row or a column."""
    array = as_array(name, given)
    if array.size == 0 or array.size != max(array.shape, default=1):
        raise ArgumentError(f"{name} has shape {array.shape}; pass a row of taps")
    return _single(name, array.reshape(-1))


def spectra(real: ArrayLike, imag: ArrayLike) -> NDArray[np.complex64]:
    """Return the matched filter of its two parts."""
    parts = [as_array(f"matched_filter_{name}", part) for name, part in (("real", real), ("imag", imag))]
    if parts[0].shape != parts[1].shape:
        raise ArgumentError(
            f"matched_filter_real has shape {parts[0].shape}, but matched_filter_imag {parts[1].shape}; pass equal "
            "shapes"
        )
    made = np.empty(parts[0].shape, np.complex64)
    made.real, made.imag = _single("matched_filter_real", parts[0]), _single("matched_filter_imag", parts[1])
    return made


def delay_matrix(given: ArrayLike) -> NDArray[np.int32]:
    """Return the delays of a matrix with a row for each microphone, (direction, mic) int32."""
    array = as_array("delay_matrix", given)
    checks.finite_array("delay_matrix", array)
    if np.any(array != np.rint(array)):
        raise ArgumentError("delay_matrix holds fractions; use whole numbers of samples")
    if array.size and np.abs(array).max() > _MAX_DELAY:
        raise ArgumentError(f"delay_matrix holds {np.abs(array).max():g}; pass numbers of samples within the record")
    return np.ascontiguousarray(array.T, dtype=np.int32)


def disabled(given: ArrayLike, n_mics: int) -> tuple[int, ...]:
    """Return the microphones to exclude; RTIS Dev fills the list with numbers above the last microphone."""
    array = as_array("disabled_microphones", given)
    found = {whole("disabled_microphones", number, 0) for number in array.reshape(-1)}
    return tuple(sorted(mic for mic in found if mic < n_mics))


def words(given: ArrayLike, n_samples: int) -> NDArray[np.uint32]:
    """Return PDM words (sample, 1) by value, in any byte order; 8- or 16-bit integers are parts, the lowest first."""
    array = given if isinstance(given, np.ndarray) else as_array("the measurement", given)
    if array.dtype.kind not in "iu" or array.dtype.itemsize > _WORD_BYTES or array.nbytes != _WORD_BYTES * n_samples:
        raise ArgumentError(f"the measurement is {array.dtype} of shape {array.shape}; use {n_samples} words of uint32")
    parts = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).reshape(-1)
    return parts.view("<u4").astype(np.uint32, copy=False).reshape(-1, 1)


def rows(given: ArrayLike, n_rows: int) -> Real:
    """Return a copy of the result of an earlier stage, (row, sample) float32."""
    array = as_array("the data", given)
    if array.ndim != 2 or len(array) != n_rows or not array.size:
        raise ArgumentError(f"the data has shape {array.shape}; use {n_rows} rows of samples")
    return _single("the data", array).copy()


def _single(name: str, array: NDArray[Any]) -> Real:
    """Return finite numbers as float32."""
    checks.finite_array(name, array)
    with np.errstate(over="ignore"):  # The next check reports overflow.
        single = np.ascontiguousarray(array, dtype=np.float32)
    checks.finite_array(name, single)
    return single

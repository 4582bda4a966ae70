"""Layout files: microphone positions in TOML, text tables, NumPy arrays or XML, checked for their size and unit."""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.constants import MAX_MICROPHONES
from ertis_numba.base.errors import ArgumentError, LayoutUnitWarning, SettingsError
from ertis_numba.geometry.position_files import FLAT, layout_bytes, layout_file_text, read_position_file
from ertis_numba.geometry.position_headings import AXES
from ertis_numba.geometry.position_tables import HEADER_EXAMPLES
from ertis_numba.settings import LENGTH_UNITS_M, MAX_SPAN_M, MIN_SPAN_M, Array
from ertis_numba.settings.documents import TomlDocument

__all__ = ["LayoutFile", "ReadLayout", "parse_layout", "read_layout", "unclear_unit"]

_DEFAULT_UNIT: Final = "mm"
_HAS_SETTINGS: Final = re.compile(r"^\s*\[+(?:air|array|call|passive|processing|recording|sensors)\b", re.MULTILINE)
_LIKELY_SPAN_M: Final = 15e-3  # Smaller arrays are rare, so that they are questioned if their file states no unit.
_MIN_SPACING_M: Final = 2e-3  # Microphones are larger; the packages of MEMS microphones have 2.7 mm.
_SPLIT_ROW = re.compile(r"\[\s+((?:[-\d.e]+,\s+)+)\]")  # numbers of a list on lines of their own


class LayoutFile(TomlDocument, frozen=True, kw_only=True):
    """Microphones of an array: the complete content of a layout file.

    Attributes
    ----------
    positions_mm : list of (y, z) or (x, y, z), optional
        Positions in the sensor frame in millimetres, one per channel, in the order of the bits.
    positions : list of (y, z) or (x, y, z), optional
        Positions in the unit that ``unit`` names, instead of ``positions_mm``.
    unit : {"mm", "cm", "m", "in"}, optional
        Unit of ``positions``. The key ``positions_m`` is short for ``positions`` in metres.
    name : str
        Name in recordings and pictures; the name of the file by default.
    source : str
        Origin of the numbers, for readers of the file; empty by default.
    word_bits : {8, 16, 32, 64}
        Bits of one PDM word; 32 by default.
    disabled : tuple of int
        Channels without a microphone; none by default.
    gain : tuple of float, optional
        Calibrated sensitivity of each channel, 1 by default. Processing divides the signal by it.
    delay_s : tuple of float, optional
        Calibrated delay of each channel in seconds, 0 by default. Processing compensates for it.
    sensitivity_dbfs : float, optional
        Sensitivity of the microphones as in their data sheet: level of a sine of 94 dB, 1 Pa RMS, relative to a
        full-scale sine, -120 to 20 dBFS; unknown by default.
    emitter_diameter_m : float, optional
        Diameter of the emitter beside the array as a circular piston, 0 to 0.2 m; 0 is omnidirectional, and unknown by
        default.
    """

    positions_mm: list[list[float]] | None = None
    positions: list[list[float]] | None = None
    unit: str | None = None
    name: str = ""
    source: str = ""
    word_bits: int = 32
    disabled: tuple[int, ...] = ()
    gain: tuple[float, ...] | None = None
    delay_s: tuple[float, ...] | None = None
    sensitivity_dbfs: float | None = None
    emitter_diameter_m: float | None = None

    def to_toml(self) -> str:
        """Return TOML text with one position per line."""
        return _SPLIT_ROW.sub(lambda found: f"[{' '.join(found.group(1).split()).rstrip(',')}]", super().to_toml())

    @classmethod
    def _tables(cls, text: str) -> dict[str, Any]:
        """Read ``positions_m`` and the like as ``positions`` with their unit."""
        tables = super()._tables(text)
        for unit in LENGTH_UNITS_M:
            if f"positions_{unit}" not in cls.__struct_fields__ and tables.keys().isdisjoint({"positions", "unit"}):
                rows = tables.pop(f"positions_{unit}", None)
                tables |= {} if rows is None else {"positions": rows, "unit": unit}
        return tables

    def rows(self, source: str) -> tuple[list[list[float]], str]:
        """Return the positions and their unit, each stated once; ``source`` is the name of the file in errors."""
        if self.positions is not None and self.positions_mm is not None:
            raise ArgumentError(f"{source}: both positions and positions_mm; remove one")
        if self.unit is not None:
            checks.choice(f"{source}: unit", self.unit, LENGTH_UNITS_M)
        if self.positions_mm is not None:
            if self.unit not in {None, _DEFAULT_UNIT}:
                raise ArgumentError(
                    f"{source}: unit is {self.unit!r}, but positions_mm are in millimetres; rename positions_mm to "
                    "positions"
                )
            return self.positions_mm, _DEFAULT_UNIT
        if self.positions is None:
            raise ArgumentError(f"{source}: `positions_mm` is missing; add it, or `positions` and `unit`")
        if self.unit is None:
            raise ArgumentError(
                f'{source}: positions have no unit; are they millimetres or metres? Add unit = "mm", or another of '
                f"{', '.join(LENGTH_UNITS_M)}"
            )
        return self.positions, self.unit


@dataclass(frozen=True, slots=True)
class ReadLayout:
    """Array of a layout file, with notes for the user; ``unit_is_stated`` is False if the file states no unit."""

    array: Array
    notes: tuple[str, ...] = ()
    unit_is_stated: bool = True


def read_layout(path: str | Path) -> ReadLayout:
    """Read a layout file with one of the endings in `ertis_numba.settings.LAYOUT_SUFFIXES`."""
    content = layout_bytes(path)
    if Path(path).suffix.lower() == ".toml":
        return parse_layout(str(path), layout_file_text(path, content))
    found = read_position_file(path, content)
    source, factor_m = f"layout {path}", LENGTH_UNITS_M[found.unit or _DEFAULT_UNIT]
    positions_m = factor_m * found.positions
    every = np.ones(len(positions_m), dtype=np.bool_)
    if not found.unit:
        _require_clear_unit(source, found.positions)
    array = _checked(source, positions_m, every, LayoutFile(name=Path(path).stem))
    notes = [f"{source}: {note}" for note in found.notes]
    if Path(path).suffix.lower() != ".xml":
        notes += _lying(source, positions_m)
    if not found.unit and len(positions_m) > 1:
        may_be_m = float(np.ptp(found.positions, axis=0).max()) <= MAX_SPAN_M
        span = " × ".join(f"{1e3 * extent_m:.4g}" for extent_m in np.ptp(positions_m, axis=0))
        unit = "millimetres, not metres," if may_be_m else "millimetres"
        notes.append(
            f"{source} states no unit; {unit} are assumed, so the array spans {span} mm (x × y × z); if this is wrong, "
            f"{_remedy(source)}"
        )
        if may_be_m:
            warnings.warn(notes[-1], LayoutUnitWarning, stacklevel=2)
    return ReadLayout(array, tuple(notes), unit_is_stated=bool(found.unit))


def parse_layout(path: str, text: str) -> ReadLayout:
    """Return the array in the TOML text of a layout; ``path`` is the name of its file."""
    source = f"layout {path}"
    try:
        file = LayoutFile.from_toml(text, source)
    except SettingsError as error:
        if _HAS_SETTINGS.search(text):
            raise ArgumentError(
                f"{source} is a file of settings; load it as settings (settings), or move the keys of its array to a "
                "file of their own"
            ) from error
        raise
    rows, unit = file.rows(source)
    key = "positions_mm" if file.positions is None else "positions"
    if not rows or any(len(row) != len(rows[0]) or len(row) not in {2, 3} for row in rows):
        raise ArgumentError(
            f"{source}: {key} does not consist of rows of 2 or 3 numbers; write y, z or x, y, z for each channel"
        )
    positions_m = np.zeros((len(rows), len(AXES)))
    positions_m[:, len(AXES) - len(rows[0]) :] = LENGTH_UNITS_M[unit] * np.asarray(rows, dtype=np.float64)
    enabled = np.ones(len(rows), dtype=np.bool_)
    for channel in file.disabled:
        enabled[checks.integer(f"{source}: a disabled channel", channel, 0, len(rows) - 1)] = False
    checks.finite_array(f"{source}: {key}", np.where(enabled[:, None], positions_m, 0.0))
    array = _checked(source, positions_m, enabled, file if file.name else file.replace(name=path))
    if file.positions is None:
        _require_room(source, positions_m[enabled])
    return ReadLayout(array, _lying(source, positions_m[enabled]))


def _checked(source: str, positions_m: NDArray[np.float64], enabled: NDArray[np.bool_], file: LayoutFile) -> Array:
    """Return the validated array with the positions, and with the other keys of a layout file."""
    in_use_m = np.where(enabled[:, None], positions_m, 0.0)
    _require_span(source, positions_m[enabled])
    try:
        made = Array(
            layout=file.name,
            positions_m=tuple(tuple(row) for row in in_use_m.tolist()),
            enabled=tuple(enabled.tolist()),
            gain=file.gain,
            delay_s=file.delay_s,
            word_bits=file.word_bits,
            sensitivity_dbfs=file.sensitivity_dbfs,
            emitter_diameter_m=file.emitter_diameter_m,
        )
    except ArgumentError as error:
        raise ArgumentError(f"{source}: {error}") from error
    _require_apart(source, positions_m, np.flatnonzero(enabled))
    return made


def _remedy(source: str) -> str:
    """Return the way to state the unit of a file."""
    if source.lower().endswith(".toml"):
        return 'rename the key of the positions to positions, and set their unit, as in unit = "m"'
    if source.lower().endswith(".xml"):
        return "convert the positions in the file to metres"
    of_text = "" if source.lower().endswith((".csv", ".tsv", ".txt")) else "save a .csv file and "
    return f"{of_text}state the unit in a header, such as {HEADER_EXAMPLES}"


def _lying(source: str, positions_m: NDArray[np.float64]) -> tuple[str, ...]:
    """Return a note about an array in a horizontal plane, which other programs take for an array that faces z."""
    extent_m = np.ptp(positions_m, axis=0)
    if extent_m[2] > FLAT * extent_m.max() or extent_m[:2].min() <= FLAT * extent_m.max():
        return ()
    note = (
        f"{source}: the microphones lie in a horizontal plane, because x is forward, y left and z up; if x is to the "
        "right and y up in the file, seen from behind the array, convert the axes: x = -z, y = -x, z = y"
    )
    return (note,)


def _require_span(source: str, positions_m: NDArray[np.float64]) -> None:
    """Raise an error for an array that is smaller than microphones, or larger than any array."""
    if len(positions_m) < 2:
        return
    span_m = float(np.ptp(positions_m, axis=0).max())
    if 0 < span_m < MIN_SPAN_M or span_m > MAX_SPAN_M:
        limit = f"less than {1e3 * MIN_SPAN_M:g} mm" if span_m < MIN_SPAN_M else f"more than {MAX_SPAN_M:g} m"
        raise ArgumentError(
            f"{source}: the microphones span {_length(span_m)}, {limit}; if the numbers have another unit, "
            f"{_remedy(source)}"
        )


def _require_clear_unit(source: str, positions: NDArray[np.float64]) -> None:
    """Ask for the unit of numbers that can hardly be millimetres."""
    if not 1 < len(positions) <= MAX_MICROPHONES:
        return
    span = float(np.ptp(positions, axis=0).max())
    spacing_m = LENGTH_UNITS_M[_DEFAULT_UNIT] * _spacing(positions)
    span_m = LENGTH_UNITS_M[_DEFAULT_UNIT] * span
    if 0 < span_m < _LIKELY_SPAN_M or (spacing_m < _MIN_SPACING_M and span <= MAX_SPAN_M):
        raise ArgumentError(unclear_unit(source, span))


def _require_room(source: str, positions_m: NDArray[np.float64]) -> None:
    """Refuse ``positions_mm`` of microphones that would overlap, as metres in this key do."""
    if 1 < len(positions_m) <= MAX_MICROPHONES and (spacing_m := _spacing(positions_m)) < _MIN_SPACING_M:
        raise ArgumentError(
            f"{source}: two microphones are only {_length(spacing_m)} apart; if positions_mm are not in millimetres, "
            f'{_remedy(source)}; if they are, do the same with "mm"'
        )


def _spacing(positions: NDArray[np.float64]) -> float:
    """Return the smallest distance between microphones in different places; infinite if there is none."""
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)
    return float(apart[apart > 0].min(initial=np.inf))


def unclear_unit(source: str, span: float, reason: str = "") -> str:
    """Return the question for the unit of an array whose extent ``span`` is implausible in mm, for a ``reason``."""
    sizes = {unit: factor_m * span for unit, factor_m in LENGTH_UNITS_M.items()}
    likely = [
        f"{unit} ({_length(size_m)})"
        for unit, size_m in sizes.items()
        if unit != _DEFAULT_UNIT and _LIKELY_SPAN_M < size_m < MAX_SPAN_M
    ]
    numbers = " or ".join(likely) or "in another unit"
    return (
        f"{source} states no unit; in millimetres, the array would span only {_length(sizes[_DEFAULT_UNIT])}{reason}. "
        f"Are the numbers {numbers}? Then {_remedy(source)}; if not, state mm in the same way"
    )


def _length(length_m: float) -> str:
    """Return a length in a unit that suits it."""
    unit = "mm" if length_m < 0.1 else "m"
    return f"{length_m / LENGTH_UNITS_M[unit]:.3g} {unit}"


def _require_apart(source: str, positions_m: NDArray[np.float64], channels: NDArray[np.intp]) -> None:
    """Raise an error for two microphones in one place, which is probably a copied row that was not changed."""
    first: dict[tuple[float, ...], int] = {}
    for channel in channels.tolist():
        place = tuple(positions_m[channel].tolist())
        if first.setdefault(place, channel) != channel:
            raise ArgumentError(
                f"{source}: channels {first[place]} and {channel} have the same position; correct one of them, or "
                "disable one with the key 'disabled' of a .toml file"
            )

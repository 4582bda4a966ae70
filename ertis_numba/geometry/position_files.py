"""Files of microphone positions of other programs: text tables, NumPy arrays and arrays of Acoular."""

import io
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from ertis_numba.base import checks
from ertis_numba.base.csv_numbers import npy_content
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.position_headings import AXES
from ertis_numba.geometry.position_tables import PositionTable, read_position_table, require_no_count
from ertis_numba.geometry.shipped_layouts import layout_names

__all__ = ["FLAT", "SENSOR_FRAME", "layout_bytes", "layout_file_text", "read_position_file"]

SENSOR_FRAME: Final = "x forward, y left, z up"
"""Value of the attribute ``axes`` of an XML file in the sensor frame, which is not turned."""
_MAX_BYTES: Final = 4_000_000  # 1024 microphones with long names need 100,000 bytes.
_TURNED: Final = (
    "the array was turned from the axes of Acoular (seen from behind: x right, y up, facing -z) into the sensor frame "
    "(x forward, y left, z up)"
)
FLAT: Final = 1e-3
"""Extent of an axis, relative to the largest, below which an array counts as flat."""


def layout_bytes(path: str | Path) -> bytes:
    """Return the content of a layout file, which is neither empty nor too large."""
    try:
        with Path(path).open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise ArgumentError(f"layout {path}: {checks.reason_unreadable(error)}; {_remedy()}") from error
    if not content.strip():
        raise ArgumentError(f"layout {path}: the file is empty; {_remedy()}")
    if len(content) > _MAX_BYTES:
        raise ArgumentError(f"layout {path}: more than {_MAX_BYTES / 1e6:g} MB, too large for a layout; {_remedy()}")
    return content


def layout_file_text(path: str | Path, content: bytes) -> str:
    """Return the text of a layout file in UTF-8, UTF-16 with a byte order mark, or Windows-1252."""
    is_utf_16 = content[:2] in {b"\xff\xfe", b"\xfe\xff"}
    try:
        text = content.decode("utf-16" if is_utf_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        text = content.decode("cp1252", "replace")
        if not any(character.isdigit() for character in text):
            raise ArgumentError(f"layout {path}: {checks.reason_unreadable(error)}; {_remedy()}") from error
    if "\0" in text or "\N{REPLACEMENT CHARACTER}" in text:
        raise ArgumentError(f"layout {path}: the file is binary, not text; {_remedy('text')}")
    return text


def _remedy(wanted: str = "readable") -> str:
    return f"choose a {wanted} file or one of {', '.join(layout_names())}"


def read_position_file(path: str | Path, content: bytes) -> PositionTable:
    """Return the positions in a file other than TOML, by its ending."""
    source, suffix = f"layout {path}", Path(path).suffix.lower()
    if suffix == ".xml":
        return _of_acoular(source, content)
    if suffix == ".npy":
        return _of_numpy(source, content)
    return read_position_table(source, layout_file_text(path, content))


def _of_numpy(source: str, content: bytes) -> PositionTable:
    try:
        numbers = npy_content(io.BytesIO(content))
    except (OSError, ValueError) as error:
        raise ArgumentError(f"{source} is no array of NumPy; save the positions with numpy.save") from error
    if getattr(numbers, "ndim", 0) != 2 or numbers.shape[1] not in {2, 3} or numbers.dtype.kind not in "iuf":
        found = f"{numbers.dtype} of shape {numbers.shape}" if isinstance(numbers, np.ndarray) else "several arrays"
        raise ArgumentError(f"{source} contains {found}; save numbers of shape (channels, 2) or (channels, 3)")
    checks.finite_array(source, numbers.astype(np.float64))
    for place, (column, axis) in enumerate(zip(numbers.T.tolist(), AXES[-numbers.shape[1] :], strict=True)):
        require_no_count(source, [str(number) for number in column], place, axis)
    positions = np.zeros((len(numbers), len(AXES)))
    positions[:, len(AXES) - numbers.shape[1] :] = numbers
    return PositionTable(positions, "")


def _of_acoular(source: str, content: bytes) -> PositionTable:
    """Return the positions in an XML file for `acoular.MicGeom`, in metres and turned into the sensor frame."""
    # Acoular's arrays mostly lie in x and y, with sources at negative z and x to the right of an observer behind.
    try:
        root = ET.fromstring(content)  # noqa: S314  Expat limits the expansion of entities.
    except ET.ParseError as error:
        raise ArgumentError(
            f"{source}: not XML ({error}); use a file of Acoular with <MicArray>, or a .csv file"
        ) from error
    if root.tag != "MicArray":
        raise ArgumentError(f"{source} contains <{root.tag}> instead of <MicArray>; use a file of Acoular")
    rows = list(root.iter("pos"))
    if not rows:
        raise ArgumentError(f"{source} contains no <pos>; add one <pos Name= x= y= z=> per channel")
    positions = np.array([[_coordinate(source, row, place, axis) for axis in AXES] for place, row in enumerate(rows)])
    if root.get("axes") == SENSOR_FRAME:
        return PositionTable(positions, "m")
    extent = np.ptp(positions, axis=0)
    is_flat = extent < FLAT * extent.max()
    if is_flat[0] and not is_flat[2]:
        note = f"the array of Acoular lies in y and z, so it faces {AXES[0]}, and was not turned"
        return PositionTable(positions, "m", (note,))
    turned = np.column_stack([-positions[:, 2], -positions[:, 0], positions[:, 1]])
    return PositionTable(turned, "m", (_TURNED,))


def _coordinate(source: str, row: ET.Element, place: int, axis: str) -> float:
    text = row.get(axis, "")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise ArgumentError(f"{source}, <pos> {place + 1}: {axis} is {text!r:.40}; use a finite number in metres")
    return value

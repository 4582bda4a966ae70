"""Points as PLY, PCD and CSV.

The files follow G. Turk, The PLY Polygon File Format (1994); Point Cloud Library, The PCD (Point Cloud Data) file
format, version 0.7; and RFC 4180 for CSV, except that lines end with a line feed.
"""

import csv
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.interop._points import PointTable

__all__ = ["CSV_COLUMNS", "POINT_FIELDS", "write_csv", "write_pcd", "write_ply"]

POINT_FIELDS: Final = {
    "x": "<f8",
    "y": "<f8",
    "z": "<f8",
    "intensity": "<f4",
    "uncertainty_range": "<f4",
    "uncertainty_across": "<f4",
    "sensor": "<u2",
    "sequence": "<u4",
    "sec": "<i4",
    "nanosec": "<u4",
}
"""Fields of each point in PLY and PCD. Not all readers of these formats support 64-bit integers."""
_PLY_TYPES = {"<f4": "float", "<f8": "double", "<u2": "ushort", "<u4": "uint", "<i4": "int"}
CSV_COLUMNS: Final = {
    "sensor": "sensor",
    "session_id": "session_id",
    "sequence": "sequence",
    "sync_count": "sync_count",
    "timestamp_ns": "timestamp_ns",
    "x_m": "x",
    "y_m": "y",
    "z_m": "z",
    "amplitude": "intensity",
    "uncertainty_range_m": "uncertainty_range",
    "uncertainty_across_m": "uncertainty_across",
}
"""Columns of CSV, and their names in the table of points."""
_HEADING = "Point cloud of ertis-numba"


def write_ply(path: Path, table: PointTable, *, text: bool) -> None:
    """Write points as PLY, little-endian or text; refuse numbers beyond their type, and invalid names of sensors."""
    properties = [f"property {_PLY_TYPES[dtype]} {name}" for name, dtype in POINT_FIELDS.items()]
    head = [
        "ply",
        f"format {'ascii' if text else 'binary_little_endian'} 1.0",
        *(f"comment {line}" for line in _about(table)),
        f"element vertex {len(table.rows)}",
        *properties,
        "end_header",
    ]
    _write(path, head, table.columns(POINT_FIELDS), text=text)


def write_pcd(path: Path, table: PointTable, *, text: bool) -> None:
    """Write points as PCD 0.7, little-endian or text; refuse numbers beyond their type, and invalid names."""
    # PCL reads positions in float32 only. They are float64 if float32 would round one by more than 10 µm.
    fields = POINT_FIELDS | dict.fromkeys("xyz", "<f4" if table.fits_float32 else "<f8")
    kinds = [np.dtype(dtype) for dtype in fields.values()]
    count = len(table.rows)
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {line}" for line in _about(table)),
        "VERSION 0.7",
        f"FIELDS {' '.join(POINT_FIELDS)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",  # Identity: viewers transform the points by the viewpoint.
        f"POINTS {count}",
        f"DATA {'ascii' if text else 'binary'}",
    ]
    _write(path, head, table.columns(fields), text=text)


def write_csv(path: Path, table: PointTable) -> None:
    """Write points as CSV."""
    rows = table.rows
    names = np.array([*table.sensors, ""])[rows["sensor"]]
    columns = [names if column == "sensor" else _shortest(rows[column]) for column in CSV_COLUMNS.values()]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        writer.writerows(zip(*columns, strict=True))


def _shortest(column: NDArray[Any]) -> NDArray[np.str_]:
    """Return the shortest texts that read back as the same numbers, which are float32 if all of them fit it."""
    single = column.astype(np.float32) if column.dtype.kind == "f" else column
    return (single if np.array_equal(single, column, equal_nan=column.dtype.kind == "f") else column).astype(str)


def _about(table: PointTable) -> list[str]:
    """Return the comments of a header, each a key and its value; refuse names that would break a line."""
    numbered = [f"sensor {number} {checks.sensor_name(name)}" for number, name in enumerate(table.sensors)]
    return [_HEADING, f"frame {table.frame}", *numbered]


def _write(path: Path, head: list[str], rows: NDArray[np.void], *, text: bool) -> None:
    with path.open("wb") as file:
        file.write("\n".join([*head, ""]).encode("ascii"))
        if text:
            # NumPy writes the shortest text that reads back as the same number.
            columns = [rows[name].astype(str) for name in POINT_FIELDS]
            file.write("".join(f"{' '.join(row)}\n" for row in zip(*columns, strict=True)).encode("ascii"))
        else:
            file.write(rows.tobytes())

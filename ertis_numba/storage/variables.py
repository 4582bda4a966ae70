"""Variables and attributes in files: creation, and values of Python."""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

import h5py
import numpy as np

from ertis_numba.base.errors import ArgumentError
from ertis_numba.storage.schema import CHUNK_ROWS, Variable

__all__ = ["create_variables", "set_attributes", "text_type", "to_python"]

_TIME_CHUNK_ROWS: Final = 4096  # Applies to the axis, which programs read as a whole.


_MATRIX_CHUNK_ROWS: Final = 64  # Applies to columns with one matrix per measurement.


_COLUMN_TEXT_BYTES: Final = 64


_MAX_CHUNK_BYTES: Final = 2**32 - 1


_UNLIMITED: Final = ("time", "gap")


def create_variables(
    group: h5py.Group,
    table: Iterable[Variable],
    *,
    sizes: Mapping[str, int],
    dtypes: Mapping[str, str | np.dtype[Any]] | None = None,
    texts: Mapping[str, str] | None = None,
) -> None:
    """Create the variables of ``table`` in ``group``, with a named scale for each axis that does not exist yet."""
    # An axis without a length in `sizes` is omitted, unless it grows with the file. Samples or images are chunks.
    scales: dict[str, h5py.Dataset] = {}
    variables = [(variable, _dims(variable, sizes)) for variable in table]
    # Coordinates come first, so that the others find the scale of each axis.
    for variable, dims in sorted(variables, key=lambda pair: pair[1] != (pair[0].name,)):
        if not dims:
            text = (texts or {})[variable.name].encode()
            dataset = group.create_dataset(variable.name, (), text_type(len(text)), data=text)
        else:
            dtype = (dtypes or {}).get(variable.name, variable.dtype)
            dataset = _dataset(group, variable.name, dims, sizes, dtype)
        set_attributes(
            dataset, {"long_name": variable.description} | ({"units": variable.units} if variable.units else {})
        )
        if dims == (variable.name,):
            dataset.make_scale(variable.name)
            scales[variable.name] = dataset
            continue
        for axis, dim in enumerate(dims):
            if dim not in scales:
                exists = dim in group
                scales[dim] = group[dim] if exists else _scale_without_values(group, dim, sizes.get(dim, 0))
            dataset.dims[axis].attach_scale(scales[dim])


def _dims(variable: Variable, sizes: Mapping[str, int]) -> tuple[str, ...]:
    return tuple(dim for dim in variable.dims if dim in sizes or dim in _UNLIMITED)


def _dataset(
    group: h5py.Group, name: str, dims: tuple[str, ...], sizes: Mapping[str, int], dtype: str | np.dtype[Any]
) -> h5py.Dataset:
    kind = text_type(_COLUMN_TEXT_BYTES) if dtype == "str" else np.dtype(dtype)
    shape = tuple(sizes.get(dim, 0) for dim in dims)
    if dims[0] not in _UNLIMITED:
        return group.create_dataset(name, shape, kind)
    chunks = (_chunk_rows(name, dims), *shape[1:])
    if math.prod(chunks) * np.dtype(kind).itemsize > _MAX_CHUNK_BYTES:
        wanted = " × ".join(f"{size} {dim}s" for dim, size in zip(dims[1:], shape[1:], strict=True))
        raise ArgumentError(f"{name} of {wanted} exceeds the 4 GiB limit of HDF5 for one chunk; use fewer of them")
    return group.create_dataset(name, (0, *shape[1:]), kind, maxshape=(None, *shape[1:]), chunks=chunks)


def _chunk_rows(name: str, dims: tuple[str, ...]) -> int:
    """Return the number of measurements in a chunk."""
    if name.startswith("pose_"):
        return CHUNK_ROWS if len(dims) == 2 else _MATRIX_CHUNK_ROWS
    if len(dims) > 1:  # A row of samples or an image is large.
        return 1
    return _TIME_CHUNK_ROWS if name == "time" else CHUNK_ROWS


def _scale_without_values(group: h5py.Group, dim: str, size: int) -> h5py.Dataset:
    """Create the scale of an axis without values, as netCDF-4 does; it needs no space."""
    shape, growing = ((0,), {"maxshape": (None,), "chunks": (CHUNK_ROWS,)}) if dim in _UNLIMITED else ((size,), {})
    scale = group.create_dataset(dim, shape, np.dtype(">f4"), **growing)
    scale.make_scale(f"This is a netCDF dimension but not a netCDF variable. {size:10d}")
    return scale


def set_attributes(owner: h5py.File | h5py.Group | h5py.Dataset, attributes: Mapping[str, Any]) -> None:
    """Set attributes, with texts of a fixed length, as everywhere in these files.

    HDF5 stores texts of variable length in a heap without checksums, where a damaged length can block a reader forever.
    """
    for name, value in attributes.items():
        if isinstance(value, str):
            text = value.encode("utf-8", "backslashreplace")  # File names may not be valid text.
            owner.attrs.create(name, text, dtype=text_type(len(text)))
        else:
            owner.attrs[name] = value


def to_python(value: object) -> object:
    """Return the value of an attribute as a Python object; without data, an empty text or None."""
    if isinstance(value, h5py.Empty):
        return "" if value.dtype.kind in "SUO" else None
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def text_type(n_bytes: int) -> np.dtype[Any]:
    """Return the type of a UTF-8 text with a fixed length of ``n_bytes``, at least one."""
    made: np.dtype[Any] = h5py.string_dtype("utf-8", max(1, n_bytes))
    return made

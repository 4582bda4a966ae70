"""Bounded access to HDF5 files from untrusted sources.

HDF5 files can point into other files, and declare rows without storing them. A reader therefore compares declared sizes
with the stored data, so that the size of the file limits time and memory.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Any, Final

import h5py
import numpy as np

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DamagedError, ForeignDataError
from ertis_numba.settings import Settings
from ertis_numba.storage.schema import TRUTH, Variable

__all__ = ["local_member", "require_attributes", "require_variables", "sensors_of", "stored_bytes"]

MAX_SENSORS: Final = 1024  # Equal to the limit of a central node.
MAX_MEMBERS: Final = 256  # Limit on the members of a group: variables, and the scales of their axes.
MAX_ATTRIBUTES: Final = 256
MAX_ATTRIBUTE_BYTES: Final = 65_536
MAX_TEXT_BYTES: Final = {"settings": Settings.max_bytes, "scene": 16 * 2**20, "name": 4096, "pose_source": 1024}
MAX_COLUMN_TEXT_BYTES: Final = 64
MAX_COMPRESSION: Final = 1032  # Limit of deflate.
MAX_ROW_BYTES: Final = 2**32 - 1


def local_member(group: h5py.Group, name: str, kind: type[Any]) -> Any:
    """Return a member of a group; refuse links, other types and members with several names; raise KeyError for none."""
    link = group.get(name, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        raise ForeignDataError(
            f"{_path(group, name)} is a link into the file {link.filename[:200]!r}; copy the data into one file"
        )
    if isinstance(link, h5py.SoftLink):
        raise ForeignDataError(f"{_path(group, name)} is a link to {link.path[:200]!r}; copy the data to its place")
    found = group[name]
    if not isinstance(found, kind):
        raise DamagedError(
            f"{_path(group, name)} is a {type(found).__name__.lower()}, wanted a {kind.__name__.lower()}; copy it again"
        )
    if h5py.h5o.get_info(found.id).rc != 1:
        raise ForeignDataError(f"{_path(group, name)} has several names in the file; copy the data to each place")
    return found


def sensors_of(file: h5py.File) -> tuple[str, ...]:
    """Return the names of the sensors in a file, in its order."""
    group = local_member(file, "sensors", h5py.Group)
    if len(group) > MAX_SENSORS:
        raise DamagedError(f"{len(group)} sensors; the limit is {MAX_SENSORS}")
    try:
        return tuple(map(checks.sensor_name, group))
    except ArgumentError as error:
        raise DamagedError(str(error)) from error


def require_attributes(owner: h5py.File | h5py.Group) -> None:
    """Refuse an object with too many attributes, or with one that is too long."""
    n_attributes = h5py.h5a.get_num_attrs(owner.id)
    if n_attributes > MAX_ATTRIBUTES:
        raise DamagedError(f"{owner.name} has {n_attributes} attributes; the limit is {MAX_ATTRIBUTES}")
    for name in owner.attrs:
        attribute = owner.attrs.get_id(name)
        # NumPy lacks some of the types of other programs. The stored size of an attribute without data is an error.
        n_bytes = attribute.get_space().get_simple_extent_npoints() * attribute.get_type().get_size()
        if n_bytes and max(n_bytes, attribute.get_storage_size()) > MAX_ATTRIBUTE_BYTES:
            raise DamagedError(
                f"attribute {name[:80]!r} of {owner.name} has {n_bytes} bytes; the limit is {MAX_ATTRIBUTE_BYTES}"
            )


def require_variables(group: h5py.Group, table: Iterable[Variable]) -> None:
    """Refuse variables of a sensor that are not stored as this package stores them; missing ones are skipped."""
    if len(group) > MAX_MEMBERS:
        raise DamagedError(f"{group.name} has {len(group)} members; the limit is {MAX_MEMBERS}")
    require_attributes(group)
    room = group.file.id.get_filesize()
    for owner, variable in _members(group, table):
        dataset = local_member(owner, variable.name, h5py.Dataset)
        _require_kind(dataset, variable)
        room -= stored_bytes(dataset)
        if room < 0:
            raise DamagedError(
                f"{dataset.name} and the variables before it store more bytes than the file has; copy it again"
            )


def _members(group: h5py.Group, table: Iterable[Variable]) -> Iterator[tuple[h5py.Group, Variable]]:
    """Yield each variable of the table that exists, with its group."""
    for variable in table:
        if variable.name in group:
            yield group, variable
    if "truth" in group:
        truth = local_member(group, "truth", h5py.Group)
        require_attributes(truth)
        for variable in TRUTH:
            if variable.name in truth:
                yield truth, variable


def _require_kind(dataset: h5py.Dataset, variable: Variable) -> None:
    """Refuse a type or a number of axes that differs from the table."""
    dtype, is_text = dataset.dtype, variable.dtype == "str"
    if is_text:
        largest = MAX_TEXT_BYTES.get(variable.name, MAX_COLUMN_TEXT_BYTES)
        fits = dtype.kind == "S" and dtype.itemsize <= largest
    else:  # In older files, some types have another size.
        kinds = "iuf" if not variable.dtype else "iu" if np.dtype(variable.dtype).kind in "iu" else "f"
        fits = dtype.kind in kinds and dtype.itemsize <= 8
    if not fits:
        wanted = f"text of up to {largest} bytes" if is_text else variable.dtype or "numbers"
        raise DamagedError(f"{dataset.name} holds {str(dtype)[:80]}, wanted {wanted}; copy it again")
    n_axes = len(variable.dims)
    # The word axis is left out if there is one word.
    if dataset.shape is None or not (dataset.ndim == n_axes or (variable.dims[2:] and dataset.ndim == n_axes - 1)):
        raise DamagedError(
            f"{dataset.name} has shape {dataset.shape}, wanted ({', '.join(variable.dims)}); copy it again"
        )
    if dataset.ndim > 1 and math.prod(dataset.shape[1:]) * dtype.itemsize > MAX_ROW_BYTES:
        raise DamagedError(f"{dataset.name} has rows of {dataset.shape[1:]}; the limit is {MAX_ROW_BYTES} bytes")


def stored_bytes(dataset: h5py.Dataset, *, may_be_filtered: bool = False) -> int:
    """Return the stored size of a dataset; refuse one that is in another file, compressed, or incomplete."""
    if dataset.is_virtual or dataset.external:
        raise ForeignDataError(f"{dataset.name} lies in other files; copy the data into one file")
    stored, wanted = dataset.id.get_storage_size(), dataset.size * dataset.dtype.itemsize
    if dataset.id.get_create_plist().get_nfilters():
        if not may_be_filtered:
            raise ForeignDataError(f"{dataset.name} is compressed or filtered; write it again without filters")
        stored *= MAX_COMPRESSION
    if stored < wanted:
        raise DamagedError(
            f"{dataset.name} has {wanted} bytes (shape {dataset.shape}), but the file holds {stored}; copy it again"
        )
    return int(stored)


def _path(group: h5py.Group, name: str) -> str:
    return f"{group.name.rstrip('/')}/{name}"

"""Check of parts of a recording that readers do not use: axes and attributes of all objects in the file."""

from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import h5py

from ertis_numba.base.errors import DamagedError, ForeignDataError
from ertis_numba.storage.schema import POSES, RECORDING, RECORDING_OF_PCM
from ertis_numba.storage.structure import require_attributes, stored_bytes

__all__ = ["find_damage"]

_MAX_BYTES: Final = 16 * 2**20  # Limit for a dataset that no table names.
_DIMS: Final = {variable.name: variable.dims for variable in (*RECORDING, *RECORDING_OF_PCM, *POSES)}
# Errors of h5py for damaged files.
_UNREADABLE: Final = (OSError, RuntimeError, LookupError, AttributeError, TypeError, ValueError)


def find_damage(path: Path) -> str:
    """Return the first damaged object of a file and its damage, as one line; empty if there is none.

    HDF5 stores checksums of everything except the references from variables to their axes. The check therefore compares
    them with the expected names of the axes.
    """
    place = "/"
    try:
        with h5py.File(path, "r") as file:
            names: list[str] = []
            file.visit(names.append)
            for place in ("/", *names):
                if wrong := _damage_of(file, file[place]):
                    return f"{place}: {wrong}"
    except ForeignDataError:
        raise
    except DamagedError as error:
        return str(error)
    except _UNREADABLE as error:
        reason = str(error.args[0]).partition("\n")[0] if error.args else type(error).__name__
        return f"{place} cannot be read ({reason})"
    return ""


def _damage_of(file: h5py.File, item: h5py.Group | h5py.Dataset) -> str:
    require_attributes(item)
    for name in item.attrs:
        with suppress(TypeError):  # Other programs add types without an equivalent in NumPy.
            item.attrs[name]
    for reference, axis in item.attrs.get("REFERENCE_LIST", ()):
        if item not in list(file[reference].dims[int(axis)].values()):
            return f"is not an axis of {file[reference].name}"
    if not isinstance(item, h5py.Dataset):
        return ""
    name = item.name.rpartition("/")[2]
    if name not in _DIMS and item.shape is not None and not _is_empty_scale(item):
        stored_bytes(item, may_be_filtered=True)
        if item.nbytes <= _MAX_BYTES:
            item[()]
    if "/truth/" in item.name or item.is_scale:
        return ""
    return _axes_mismatch(item, _DIMS.get(name, ()))


def _is_empty_scale(item: h5py.Dataset) -> bool:
    """Return True if a dataset is an axis without values, which stores nothing."""
    is_here = not (item.is_virtual or item.external)
    return bool(item.is_scale and is_here and not item.id.get_storage_size())


def _axes_mismatch(item: h5py.Dataset, wanted: tuple[str, ...]) -> str:
    found: list[Any] = [scale.name.rpartition("/")[2] for axis in item.dims for scale in axis.values()]
    dims = [dim for dim in wanted if dim in item.parent][: item.ndim]
    return "" if found == dims or not found or not dims else f"has axes {', '.join(found)}, wanted {', '.join(dims)}"

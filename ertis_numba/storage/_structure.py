"""Check of parts of a recording that readers do not use: axes and attributes of all objects in the file."""

from pathlib import Path
from typing import Any, Final

import h5py

from ertis_numba.storage.schema import RECORDING, RECORDING_OF_PCM

__all__ = ["fault_of"]

_MOST_VALUES: Final = 1_000_000  # of a dataset that no table names, such as an axis that only counts
_DIMS: Final = {variable.name: variable.dims for variable in (*RECORDING, *RECORDING_OF_PCM)}
_UNREADABLE: Final = (OSError, RuntimeError, LookupError, AttributeError, TypeError, ValueError)  # h5py on damage


def fault_of(path: Path) -> str:
    """Return the first damaged object of a file and its damage, as one line; empty if there is none.

    HDF5 has checksums of everything except the references from variables to their axes. These are therefore compared
    with the expected names of the axes.
    """
    place = "/"
    try:
        with h5py.File(path, "r") as file:
            names: list[str] = []
            file.visit(names.append)
            for place in ("/", *names):
                if wrong := _fault(file, file[place]):
                    return f"{place}: {wrong}"
    except _UNREADABLE as error:
        reason = str(error.args[0]).partition("\n")[0] if error.args else type(error).__name__
        return f"{place} cannot be read ({reason})"
    return ""


def _fault(file: h5py.File, item: h5py.Group | h5py.Dataset) -> str:
    for name in item.attrs:
        value = item.attrs[name]
        if name == "REFERENCE_LIST":
            for reference, axis in value:
                if item not in list(file[reference].dims[int(axis)].values()):
                    return f"is not an axis of {file[reference].name}"
    if not isinstance(item, h5py.Dataset):
        return ""
    name = item.name.rpartition("/")[2]
    if name not in _DIMS and item.size <= _MOST_VALUES:
        item[()]
    if "/truth/" in item.name or item.is_scale:
        return ""
    return _wrong_axes(item, _DIMS.get(name, ()))


def _wrong_axes(item: h5py.Dataset, wanted: tuple[str, ...]) -> str:
    found: list[Any] = [scale.name.rpartition("/")[2] for axis in item.dims for scale in axis.values()]
    dims = [dim for dim in wanted if dim in item.parent][: item.ndim]
    return "" if found == dims or not found or not dims else f"has axes {', '.join(found)}, wanted {', '.join(dims)}"

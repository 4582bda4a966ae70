"""Files of occupancy maps."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import h5py
import numpy as np

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import atomic_write, reason, remedy
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError, FormatVersionError
from ertis_numba.frames import OccupancyMap
from ertis_numba.storage.opening import open_file, reading
from ertis_numba.storage.schema import (
    CONVENTIONS,
    FORMAT_VERSION,
    OCCUPANCY_MAP,
    VOXEL_MAP,
    Variable,
    content_sha256,
    content_uuid,
    date_created,
    software_versions,
)
from ertis_numba.storage.structure import require_attributes, require_variables
from ertis_numba.storage.truth import GroundTruth, read_truth, write_truth
from ertis_numba.storage.variables import create_variables, set_attributes, to_python

__all__ = ["is_map", "read_map", "read_map_truth", "write_map_file"]

_KIND: Final = "occupancy_map"
_NAME: Final = "an occupancy map"
_AXES: Final = ("x", "y", "z")
_COUNTS: Final = ("n_groups", "time_ns")


def write_map_file(
    path: str | Path, occupancy: OccupancyMap, *, truth: GroundTruth | None = None, overwrite: bool = False
) -> Path:
    """Write an occupancy map as HDF5, with the ground truth of each pulse in its frame; return the path."""
    checks.instance("occupancy", occupancy, OccupancyMap, "Mapper.map returns")
    axes, table = _AXES[: occupancy.n_dimensions], _table(occupancy.n_dimensions)
    sizes = dict(zip(axes, occupancy.log_odds.shape[::-1], strict=True))
    try:
        with (
            atomic_write(Path(path), overwrite=overwrite) as part,
            h5py.File(part, "w", track_order=True, libver=("v110", "v110")) as file,
        ):
            create_variables(file, table, sizes=sizes)
            for name, edge_m in zip(axes, occupancy.origin_m, strict=True):
                file[name][:] = edge_m + (np.arange(sizes[name]) + 0.5) * occupancy.cell_m
            file["log_odds"][:] = occupancy.log_odds
            if truth is not None:
                write_truth(file, truth, len(truth.reflectors))
            numbers = (occupancy.cell_m, *occupancy.origin_m, occupancy.n_groups, occupancy.time_ns)
            set_attributes(file, dict(zip(_numbers(axes), numbers, strict=True)))
            content = _content(file, axes)
            set_attributes(
                file,
                {
                    "Conventions": CONVENTIONS,
                    "ertis_format": _KIND,
                    "ertis_format_version": FORMAT_VERSION,
                    "date_created": date_created(),
                    "uuid": content_uuid({"": content}),
                    "content_sha256": content,
                    **{f"{name.replace('-', '_')}_version": version for name, version in software_versions().items()},
                },
            )
    except (OSError, RuntimeError) as error:  # h5py raises both when the disk fails.
        if isinstance(error, ArgumentError | DataError):
            raise
        raise DataError(f"{path} cannot be written ({reason(error)}); {remedy(error)}") from error
    return Path(path)


def is_map(path: str | Path) -> bool:
    """Return True for the file of an occupancy map; False for other files, also for missing or damaged ones."""
    try:
        with h5py.File(path, "r") as file:
            return bool(to_python(file.attrs.get("ertis_format", "")) == _KIND)
    except (OSError, RuntimeError, LookupError, TypeError, ValueError):
        return False


def read_map(path: str | Path) -> OccupancyMap:
    """Read an occupancy map from HDF5.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    DataError
        The file is not an occupancy map, is damaged or truncated.
    FormatVersionError
        A newer version wrote the file.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> written = ertis.OccupancyMap(np.ones((2, 3)), (0.0, 0.0), 0.05)
    >>> ertis.write_map("place.h5", written, overwrite=True)[0].name
    'place.h5'
    >>> ertis.read_map("place.h5").log_odds.shape
    (2, 3)
    """
    path = Path(path)
    with open_file(path, _NAME) as file, reading(file, path):
        require_attributes(file)
        _require_kind(file, path)
        axes = _AXES[: 3 if "z" in file else 2]
        require_variables(file, _table(len(axes)))
        if _content(file, axes) != to_python(file.attrs["content_sha256"]):
            raise DamagedError(f"{path}: the SHA-256 of the content differs from the stated one; copy it again")
        try:
            found = OccupancyMap(
                np.asarray(file["log_odds"][:]),
                tuple(float(file.attrs[f"origin_{name}_m"]) for name in axes),
                float(file.attrs["cell_m"]),
                int(file.attrs["n_groups"]),
                int(file.attrs["time_ns"]),
            )
        except ArgumentError as error:
            raise DamagedError(f"{path}: {error}") from error
        for name, edge_m, n_cells in zip(axes, found.origin_m, found.log_odds.shape[::-1], strict=True):
            stated_m = edge_m + (np.arange(n_cells) + 0.5) * found.cell_m
            if not np.allclose(stated_m, file[name][:], rtol=0, atol=1e-3 * found.cell_m):
                raise DamagedError(
                    f"{path}: cell_m or origin_{name}_m contradicts the positions of the cells in {name}; copy it again"
                )
        return found


def read_map_truth(path: str | Path) -> GroundTruth | None:
    """Read the ground truth of an occupancy map, one row per pulse; None if its recordings were not simulated."""
    path = Path(path)
    with open_file(path, _NAME) as file, reading(file, path):
        return read_truth(file)


def _table(n_dimensions: int) -> tuple[Variable, ...]:
    return OCCUPANCY_MAP if n_dimensions == 2 else VOXEL_MAP


def _numbers(axes: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the attributes with the place of the cells, and with counts."""
    return "cell_m", *(f"origin_{name}_m" for name in axes), *_COUNTS


def _content(file: h5py.File, axes: Sequence[str]) -> str:
    """Return the SHA-256 over the variables' SHA-256 and the numbers of a map, in hexadecimal."""
    digest = hashlib.sha256(bytes.fromhex(content_sha256(file, _table(len(axes)))))
    for name in _numbers(axes):
        digest.update(np.asarray(file.attrs[name], "<i8" if name in _COUNTS else "<f8").tobytes())
    return digest.hexdigest()


def _require_kind(file: h5py.File, path: Path) -> None:
    kind, version = (to_python(file.attrs.get(name, "")) for name in ("ertis_format", "ertis_format_version"))
    if kind != _KIND:
        raise DataError(f"{path} is HDF5, but not an occupancy map; choose a file of 'ertis map'")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise FormatVersionError(
            f"{path} has format version {version}, but this package reads up to {FORMAT_VERSION}; update ertis-numba"
        )

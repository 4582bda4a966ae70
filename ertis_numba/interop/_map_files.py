"""Occupancy maps in the formats of ROS and of point-cloud programs.

The picture follows map_server of ROS 2 (Nav2): PGM with a YAML file beside it, in the mode ``trinary``.
"""

import json
from pathlib import Path
from typing import Final

import numpy as np

from ertis_numba import checks
from ertis_numba.atomic_files import atomic_write, check_target, remedy
from ertis_numba.errors import ArgumentError, DataError, ErtisError
from ertis_numba.frames import FREE_BELOW, OCCUPIED_ABOVE, OccupancyMap
from ertis_numba.interop._mcap import map_mcap, require_mcap
from ertis_numba.storage import write_map_file

__all__ = ["MAP_SUFFIXES", "map_files", "write_map"]

MAP_SUFFIXES: Final = (".h5", ".mcap", ".pgm", ".ply")
"""Suffixes of the formats of occupancy maps."""
_PLANAR_SUFFIXES: Final = (".mcap", ".pgm")
# Grey levels of map_saver of ROS. The probability of a level is (255 - level) / 255.
_FREE, _UNKNOWN, _OCCUPIED = 254, 205, 0


def map_files(path: str | Path, *, n_dimensions: int = 2) -> tuple[Path, ...]:
    """Return the files of a map: for ``.pgm`` also that of its description, with the suffix ``.yaml``.

    Raises
    ------
    ArgumentError
        The suffix is unknown, its format does not support the dimensions of the map, or the packages for MCAP are not
        installed.
    """
    path = Path(path)
    checks.choice("suffix of the map", path.suffix.lower(), MAP_SUFFIXES)
    if n_dimensions == 3 and path.suffix.lower() in _PLANAR_SUFFIXES:
        raise ArgumentError(
            f"{path} would hold a map of two dimensions, but the map has three; give a name that ends in .h5 or .ply"
        )
    if path.suffix.lower() == ".mcap":
        require_mcap()
    return (path, path.with_suffix(".yaml")) if path.suffix.lower() == ".pgm" else (path,)


def write_map(path: str | Path, occupancy: OccupancyMap, *, overwrite: bool = False) -> tuple[Path, ...]:
    """Write an occupancy map; the suffix of the path chooses the format.

    ``.h5`` stores the log-odds, and `read_map` reads them. ``.pgm`` is a picture for map_server of ROS, with a
    ``.yaml`` beside it. ``.mcap`` holds the map as a message of ROS 2, nav_msgs/OccupancyGrid. ``.ply`` contains the
    centres of the occupied cells with their probability; those of a map of two dimensions are at height 0. Maps of
    three dimensions are written as ``.h5`` and ``.ply`` only.

    Parameters
    ----------
    path : str or Path
    occupancy : OccupancyMap
    overwrite : bool
        Replace existing files.

    Returns
    -------
    tuple of Path
        Written files.

    Raises
    ------
    ArgumentError
        The suffix is unknown, its format does not support the dimensions of the map, a file exists, or the packages for
        MCAP are not installed.
    DataError
        The disk is full or cannot be written.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> found = ertis.OccupancyMap(np.array([[0.0, 2.0, -2.0]]), (1.0, 0.0), 0.1)
    >>> [path.name for path in ertis.write_map("place.pgm", found, overwrite=True)]
    ['place.pgm', 'place.yaml']
    """
    checks.instance("occupancy", occupancy, OccupancyMap, "Mapper.map returns")
    paths = map_files(path, n_dimensions=occupancy.n_dimensions)
    for each in paths:
        check_target(each, overwrite=overwrite)
    if paths[0].suffix.lower() == ".h5":
        write_map_file(paths[0], occupancy, overwrite=overwrite)
        return paths
    try:
        for each, content in zip(paths, _contents(paths[0], occupancy), strict=True):
            with atomic_write(each, overwrite=overwrite) as part:
                part.write_bytes(content)
    except OSError as error:
        if isinstance(error, ErtisError):
            raise
        raise DataError(f"{path} cannot be written ({error.strerror or error}); {remedy(error)}") from error
    return paths


def _contents(path: Path, occupancy: OccupancyMap) -> tuple[bytes, ...]:
    """Return the content of each file of a map."""
    suffix = path.suffix.lower()
    if suffix == ".mcap":
        return (map_mcap(occupancy),)
    return (_ply(occupancy),) if suffix == ".ply" else (_pgm(occupancy), _yaml(path.name, occupancy))


def _pgm(occupancy: OccupancyMap) -> bytes:
    """Return a picture whose upper row is the one with the largest y."""
    grey = np.full(occupancy.log_odds.shape, _UNKNOWN, np.uint8)
    grey[occupancy.is_free] = _FREE
    grey[occupancy.is_occupied] = _OCCUPIED
    n_rows, n_columns = occupancy.log_odds.shape
    return f"P5\n{n_columns} {n_rows}\n255\n".encode("ascii") + grey[::-1].tobytes()


def _yaml(picture: str, occupancy: OccupancyMap) -> bytes:
    x_m, y_m = occupancy.origin_m
    lines = {
        "image": json.dumps(picture),  # A quoted text of JSON is one of YAML, too.
        "mode": "trinary",
        "resolution": repr(occupancy.cell_m),
        "origin": f"[{x_m!r}, {y_m!r}, 0.0]",
        "negate": 0,
        "occupied_thresh": OCCUPIED_ABOVE,
        "free_thresh": FREE_BELOW,
    }
    return "".join(f"{name}: {value}\n" for name, value in lines.items()).encode()


def _ply(occupancy: OccupancyMap) -> bytes:
    place_m = occupancy.occupied_m
    points = np.zeros(len(place_m), np.dtype([(name, "<f4") for name in ("x", "y", "z", "probability")]))
    for name, coordinate_m in zip(("x", "y", "z"), place_m.T, strict=False):  # A plane has no z.
        points[name] = coordinate_m
    points["probability"] = occupancy.probability[occupancy.is_occupied]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "comment Occupied cells of ertis-numba",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in points.dtype.names or ()),
        "end_header",
    ]
    return "\n".join([*head, ""]).encode("ascii") + points.tobytes()

"""Occupancy maps in the formats of ROS and of point-cloud programs.

The picture follows map_server of ROS 2 (Nav2): PGM with a YAML file beside it, in the mode ``trinary`` or ``raw``.
"""

import json
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import atomic_write, check_target, remedy
from ertis_numba.base.errors import ArgumentError, DataError, ErtisError
from ertis_numba.frames import FREE_BELOW, OCCUPIED_ABOVE, OccupancyMap
from ertis_numba.interop._mcap import map_mcap, require_mcap
from ertis_numba.interop.ros_messages import occupancy_values
from ertis_numba.storage import GroundTruth, write_map_file

__all__ = ["MAP_SUFFIXES", "map_files", "write_map"]

MAP_SUFFIXES: Final = (".h5", ".mcap", ".pgm", ".ply")
"""Suffixes of the formats of occupancy maps."""
_PLANAR_SUFFIXES: Final = (".mcap", ".pgm")
_GREY: Final = {-1: 128, 0: 254, 100: 0}
"""Grey levels of the values of a cell in the mode ``trinary``.

The probability of a level is (255 − level) / 255. That of 128 is far from both thresholds. The level 205 of map_saver
is unknown for the threshold 0.196 only, and free for 0.25, the threshold in newer files of Nav2.
"""


def map_files(path: str | Path, *, n_dimensions: int = 2, probabilities: bool = False) -> tuple[Path, ...]:
    """Return the files of a map: for ``.pgm`` also that of its description, with the suffix ``.yaml``."""
    path = Path(path)
    checks.file_ending("map", path, MAP_SUFFIXES)
    if n_dimensions == 3 and path.suffix.lower() in _PLANAR_SUFFIXES:
        raise ArgumentError(
            f"{path} would contain a two-dimensional map, but the map has three dimensions; choose a name that "
            "ends in .h5 or .ply"
        )
    if probabilities and path.suffix.lower() not in _PLANAR_SUFFIXES:
        raise ArgumentError(
            f"{path} holds probabilities in any case; leave out probabilities, or choose a name that ends in .mcap or "
            ".pgm"
        )
    if path.suffix.lower() == ".mcap":
        require_mcap()
    return (path, path.with_suffix(".yaml")) if path.suffix.lower() == ".pgm" else (path,)


def write_map(
    path: str | Path,
    occupancy: OccupancyMap,
    *,
    overwrite: bool = False,
    probabilities: bool = False,
    truth: GroundTruth | None = None,
) -> tuple[Path, ...]:
    """Write an occupancy map; the suffix of the path chooses the format.

    ``.h5`` stores the log-odds, and `read_map` reads them. ``.pgm`` is a picture for map_server of ROS, with a
    ``.yaml`` beside it. ``.mcap`` holds the map as a message of ROS 2, nav_msgs/msg/OccupancyGrid. In both, cells are
    occupied or free as by `OccupancyMap.is_occupied` and `OccupancyMap.is_free`, and otherwise unknown. ``.ply``
    contains the centres of the occupied cells with their probability; those of a map of two dimensions are at height 0.
    Maps of three dimensions are written as ``.h5`` and ``.ply`` only.

    Parameters
    ----------
    path : str or Path
    occupancy : OccupancyMap
    overwrite : bool
        Replace existing files.
    probabilities : bool
        Write the probability of each known cell in percent to ``.mcap``, and to ``.pgm`` in the mode ``raw``. With its
        default parameters, Nav2 takes all of these cells for free space.
    truth : GroundTruth, optional
        Ground truth of each pulse in the frame of the map, which only ``.h5`` stores.

    Returns
    -------
    tuple of Path
        Written files.

    Raises
    ------
    ArgumentError
        The suffix is unknown, its format does not support the dimensions of the map or the option ``probabilities``, a
        file exists, or the packages for MCAP are not installed.
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
    paths = map_files(path, n_dimensions=occupancy.n_dimensions, probabilities=probabilities)
    for each in paths:
        check_target(each, overwrite=overwrite)
    if paths[0].suffix.lower() == ".h5":
        write_map_file(paths[0], occupancy, truth=truth, overwrite=overwrite)
        return paths
    try:
        contents = _contents(paths[0], occupancy, probabilities=probabilities)
        for each, content in zip(paths, contents, strict=True):
            with atomic_write(each, overwrite=overwrite) as part:
                part.write_bytes(content)
    except OSError as error:
        if isinstance(error, ErtisError):
            raise
        raise DataError(f"{path} cannot be written ({error.strerror or error}); {remedy(error)}") from error
    return paths


def _contents(path: Path, occupancy: OccupancyMap, *, probabilities: bool) -> tuple[bytes, ...]:
    """Return the content of each file of a map."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return (_ply(occupancy),)
    if suffix == ".mcap":
        return (map_mcap(occupancy, probabilities=probabilities),)
    values = occupancy_values(occupancy, probabilities=probabilities)
    if probabilities:
        return _pgm(values.view(np.uint8)), _yaml(path.name, occupancy, "raw")  # −1 becomes 255, which is unknown.
    return _pgm(_grey_of(values)), _yaml(path.name, occupancy, "trinary")


def _grey_of(values: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Return the grey levels of the mode ``trinary``."""
    grey = np.zeros(values.shape, np.uint8)
    for value, level in _GREY.items():
        grey[values == value] = level
    return grey


def _pgm(grey: NDArray[np.uint8]) -> bytes:
    """Return a picture whose upper row is the one with the largest y."""
    n_rows, n_columns = grey.shape
    return f"P5\n{n_columns} {n_rows}\n255\n".encode("ascii") + grey[::-1].tobytes()


def _yaml(picture: str, occupancy: OccupancyMap, mode: str) -> bytes:
    x_m, y_m = map(_decimal, occupancy.origin_m)
    lines = {
        "image": json.dumps(picture),  # A quoted text of JSON is one of YAML, too.
        "mode": mode,
        "resolution": _decimal(occupancy.cell_m),
        "origin": f"[{x_m}, {y_m}, 0.0]",
        "negate": 0,
        "occupied_thresh": OCCUPIED_ABOVE,
        "free_thresh": FREE_BELOW,
    }
    return "".join(f"{name}: {value}\n" for name, value in lines.items()).encode()


def _decimal(number: float) -> str:
    """Return all digits of a number without an exponent, because YAML 1.1 takes 1e-05 for a text."""
    return np.format_float_positional(number, trim="0")


def _ply(occupancy: OccupancyMap) -> bytes:
    place_m = occupancy.occupied_m
    points = np.zeros(len(place_m), np.dtype([*((axis, "<f8") for axis in "xyz"), ("probability", "<f4")]))
    for name, coordinate_m in zip(("x", "y", "z"), place_m.T, strict=False):  # A plane has no z.
        points[name] = coordinate_m
    points["probability"] = occupancy.probability[occupancy.is_occupied]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "comment Occupied cells of ertis-numba",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        "property float probability",
        "end_header",
    ]
    return "\n".join([*head, ""]).encode("ascii") + points.tobytes()

"""Microphone layouts, direction grids and the delays between them.

The sensor frame: x forward (boresight), y to azimuth +90°, z up (elevation +90°). Positions are
taken from the centroid of the enabled microphones.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.documents import Document
from ertis_numba.errors import ArgumentError
from ertis_numba.settings import Array, Processing, Settings

__all__ = [
    "PAPER_GRIDS",
    "Grid",
    "Layout",
    "direction_grid",
    "far_field_delays",
    "layout_names",
    "load_layout",
    "microphones",
    "mounting",
    "self_contained",
    "spherical_delays",
    "storable",
    "unit_vectors",
]

_CENTRED_M = 1e-12  # of rounding, in the mean of positions that were centred before
_UNIT = 1e-6  # of deviation that rounding to six digits leaves

PAPER_GRIDS = {
    "90": ("2d:90", (-90.0, 90.0), (0.0, 0.0)),
    "1850": ("3d:1850", (-45.0, 45.0), (-45.0, 45.0)),
    "3000": ("3d:3000", (-90.0, 90.0), (-90.0, 90.0)),
}
"""The three grids of the paper: kind, azimuth limits and elevation limits in degrees."""


class _LayoutFile(Document, frozen=True, kw_only=True):
    """What a layout file may hold."""

    positions_mm: list[list[float]]
    name: str = ""
    source: str = ""
    word_bits: int = 32
    disabled: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The microphones of an array.

    Attributes
    ----------
    name : str
    positions_m : (channel, axis) float64
        From the centroid of the enabled microphones.
    enabled : (channel,) bool
    gain : (channel,) float64
        Calibrated sensitivity.
    delay_s : (channel,) float64
        Calibrated lateness.
    word_bits : int
    """

    name: str
    positions_m: NDArray[np.float64]
    enabled: NDArray[np.bool_]
    gain: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    word_bits: int

    @property
    def n_words(self) -> int:
        """Words per PDM sample."""
        return -(-len(self.enabled) // self.word_bits)

    @property
    def word_type(self) -> np.dtype[np.unsignedinteger[Any]]:
        """Type of a word, little-endian as it is stored and sent."""
        return np.dtype(f"<u{self.word_bits // 8}")

    def words_shape(self, n_samples: int) -> tuple[int, ...]:
        """Return the shape of a measurement's words: (sample,), or (sample, word) where there are several."""
        return (n_samples,) if self.n_words == 1 else (n_samples, self.n_words)

    @property
    def enabled_positions_m(self) -> NDArray[np.float64]:
        """Positions of the enabled microphones: (mic, axis) float64."""
        return self.positions_m[self.enabled]

    def to_array(self) -> Array:
        """Return settings that hold the positions themselves and so depend on no file."""
        return Array(
            layout=self.name,
            positions_m=tuple((float(x), float(y), float(z)) for x, y, z in self.positions_m),
            enabled=tuple(self.enabled.tolist()),
            gain=tuple(self.gain.tolist()),
            delay_s=tuple(self.delay_s.tolist()),
            word_bits=self.word_bits,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """The directions of an image.

    Attributes
    ----------
    azimuth_rad, elevation_rad : (direction,) float64
    """

    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.azimuth_rad)


def layout_names() -> tuple[str, ...]:
    """Return the names of the shipped layouts."""
    return tuple(sorted(item.name.removesuffix(".toml") for item in _shipped() if item.name.endswith(".toml")))


def _shipped() -> list[Traversable]:
    return list(resources.files("ertis_numba").joinpath("layouts").iterdir())


def load_layout(name: str | Path) -> Layout:
    """Return a shipped layout, or one from a ``.toml`` or ``.csv`` file.

    A CSV has one row per channel, ``y, z`` or ``x, y, z`` in millimetres, in the order of the bits.

    Parameters
    ----------
    name : str or Path
        One of `layout_names`, or a path.

    Returns
    -------
    Layout

    Raises
    ------
    ArgumentError
        The name is unknown, or the file cannot be read or used.
    """
    path = Path(name)
    if path.suffix.lower() not in {".toml", ".csv"}:
        checks.choice("layout", name, layout_names())
        text = resources.files("ertis_numba").joinpath("layouts", f"{name}.toml").read_text("utf-8")
        return _placed(str(name), _LayoutFile.from_toml(text, f"layout {name}"))
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ArgumentError(
            f"layout {name}: {error}; give a readable file or one of {', '.join(layout_names())}"
        ) from error
    if path.suffix.lower() == ".csv":
        return _placed(str(name), _LayoutFile(name=path.stem, positions_mm=_csv_rows(f"layout {name}", text)))
    return _placed(str(name), _LayoutFile.from_toml(text, f"layout {name}"))


def _csv_rows(source: str, text: str) -> list[list[float]]:
    rows = (line.split("#", 1)[0].strip() for line in text.splitlines())
    try:
        return [[float(cell) for cell in row.split(",")] for row in rows if row]
    except ValueError as error:
        raise ArgumentError(
            f"{source}: {error}; give rows of numbers parted by commas, and comments after #"
        ) from error


def _placed(source: str, file: _LayoutFile) -> Layout:
    rows = file.positions_mm
    if not rows or any(len(row) != len(rows[0]) or len(row) not in {2, 3} for row in rows):
        raise ArgumentError(
            f"layout {source}: positions_mm is not rows of 2 or 3 numbers; give y, z or x, y, z of each channel"
        )
    positions_m = np.zeros((len(rows), 3))
    positions_m[:, 3 - len(rows[0]) :] = np.asarray(rows, dtype=np.float64) / 1000
    enabled = np.ones(len(rows), dtype=np.bool_)
    for channel in file.disabled:
        enabled[checks.whole(f"layout {source}: a disabled channel", channel, 0, len(rows) - 1)] = False
    checks.finite_array(f"layout {source}: positions_mm", np.where(enabled[:, None], positions_m, 0.0))
    try:
        made = Array(
            layout=file.name or source,
            positions_m=tuple(tuple(row) for row in np.where(enabled[:, None], positions_m, 0.0).tolist()),
            enabled=tuple(enabled.tolist()),
            word_bits=file.word_bits,
        )
    except ArgumentError as error:
        raise ArgumentError(f"layout {source}: {error}") from error
    return microphones(made)


def microphones(array: Array) -> Layout:
    """Return the microphones that array settings describe, by position or by name.

    Parameters
    ----------
    array : Array

    Returns
    -------
    Layout
        Positions from the centroid of the enabled microphones.

    Raises
    ------
    ArgumentError
        The named layout is unknown or cannot be used.
    """
    if array.positions_m is None:
        return load_layout(array.layout)
    positions_m = np.asarray(array.positions_m, dtype=np.float64)
    enabled = np.ones(len(positions_m), dtype=np.bool_) if array.enabled is None else np.asarray(array.enabled)
    centre_m = positions_m[enabled].mean(axis=0)
    # Positions that are centred already stay as they are to the last bit, so that a layout read from
    # a recording gives the image that the named one gave.
    centre_m[np.abs(centre_m) < _CENTRED_M] = 0.0
    centred_m = np.where(enabled[:, None], positions_m - centre_m, 0.0)
    return Layout(
        name=array.layout,
        positions_m=centred_m,
        enabled=enabled,
        gain=np.ones(len(enabled)) if array.gain is None else np.asarray(array.gain, dtype=np.float64),
        delay_s=np.zeros(len(enabled)) if array.delay_s is None else np.asarray(array.delay_s, dtype=np.float64),
        word_bits=array.word_bits,
    )


def self_contained(settings: Settings) -> Settings:
    """Return settings whose microphones are written out, so that they depend on no layout file."""
    if settings.array.positions_m is not None:
        return settings
    return settings.replace(array=microphones(settings.array).to_array())


def storable(settings: Settings) -> Settings:
    """Return settings as a recording holds them, which depend on no file.

    Raises
    ------
    ArgumentError
        The directions are those of a file, or the layout cannot be used.
    """
    if settings.processing.directions.lower().endswith(".csv"):
        raise ArgumentError(
            f"processing.directions is the file {settings.processing.directions}, which a recording cannot hold; "
            "name a grid, and give the file when processing"
        )
    return self_contained(settings)


def mounting(
    sensor: str, translation_m: Sequence[float] = (0.0, 0.0, 0.0), rotation_xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
) -> dict[str, NDArray[np.float64]]:
    """Return where a sensor is and how it is turned, at the origin and not turned by default.

    Parameters
    ----------
    sensor : str
        Its name, for errors.
    translation_m : sequence of 3 float
        x, y, z.
    rotation_xyzw : sequence of 4 float
        The unit quaternion that turns the sensor frame into that of the surroundings.

    Returns
    -------
    dict of str to NDArray
        ``translation_m``: (3,) float64, and ``rotation_xyzw``: (4,) float64.

    Raises
    ------
    ArgumentError
        A number is missing or not finite, or the quaternion has not length 1.
    """
    made = {
        "translation_m": np.asarray(translation_m, dtype=np.float64),
        "rotation_xyzw": np.asarray(rotation_xyzw, dtype=np.float64),
    }
    for (name, values), size in zip(made.items(), (3, 4), strict=True):
        checks.shape(f"{name} of sensor {sensor}", values.shape, (size,))
        checks.finite_array(f"{name} of sensor {sensor}", values)
    length = float(np.linalg.norm(made["rotation_xyzw"]))
    if abs(length - 1) > _UNIT:
        raise ArgumentError(f"rotation_xyzw of sensor {sensor} has length {length:g}; give a unit quaternion")
    return made


def direction_grid(processing: Processing) -> Grid:
    """Return the directions that ``processing.directions`` names.

    ``90``, ``1850`` and ``3000`` are the paper's grids. ``2d:N`` is N azimuths in the horizontal
    plane, both limits included. ``3d:N`` is N cells of equal area between the limits, in rows of
    equal elevation. Anything else is the path of a CSV file of azimuth, elevation in degrees.

    Parameters
    ----------
    processing : Processing

    Returns
    -------
    Grid

    Raises
    ------
    ArgumentError
        The name is no grid and no readable file, or the grid is empty.
    """
    name = processing.directions
    kind, azimuth_deg, elevation_deg = PAPER_GRIDS.get(
        name, (name, processing.azimuth_limits_deg, processing.elevation_limits_deg)
    )
    head, colon, count = kind.partition(":")
    if head in {"2d", "3d"} and colon:
        if not count.isdecimal():
            raise ArgumentError(f"directions {name!r} has no count; give for instance {head}:181")
        n_directions = checks.whole(f"count of directions {name!r}", int(count), 1, 1_000_000)
        if head == "2d":
            return _planar_grid(n_directions, azimuth_deg)
        return _equal_area_grid(n_directions, azimuth_deg, elevation_deg)
    return _csv_grid(name)


def _planar_grid(n_directions: int, limits_deg: tuple[float, float]) -> Grid:
    if n_directions == 1:
        limits_deg = (sum(limits_deg) / 2,) * 2
    return Grid(np.radians(np.linspace(*limits_deg, n_directions)), np.zeros(n_directions))


def _equal_area_grid(
    n_directions: int, azimuth_limits_deg: tuple[float, float], elevation_limits_deg: tuple[float, float]
) -> Grid:
    """Rows of equal elevation, each cut into cells of equal area, after Leopardi's zonal partition.

    P. Leopardi, A partition of the unit sphere into regions of equal area and small diameter,
    ETNA 25 (2006). Here the zones end at the limits, so that the count is met exactly.
    """
    west, east = np.radians(azimuth_limits_deg)
    low, high = np.sin(np.radians(elevation_limits_deg))
    side_rad = math.sqrt((east - west) * (high - low) / n_directions) or 1.0
    span_rad = math.radians(elevation_limits_deg[1] - elevation_limits_deg[0])
    n_rows = min(n_directions, max(1, round(span_rad / side_rad))) if east > west else n_directions
    ideal = np.sin(np.radians(np.linspace(*elevation_limits_deg, n_rows + 1)))
    share = (ideal - low) / (high - low) if high > low else np.linspace(0.0, 1.0, n_rows + 1)
    edges = np.rint(share * n_directions).astype(int)  # whole cells below each row's edge
    azimuth_rad, elevation_rad = [], []
    for below, above in itertools.pairwise(edges):
        in_row = above - below
        if not in_row:
            continue
        middle = low + (high - low) * (below + above) / 2 / n_directions
        azimuth_rad.append(west + (east - west) * (np.arange(in_row) + 0.5) / in_row)
        elevation_rad.append(np.full(in_row, math.asin(min(1.0, max(-1.0, middle)))))
    return Grid(np.concatenate(azimuth_rad), np.concatenate(elevation_rad))


def _csv_grid(path: str) -> Grid:
    if Path(path).suffix.lower() != ".csv":
        raise ArgumentError(f"directions {path!r} is no grid; give {', '.join(PAPER_GRIDS)}, 2d:N, 3d:N or a .csv file")
    try:
        text = Path(path).read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ArgumentError(
            f"directions {path}: {error}; give a readable CSV of azimuth, elevation in degrees"
        ) from error
    rows = _csv_rows(f"directions {path}", text)
    if not rows or any(len(row) != 2 for row in rows):
        raise ArgumentError(f"directions {path} has not two numbers in every row; give azimuth, elevation in degrees")
    angles_rad = np.radians(np.asarray(rows))
    checks.finite_array(f"directions {path}", angles_rad)
    for row, (azimuth_deg, elevation_deg) in enumerate(rows):
        checks.between(f"directions {path}: azimuth in row {row}", azimuth_deg, -360.0, 360.0)
        checks.between(f"directions {path}: elevation in row {row}", elevation_deg, -90.0, 90.0)
    return Grid(angles_rad[:, 0].copy(), angles_rad[:, 1].copy())


def unit_vectors(azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions as unit vectors in the sensor frame.

    Parameters
    ----------
    azimuth_rad, elevation_rad : (direction,) float64

    Returns
    -------
    (direction, axis) float64
    """
    level = np.cos(elevation_rad)
    return np.stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1)


def far_field_delays(
    positions_m: NDArray[np.float64], directions: NDArray[np.float64], *, sound_speed_m_s: float
) -> NDArray[np.float64]:
    """Return when a plane wave reaches each microphone, after it passed the centroid.

    Parameters
    ----------
    positions_m : (mic, axis) float64
    directions : (direction, axis) float64
        Unit vectors towards the source.
    sound_speed_m_s : float

    Returns
    -------
    (direction, mic) float64
        ``−p·u / c`` in seconds.
    """
    return -(directions @ positions_m.T) / sound_speed_m_s


def spherical_delays(
    positions_m: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    range_m: float,
    sound_speed_m_s: float,
) -> NDArray[np.float64]:
    """Return when the echo of a point reaches each microphone, after it would reach the centroid.

    As `far_field_delays`, for a point at ``range_m``: ``(‖r u − p‖ − r) / c``.

    Parameters
    ----------
    positions_m : (mic, axis) float64
    directions : (direction, axis) float64
        Unit vectors towards the point.
    range_m : float
        Distance of the point from the centroid.
    sound_speed_m_s : float

    Returns
    -------
    (direction, mic) float64
        Seconds.
    """
    points_m = range_m * directions[:, None, :] - positions_m[None, :, :]
    return np.asarray((np.linalg.norm(points_m, axis=-1) - range_m) / sound_speed_m_s)

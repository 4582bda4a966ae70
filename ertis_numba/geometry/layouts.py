"""Microphone layouts from settings, files and the package itself."""

import functools
import re
from dataclasses import dataclass, replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.csv_numbers import csv_rows
from ertis_numba.documents import TomlDocument
from ertis_numba.errors import ArgumentError
from ertis_numba.geometry.grids import grid_count
from ertis_numba.settings import Array, Settings

__all__ = [
    "Layout",
    "LayoutFile",
    "layout_file",
    "layout_names",
    "layout_text",
    "load_layout",
    "microphones",
    "self_contained",
    "storable",
    "written_out",
]

_SMALLEST_M = 1e-3  # minimum size of an array: metres given instead of millimetres are below it
_FLAT_M = 1e-3  # extent along x below which an array counts as flat
_SPLIT_ROW = re.compile(r"\[\s+((?:[-\d.e]+,\s+)+)\]")  # numbers of a list on lines of their own
_CENTRED_M = 1e-12  # rounding error in the mean of centred positions


class LayoutFile(TomlDocument, frozen=True, kw_only=True):
    """Microphones of an array: the complete content of a layout file.

    Attributes
    ----------
    positions_mm : list of (y, z) or (x, y, z)
        Positions in the sensor frame in millimetres, one per channel, in the order of the bits.
    name : str
        Name in recordings and pictures; the name of the file by default.
    source : str
        Origin of the numbers, for readers of the file; empty by default.
    word_bits : {8, 16, 32, 64}
        Bits of one PDM word; 32 by default.
    disabled : tuple of int
        Channels without a microphone; none by default.
    gain : tuple of float, optional
        Calibrated sensitivity of each channel, 1 by default. Processing divides the signal by it.
    delay_s : tuple of float, optional
        Calibrated delay of each channel in seconds, 0 by default. Processing compensates for it.
    sensitivity_dbfs : float, optional
        Sensitivity of the microphones as in their data sheet: level of a sine of 94 dB, 1 Pa RMS, relative to a
        full-scale sine, -120 to 20 dBFS; unknown by default.
    """

    positions_mm: list[list[float]]
    name: str = ""
    source: str = ""
    word_bits: int = 32
    disabled: tuple[int, ...] = ()
    gain: tuple[float, ...] | None = None
    delay_s: tuple[float, ...] | None = None
    sensitivity_dbfs: float | None = None

    def to_toml(self) -> str:
        """Return TOML text with one position per line."""
        return _SPLIT_ROW.sub(lambda found: f"[{' '.join(found.group(1).split()).rstrip(',')}]", super().to_toml())


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Microphones of an array.

    Attributes
    ----------
    name : str
    positions_m : (channel, axis) float64
        Positions relative to the centroid of the enabled microphones, in metres.
    enabled : (channel,) bool
        True for channels with a microphone in use.
    gain : (channel,) float64
        Calibrated sensitivity.
    delay_s : (channel,) float64
        Calibrated delay in seconds.
    word_bits : int
        Bits of one PDM word.
    sensitivity_dbfs : float, optional
        Level of a sine of 94 dB relative to a full-scale sine; None, the default, if it is unknown.
    """

    name: str
    positions_m: NDArray[np.float64]
    enabled: NDArray[np.bool_]
    gain: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    word_bits: int
    sensitivity_dbfs: float | None = None

    @property
    def n_words(self) -> int:
        """Words per PDM sample."""
        return -(-len(self.enabled) // self.word_bits)

    @property
    def word_type(self) -> np.dtype[np.unsignedinteger[Any]]:
        """Type of a word, little-endian as it is stored and sent."""
        return np.dtype(f"<u{self.word_bits // 8}")

    @property
    def enabled_positions_m(self) -> NDArray[np.float64]:
        """Positions of the enabled microphones: (mic, axis) float64."""
        return self.positions_m[self.enabled]

    @property
    def is_flat(self) -> bool:
        """True if the enabled microphones lie in a plane perpendicular to x, and cannot distinguish front and back."""
        return bool(np.ptp(self.enabled_positions_m[:, 0]) < _FLAT_M)

    def to_array(self) -> Array:
        """Return array settings that contain the positions themselves, and depend on no file."""
        return Array(
            layout=self.name,
            positions_m=tuple((float(x), float(y), float(z)) for x, y, z in self.positions_m),
            enabled=tuple(self.enabled.tolist()),
            gain=tuple(self.gain.tolist()),
            delay_s=tuple(self.delay_s.tolist()),
            word_bits=self.word_bits,
            sensitivity_dbfs=self.sensitivity_dbfs,
        )


@functools.cache
def layout_names() -> tuple[str, ...]:
    """Return the names of the shipped layouts in alphabetical order.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> ertis.layout_names()[:3]
    ('eRTIS_v2', 'eRTIS_v2REC', 'eRTIS_v3D1')
    """
    return tuple(sorted(item.name.removesuffix(".toml") for item in _shipped() if item.name.endswith(".toml")))


def _shipped() -> list[Traversable]:
    return list(resources.files("ertis_numba").joinpath("layouts").iterdir())


def layout_text(name: str) -> str:
    """Return the TOML text of a shipped layout.

    Parameters
    ----------
    name : str
        One of `layout_names`.

    Raises
    ------
    ArgumentError
        The name is unknown.
    """
    checks.choice("layout", name, layout_names())
    return resources.files("ertis_numba").joinpath("layouts", f"{name}.toml").read_text("utf-8")


def layout_file(layout: Layout, *, name: str, source: str = "") -> LayoutFile:
    """Return the content of a layout file with the microphones of a layout, to 0.1 µm, 1 ps and six digits of gain.

    Parameters
    ----------
    layout : Layout
    name : str
        Name of the layout.
    source : str
        Origin of the numbers; empty by default.

    Examples
    --------
    >>> from ertis_numba.geometry import layout_file, load_layout
    >>> text = layout_file(load_layout("eRTIS_v2"), name="mine").to_toml()
    >>> text.splitlines()[1]
    '    [0.0, 22.0556, -14.2258],'
    """
    return LayoutFile(
        name=name,
        source=source,
        word_bits=layout.word_bits,
        positions_mm=np.round(1e3 * layout.positions_m, 4).tolist(),
        disabled=tuple(np.flatnonzero(~layout.enabled).tolist()),
        gain=tuple(np.round(layout.gain, 6).tolist()),
        delay_s=tuple(np.round(layout.delay_s, 12).tolist()),
        sensitivity_dbfs=layout.sensitivity_dbfs,
    )


def load_layout(name: str | Path) -> Layout:
    """Return a shipped layout, or one from a ``.toml`` or ``.csv`` file.

    A CSV file has one row per channel, ``y, z`` or ``x, y, z`` in millimetres, in the order of the bits.

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

    Examples
    --------
    >>> from ertis_numba.geometry import layout_names, load_layout
    >>> layout = load_layout(layout_names()[0])
    >>> layout.positions_m.shape == (len(layout.enabled), 3)
    True
    """
    path = Path(name)
    if path.suffix.lower() not in {".toml", ".csv"}:
        return microphones(_shipped_array(str(name)))
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = checks.reason_unreadable(error)
        raise ArgumentError(
            f"layout {name}: {reason}; give a readable file or one of {', '.join(layout_names())}"
        ) from error
    if path.suffix.lower() == ".csv":
        file = LayoutFile(name=path.stem, positions_mm=csv_rows(f"layout {name}", text))
    else:
        file = LayoutFile.from_toml(text, f"layout {name}")
    return microphones(_placed(str(name), file))


@functools.cache
def _shipped_array(name: str) -> Array:
    """Return a shipped layout; its file is read once."""
    return _placed(name, LayoutFile.from_toml(layout_text(name), f"layout {name}"))


def _placed(source: str, file: LayoutFile) -> Array:
    """Return the validated array of a layout file."""
    rows = file.positions_mm
    if not rows or any(len(row) != len(rows[0]) or len(row) not in {2, 3} for row in rows):
        raise ArgumentError(
            f"layout {source}: positions_mm does not consist of rows of 2 or 3 numbers; give y, z or x, y, z of each "
            "channel"
        )
    positions_m = np.zeros((len(rows), 3))
    positions_m[:, 3 - len(rows[0]) :] = np.asarray(rows, dtype=np.float64) / 1000
    enabled = np.ones(len(rows), dtype=np.bool_)
    for channel in file.disabled:
        enabled[checks.integer(f"layout {source}: a disabled channel", channel, 0, len(rows) - 1)] = False
    checks.finite_array(f"layout {source}: positions_mm", np.where(enabled[:, None], positions_m, 0.0))
    try:
        made = Array(
            layout=file.name or source,
            positions_m=tuple(tuple(row) for row in np.where(enabled[:, None], positions_m, 0.0).tolist()),
            enabled=tuple(enabled.tolist()),
            gain=file.gain,
            delay_s=file.delay_s,
            word_bits=file.word_bits,
            sensitivity_dbfs=file.sensitivity_dbfs,
        )
    except ArgumentError as error:
        raise ArgumentError(f"layout {source}: {error}") from error
    across_m = float(np.ptp(positions_m[enabled], axis=0).max(initial=0.0)) if enabled.any() else 0.0
    if enabled.sum() > 1 and across_m < _SMALLEST_M:
        raise ArgumentError(
            f"layout {source}: its microphones lie within {1e3 * across_m:.3g} mm, too close to distinguish "
            "directions; give positions in millimetres"
        )
    _require_apart(source, positions_m, np.flatnonzero(enabled))
    return made


def _require_apart(source: str, positions_m: NDArray[np.float64], channels: NDArray[np.intp]) -> None:
    """Raise an error for two microphones in one place, which is probably a copied row that was not changed."""
    first: dict[tuple[float, ...], int] = {}
    for channel in channels.tolist():
        place = tuple(positions_m[channel].tolist())
        if first.setdefault(place, channel) != channel:
            raise ArgumentError(
                f"layout {source}: channels {first[place]} and {channel} have the same position; correct one, or list "
                "it under 'disabled' in a .toml file"
            )


def microphones(array: Array) -> Layout:
    """Return the microphones that array settings describe, by position or by name.

    Parameters
    ----------
    array : Array

    Returns
    -------
    Layout
        Positions are relative to the centroid of the layout's microphones, including those in ``array.disabled``.

    Raises
    ------
    ArgumentError
        The named layout is unknown or cannot be used, ``array.disabled`` names a channel that it does not have, or no
        microphone remains.

    Examples
    --------
    >>> from ertis_numba.settings import Array
    >>> from ertis_numba.geometry import microphones
    >>> int(microphones(Array(disabled=(0, 1))).enabled.sum())
    30
    """
    fitted = _fitted(array)
    if not array.disabled:
        return fitted
    enabled = fitted.enabled.copy()
    for channel in array.disabled:
        enabled[checks.integer("array.disabled", channel, 0, len(enabled) - 1)] = False
    if not enabled.any():
        raise ArgumentError(f"array.disabled disables all {int(fitted.enabled.sum())} microphones; name fewer channels")
    return replace(fitted, enabled=enabled)


def _fitted(array: Array) -> Layout:
    """Return all microphones of an array, including the disabled ones."""
    if array.positions_m is None:
        named = load_layout(array.layout)
        if array.sensitivity_dbfs is None:
            return named
        return replace(named, sensitivity_dbfs=array.sensitivity_dbfs)
    positions_m = np.asarray(array.positions_m, dtype=np.float64)
    enabled = np.ones(len(positions_m), dtype=np.bool_) if array.enabled is None else np.asarray(array.enabled)
    centre_m = positions_m[enabled].mean(axis=0)
    # Positions that are already centred stay the same to the last bit, so that a layout from a recording yields the
    # same image as the named layout.
    centre_m[np.abs(centre_m) < _CENTRED_M] = 0.0
    centred_m = np.where(enabled[:, None], positions_m - centre_m, 0.0)
    return Layout(
        name=array.layout,
        positions_m=centred_m,
        enabled=enabled,
        gain=np.ones(len(enabled)) if array.gain is None else np.asarray(array.gain, dtype=np.float64),
        delay_s=np.zeros(len(enabled)) if array.delay_s is None else np.asarray(array.delay_s, dtype=np.float64),
        word_bits=array.word_bits,
        sensitivity_dbfs=array.sensitivity_dbfs,
    )


def written_out(array: Array) -> Array:
    """Return array settings with the positions of the microphones, so that they depend on no layout file.

    Raises
    ------
    ArgumentError
        The layout is unknown, or its file cannot be read or used.
    """
    if array.positions_m is not None:
        return array
    return _fitted(array).to_array().replace(disabled=array.disabled)


def self_contained(settings: Settings) -> Settings:
    """Return settings with the positions of the microphones, so that they depend on no layout file.

    Raises
    ------
    ArgumentError
        The layout is unknown, or its file cannot be read or used.

    Examples
    --------
    >>> from ertis_numba import Settings
    >>> from ertis_numba.geometry import self_contained
    >>> len(self_contained(Settings()).array.positions_m)
    32
    """
    array = written_out(settings.array)
    return settings if array is settings.array else settings.replace(array=array)


def storable(settings: Settings) -> Settings:
    """Return settings in the form that recordings contain, which depends on no file.

    Parameters
    ----------
    settings : Settings

    Returns
    -------
    Settings

    Raises
    ------
    ArgumentError
        Directions or delays are in a file, or the layout cannot be used.
    """
    if grid_count(settings.processing.directions) is None:
        raise ArgumentError(
            f"processing.directions is the file {settings.processing.directions}, but a recording cannot contain "
            "directions; name a grid, and give the file when processing"
        )
    if isinstance(delays := settings.processing.delay_matrix, str):
        raise ArgumentError(
            f"processing.delay_matrix is the file {delays}, but a recording cannot contain files; give the file when "
            "processing"
        )
    return self_contained(settings)

"""Microphone layouts from settings, files and the package itself."""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.grids import grid_count
from ertis_numba.geometry.layout_files import LayoutFile, parse_layout, read_layout, unclear_unit
from ertis_numba.geometry.shipped_layouts import layout_text
from ertis_numba.settings import LAYOUT_SUFFIXES, Array, Settings

__all__ = [
    "Layout",
    "layout_file",
    "load_layout",
    "microphones",
    "require_plausible_size",
    "self_contained",
    "storable",
    "written_out",
]

_FLAT_M = 1e-3  # extent along x below which an array counts as flat
_MIN_LARGE_M = 1.0  # Extent below which an array is plausible with any record.
_CENTRED_M = 1e-12  # rounding error in the mean of centred positions


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
    emitter_diameter_m : float, optional
        Diameter of the emitter beside the array, 0 if it is omnidirectional; None, the default, if it is unknown.
    notes : tuple of str
        Remarks about the file of the layout, such as a unit that it does not state; none by default.
    unit_is_stated : bool
        False for a file that states no unit, whose numbers are taken for millimetres; True by default.
    """

    name: str
    positions_m: NDArray[np.float64]
    enabled: NDArray[np.bool_]
    gain: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    word_bits: int
    sensitivity_dbfs: float | None = None
    emitter_diameter_m: float | None = None
    notes: tuple[str, ...] = ()
    unit_is_stated: bool = True

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
            emitter_diameter_m=self.emitter_diameter_m,
        )


def layout_file(layout: Layout, *, name: str, source: str = "") -> LayoutFile:
    """Return the content of a layout file with the microphones of a layout, to 0.1 µm, 1 ps and six digits of gain."""
    return LayoutFile(
        name=name,
        source=source,
        word_bits=layout.word_bits,
        positions_mm=(np.round(1e3 * layout.positions_m, 4) + 0.0).tolist(),  # without -0.0
        disabled=tuple(np.flatnonzero(~layout.enabled).tolist()),
        gain=tuple(np.round(layout.gain, 6).tolist()),
        delay_s=tuple(np.round(layout.delay_s, 12).tolist()),
        sensitivity_dbfs=layout.sensitivity_dbfs,
        emitter_diameter_m=layout.emitter_diameter_m,
    )


def load_layout(name: str | Path) -> Layout:
    r"""Return a shipped layout, or one from a file.

    A file has one row per channel, in the order of the bits. Its ending determines the format:

    - ``.csv``, ``.tsv``, ``.txt``: ``y, z`` or ``x, y, z``, in millimetres unless a header states another unit, as in
      ``y_m,z_m``. A header may also name the axes in another order.
    - ``.toml``: the keys of `ertis reference settings layout`.
    - ``.npy``: numbers of shape (channels, 2) or (channels, 3), in millimetres.
    - ``.xml``: an array of Acoular, in metres, which is turned into the sensor frame; see `Layout.notes`.

    Parameters
    ----------
    name : str or Path
        One of `layout_names`, or a path.

    Raises
    ------
    ArgumentError
        The name is unknown, the file cannot be read or used, or its unit or axes are unclear.

    Warns
    -----
    LayoutUnitWarning
        The file states no unit, and its numbers may be metres as well as millimetres.

    Examples
    --------
    >>> from ertis_numba.geometry import layout_names, load_layout
    >>> layout = load_layout(layout_names()[0])
    >>> layout.positions_m.shape == (len(layout.enabled), 3)
    True
    >>> from pathlib import Path
    >>> size = Path("bats.csv").write_text("x_m,y_m,z_m\n0,0,0\n0,1.2,0\n0,0,1.2\n")
    >>> float(load_layout("bats.csv").positions_m.max())
    0.8
    """
    suffix = Path(name).suffix.lower()
    if suffix in LAYOUT_SUFFIXES:
        file = read_layout(name)
        return replace(microphones(file.array), notes=file.notes, unit_is_stated=file.unit_is_stated)
    if suffix and Path(name).exists():
        raise ArgumentError(
            f"layout {name}: files that end in {suffix} cannot be read; save the positions as .csv with a header, "
            f"such as x_m,y_m,z_m, or in another format: {', '.join(LAYOUT_SUFFIXES)}"
        )
    return microphones(_shipped_array(str(name)))


@functools.cache
def _shipped_array(name: str) -> Array:
    """Return a shipped layout; its file is read once."""
    return parse_layout(name, layout_text(name)).array


def microphones(array: Array) -> Layout:
    """Return the microphones of an array, relative to the centroid of its layout, which includes ``array.disabled``."""
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
        given = {name: getattr(array, name) for name in ("sensitivity_dbfs", "emitter_diameter_m")}
        return replace(named, **{name: value for name, value in given.items() if value is not None})
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
        emitter_diameter_m=array.emitter_diameter_m,
    )


def written_out(array: Array) -> Array:
    """Return array settings with the positions of the microphones, so that they depend on no layout file."""
    if array.positions_m is not None:
        return array
    return _fitted(array).to_array().replace(disabled=array.disabled)


def self_contained(settings: Settings) -> Settings:
    """Return settings with the positions of the microphones, so that they depend on no layout file."""
    require_plausible_size(settings)
    array = written_out(settings.array)
    return settings if array is settings.array else settings.replace(array=array)


def require_plausible_size(settings: Settings) -> None:
    """Ask for the unit of an array whose size does not suit the sound that it receives."""
    # Raise ArgumentError below a third of the shortest wavelength without a unit, or above 1 m and the way of sound.
    layout, recording = microphones(settings.array), settings.recording
    speed_m_s = sound_speed_m_s(settings.air)
    span_m = float(np.ptp(layout.enabled_positions_m, axis=0).max())
    highest_hz = settings.call.high_frequency_hz
    if settings.processing.mode == "passive":
        highest_hz = min(settings.passive.extent_of(settings.recording)[1], recording.sample_rate_hz / 2)
    if not layout.unit_is_stated and 0 < span_m < speed_m_s / highest_hz / 3:
        reason = f", less than a third of the wavelength at {highest_hz / 1e3:g} kHz"
        raise ArgumentError(unclear_unit(f"layout {settings.array.layout}", 1e3 * span_m, reason))
    reach_m = speed_m_s * recording.duration_s
    if span_m > max(_MIN_LARGE_M, reach_m):
        raise ArgumentError(
            f"array {layout.name!r} spans {span_m:.3g} m, but sound travels only {reach_m:.3g} m in a record of "
            f"{1e3 * recording.duration_s:.3g} ms; if the positions are in millimetres, correct their unit, otherwise "
            "use longer records"
        )


def storable(settings: Settings) -> Settings:
    """Return settings in the form that recordings contain, which depends on no file."""
    if grid_count(settings.processing.directions) is None:
        raise ArgumentError(
            f"processing.directions is the file {settings.processing.directions}, but a recording cannot contain "
            "directions; use the name of a grid here, and the file when processing"
        )
    if isinstance(delays := settings.processing.delay_matrix, str):
        raise ArgumentError(
            f"processing.delay_matrix is the file {delays}, but a recording cannot contain files; use the file when "
            "processing"
        )
    return self_contained(settings)

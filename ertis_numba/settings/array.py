"""Microphone array: positions, calibration and word format."""

from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import numpy as np

from ertis_numba.base import checks
from ertis_numba.base.constants import MAX_MICROPHONES, MAX_NAME_LENGTH, WORD_BITS
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import EMITTER_M, Limits

__all__ = ["LAYOUT_SUFFIXES", "LENGTH_UNITS_M", "MAX_EMITTER_M", "MAX_SPAN_M", "MIN_SPAN_M", "OWN_ARRAY", "Array"]

LAYOUT_SUFFIXES: Final = (".toml", ".csv", ".tsv", ".txt", ".npy", ".xml")
"""Endings of layout files."""
LENGTH_UNITS_M: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
"""Units of positions in files, in metres."""
OWN_ARRAY: Final = "own array"
"""Name of an array whose positions have none."""
MIN_SPAN_M: Final = 2e-3
"""Smallest extent of an array; single microphones are larger than that."""
MAX_SPAN_M: Final = 25.0
"""Largest extent of an array. An array of 26 mm has a larger one if its millimetres are taken for metres."""
MAX_EMITTER_M: Final = EMITTER_M.high
"""Largest diameter of an emitter."""

_NAMED: Final = "eRTIS_v3D1"
_Coordinate = Annotated[float, Limits(-1e7, 1e7)]  # Positions may be in a grid of the Earth.


class Array(TomlTable, frozen=True, kw_only=True):
    """Microphone array of a sensor: positions, calibration and word format.

    Attributes
    ----------
    layout : str, default "eRTIS_v3D1"
        Name of a shipped layout, or the path of a layout file (.toml, .csv, .tsv, .txt, .npy, .xml). If ``positions_m``
        is given, only a label: the name of the settings file, or "own array", by default.
    positions_m : tuple of (x, y, z), optional, default None
        Microphone positions in the sensor frame in metres, one per channel, in the order of the bits.
    enabled : tuple of bool, optional, default None
        Channels that carry a microphone; all by default.
    gain : tuple of float, optional, default None
        Calibrated sensitivity of each channel, 0.001 to 1000; 1 by default. Signals are divided by it. A negative
        value, -1000 to -0.001, corrects inverted polarity.
    delay_s : tuple of float, optional, default None
        Calibrated delay of each channel in seconds; 0 by default. Images correct it.
    disabled : tuple of int, optional, default None
        Channels that images leave out although they carry a microphone, such as faulty ones; none by default. The
        origin of images stays the centre of the whole array.
    word_bits : {8, 16, 32, 64}, default 32
        Bits of one PDM word. An array with more channels has several words per sample.
    sensitivity_dbfs : float, optional, default None
        Sensitivity of the microphones as in their data sheet: level of a sine of 94 dB, 1 Pa RMS, relative to a
        full-scale sine, in dBFS. That of the layout by default; sound pressures are unknown without it.
    emitter_diameter_m : float, optional, default None
        Diameter of the emitter beside the array as a circular piston, in metres; 0 is omnidirectional. That of the
        layout by default. Fusion and maps assume 0.012 if it is unknown.
    """

    layout: str = ""
    positions_m: tuple[tuple[_Coordinate, _Coordinate, _Coordinate], ...] | None = None
    enabled: tuple[bool, ...] | None = None
    gain: tuple[Annotated[float, Limits(-1e3, 1e3)], ...] | None = None
    delay_s: tuple[Annotated[float, Limits(-1e-3, 1e-3)], ...] | None = None
    disabled: tuple[Annotated[int, Limits(0, MAX_MICROPHONES - 1)], ...] | None = None
    word_bits: int = 32
    sensitivity_dbfs: Annotated[float, Limits(-120.0, 20.0)] | None = None
    emitter_diameter_m: Annotated[float, EMITTER_M] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.layout:
            msgspec.structs.force_setattr(self, "layout", _NAMED if self.positions_m is None else OWN_ARRAY)
        checks.length("array.layout", self.layout, MAX_NAME_LENGTH)
        checks.choice("array.word_bits", checks.integer("array.word_bits", self.word_bits, 1), WORD_BITS)
        if self.positions_m is None:
            self._refuse_per_channel()
            return
        self._check_positions(self.positions_m)
        n_channels = len(self.positions_m)
        if self.enabled is not None:
            checks.shape("array.enabled", (len(self.enabled),), (n_channels,))
            if not any(self.enabled):
                raise ArgumentError("array.enabled is false for all channels; enable at least one")
        for name in ("gain", "delay_s"):
            if (values := getattr(self, name)) is not None:
                checks.shape(f"array.{name}", (len(values),), (n_channels,))
        for channel, gain in enumerate(self.gain or ()):
            checks.between(f"magnitude of array.gain[{channel}]", abs(gain), 1e-3, 1e3)

    def _refuse_per_channel(self) -> None:
        for name in ("enabled", "gain", "delay_s"):
            if getattr(self, name) is not None:
                raise ArgumentError(f"array.{name} is given without array.positions_m; use both or neither")

    @property
    def is_file(self) -> bool:
        """True if ``layout`` is the path of a layout file that has not been read."""
        return self.positions_m is None and Path(self.layout).suffix.lower() in LAYOUT_SUFFIXES

    def _completed(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Other positions need another name."""
        given = changes.get("positions_m")
        if given is None or np.array_equal(np.asarray(given, object), np.asarray(self.positions_m, object)):
            return changes
        return {"layout": OWN_ARRAY, **changes}

    def _check_positions(self, positions_m: tuple[tuple[float, float, float], ...]) -> None:
        checks.integer("number of array.positions_m", len(positions_m), 1, MAX_MICROPHONES)
        enabled = np.ones(len(positions_m), dtype=np.bool_) if self.enabled is None else np.asarray(self.enabled)
        if len(enabled) == len(positions_m) and enabled.any():
            span_m = float(np.ptp(np.asarray(positions_m)[enabled], axis=0).max())
            if span_m > MAX_SPAN_M:
                raise ArgumentError(
                    f"array.positions_m spans {span_m:.4g} m, more than {MAX_SPAN_M:g} m; if the numbers are "
                    "millimetres, divide them by 1000"
                )

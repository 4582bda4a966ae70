"""Sound sources other than echoes: tones, noise, other sonars and ambient noise."""

import itertools
import math
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Call
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import EMITTER_M, Limits
from ertis_numba.simulation.trajectory import Facing, Placed, direction

__all__ = ["Ambient", "Noise", "Sonar", "SoundSource", "Tone"]

Floats = NDArray[np.float64]
_FREQUENCY_HZ: Final = Limits(1.0, 1e6)
_LEVEL_DB: Final = Limits(-300.0, 60.0)
_SpectrumPoint = tuple[
    Annotated[float, _FREQUENCY_HZ._replace(part="frequency of {}")],
    Annotated[float, _LEVEL_DB._replace(part="level of {}")],
]
_MAX_HARMONICS = 64
_MAX_LEVELS = 1000  # of a spectrum
_STROUHAL: Final = 0.2
"""Frequency of the strongest noise of a jet, multiplied by its diameter and divided by its speed."""
_SONIC_JET_M_S: Final = 313.0
"""Speed of air in an orifice from 0.9 bar above ambient pressure: sonic, ``c √(2 / (γ + 1))`` for air at 20 °C."""


class SoundSource(Placed, frozen=True, kw_only=True):
    """Object that emits sound, equally in all directions or as a circular piston.

    Attributes
    ----------
    diameter_m : float
        Diameter of the source as a circular piston, in metres. 0, the default, emits equally in all directions.
    facing_deg : (azimuth, elevation), optional
        Direction of the piston's axis in the world frame, in degrees; towards the origin of the world by default.
    """

    diameter_m: Annotated[float, EMITTER_M] = 0.0
    facing_deg: Facing | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.facing_deg is not None and not self.diameter_m:
            name = self.label()
            raise ArgumentError(
                f"{name}.facing_deg is given, but a source without a diameter emits equally in all directions; "
                f"add {name}.diameter_m, or remove facing_deg"
            )

    def axis_at(self, time_s: float) -> Floats:
        """Return the unit vector along the axis of the piston at a time of the scene: (axis,) float64."""
        return direction(*self.facing_deg) if self.facing_deg is not None else self.towards_origin(time_s)


class Tone(SoundSource, frozen=True, kw_only=True):
    """Steady tone with harmonics, for example of a power supply, a fan or a bearing.

    Attributes
    ----------
    frequency_hz : float
        Frequency in hertz.
    level_db : float
        Amplitude at 1 m in decibels relative to full scale; −60 by default.
    harmonics_db : tuple of float
        Levels of the harmonics at 2, 3, … times the frequency, in decibels relative to the tone; none by default.
    modulation_hz : float, optional
        Rate at which the amplitude of the tone and its harmonics varies, such as the rate at which the balls of a
        bearing pass a defect; steady by default.
    modulation_depth : float
        Variation of the amplitude relative to its mean; 1 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Tone
    >>> Tone(frequency_hz=20e3, range_m=2.0, harmonics_db=(-6.0,)).partials()[0].tolist()
    [20000.0, 40000.0]
    """

    frequency_hz: Annotated[float, _FREQUENCY_HZ]
    level_db: Annotated[float, _LEVEL_DB] = -60.0
    harmonics_db: tuple[Annotated[float, _LEVEL_DB], ...] = ()
    modulation_hz: float | None = None
    modulation_depth: Annotated[float, Limits(0.0, 1.0)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.integer("number of tone.harmonics_db", len(self.harmonics_db), 0, _MAX_HARMONICS)
        if self.modulation_hz is not None:
            checks.between("tone.modulation_hz", self.modulation_hz, 1e-3, self.frequency_hz)
        elif self.modulation_depth != 1.0:
            raise ArgumentError(
                f"tone.modulation_depth is {self.modulation_depth:g}, but the tone is steady; add tone.modulation_hz, "
                "or remove modulation_depth"
            )

    def partials(self) -> tuple[Floats, NDArray[np.complex128]]:
        """Return frequencies and amplitudes (partial,) of the sound ``Im Σ a exp(2πi f t)`` at 1 m.

        A modulated tone ``(1 + m sin 2πgt) sin 2πft`` has two more partials at ``f ± g``, with the amplitudes ``∓ i m /
        2``.
        """
        order = np.arange(1, 2 + len(self.harmonics_db))
        frequency_hz = self.frequency_hz * order.astype(np.float64)
        amplitude = (10 ** ((self.level_db + np.array([0.0, *self.harmonics_db])) / 20)).astype(np.complex128)
        if self.modulation_hz is None:
            return frequency_hz, amplitude
        beside = np.asarray(0.5j * self.modulation_depth * amplitude, np.complex128)
        return (
            np.concatenate([frequency_hz, frequency_hz - self.modulation_hz, frequency_hz + self.modulation_hz]),
            np.concatenate([amplitude, beside, -beside]),
        )


class Noise(SoundSource, frozen=True, kw_only=True):
    """Source of broadband noise, for example of compressed air.

    Attributes
    ----------
    band_hz : (low, high)
        Band of the noise in hertz; 20 to 80 kHz by default.
    level_db : float
        RMS in the band at 1 m, in decibels relative to full scale; −60 by default.
    spectrum : {"white", "leak"} or tuple of (frequency_hz, level_db)
        Shape of the power density within the band: constant, that of a leak of compressed air, or levels in decibels
        at increasing frequencies, between which it is interpolated. ``white`` by default.
    orifice_m : float, optional
        Diameter of the hole of a leak in metres; required for a leak.

    Examples
    --------
    >>> from ertis_numba.simulation import Noise
    >>> Noise(range_m=2.0).band_hz
    (20000.0, 80000.0)
    >>> Noise(range_m=2.0, spectrum="leak", orifice_m=1e-3).peak_hz
    62600.0
    """

    band_hz: Annotated[tuple[float, float], _FREQUENCY_HZ] = (20_000.0, 80_000.0)
    level_db: Annotated[float, _LEVEL_DB] = -60.0
    spectrum: Literal["white", "leak"] | tuple[_SpectrumPoint, ...] = "white"
    orifice_m: Annotated[float, Limits(1e-5, 0.1)] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_band("noise.band_hz", self.band_hz)
        if (self.orifice_m is not None) != (self.spectrum == "leak"):
            raise ArgumentError(
                f"noise.spectrum is {self.spectrum!r} and noise.orifice_m is {self.orifice_m}; use noise.orifice_m "
                'with spectrum = "leak", and only with it'
            )
        if not isinstance(self.spectrum, str):
            self._check_levels(self.spectrum)

    def _check_levels(self, levels: tuple[tuple[float, float], ...]) -> None:
        checks.integer("number of levels of noise.spectrum", len(levels), 1, _MAX_LEVELS)
        frequency_hz = [each_hz for each_hz, _ in levels]
        if any(after <= before for before, after in itertools.pairwise(frequency_hz)):
            raise ArgumentError("noise.spectrum has frequencies that do not increase; sort them in increasing order")

    @property
    def peak_hz(self) -> float:
        """Frequency of the highest power density of a leak, ``0.2 U / d``; NaN for other noise."""
        return math.nan if self.orifice_m is None else _STROUHAL * _SONIC_JET_M_S / self.orifice_m

    def density(self, frequency_hz: Floats) -> Floats:
        """Return the power density within the band, on an arbitrary scale: (frequency,).

        The noise of a turbulent jet is ``x² / (1 + x²)²`` with ``x = f d / (0.2 U)``: the density rises with the square
        of the frequency and falls with it (A. Powell, Similarity and turbulent jet noise, JASA 31, 1959), and is
        highest at a Strouhal number f d / U of 0.2 (H. K. Tanna, An experimental study of jet noise, J. Sound Vib. 50,
        1977). The jet of a leak has sonic speed U for pressures of 0.9 bar or more above the ambient pressure.
        """
        if isinstance(self.spectrum, str):
            if self.spectrum == "white":
                return np.ones(len(frequency_hz))
            square = (frequency_hz / self.peak_hz) ** 2
            return np.asarray(square / (1 + square) ** 2)
        given_hz, level_db = np.array(self.spectrum).T
        return np.asarray(10 ** ((np.interp(frequency_hz, given_hz, level_db) - level_db.max()) / 10))


class Sonar(SoundSource, frozen=True, kw_only=True):
    """Another sonar or a bat, not synchronised with the sensors of the scene.

    Attributes
    ----------
    call : Call
        Call of the sonar; the call of eRTIS by default.
    level_db : float
        Amplitude of its call at 1 m in decibels relative to full scale; −20 by default.
    period_s : float
        Time from one call to the next in seconds; 0.05 by default.
    offset_s : float
        Start of its first call in seconds after the start of the first measurement; 0 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Sonar
    >>> Sonar(range_m=3.0).period_s
    0.05
    """

    call: Call = Call()
    level_db: Annotated[float, _LEVEL_DB] = -20.0
    period_s: float = 0.05
    offset_s: Annotated[float, Limits(0.0, 1e3)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("sonar.period_s", self.period_s, self.call.end_s, 1e3)


class Ambient(TomlTable, frozen=True, kw_only=True):
    """Diffuse noise, equally strong from all directions.

    Attributes
    ----------
    level_dbfs : float
        RMS in the band at each microphone, in dBFS; −80 by default.
    band_hz : (low, high)
        Band of the noise in hertz; 20 to 80 kHz by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Ambient
    >>> Ambient().level_dbfs
    -80.0
    """

    level_dbfs: Annotated[float, Limits(-300.0, 0.0)] = -80.0
    band_hz: Annotated[tuple[float, float], _FREQUENCY_HZ] = (20_000.0, 80_000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_band("ambient.band_hz", self.band_hz)


def _check_band(name: str, band_hz: tuple[float, float]) -> None:
    if band_hz[0] == band_hz[1]:
        raise ArgumentError(f"{name} starts and ends at {band_hz[0]:g} Hz; choose two different frequencies")

"""Acoustic maps: sound power over direction and frequency band."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.notebook_html import shown_in_notebooks
from ertis_numba.frames._bearings import Bearing
from ertis_numba.frames._level_reference import LEVEL_UNITS, LevelReference, LevelUnit, known_levels, level_offset_db
from ertis_numba.frames._replacing import replaced
from ertis_numba.frames._stamp import Stamp
from ertis_numba.settings import Settings

__all__ = ["AcousticMap", "SoundDirection"]


_SILENCE = 1e-25  # Power of rounding in maps of capon; sound of one-bit or float samples has more.


class SoundDirection(NamedTuple):
    """Direction of sound in a band, with its level at the array; None for levels that are unknown."""

    band_hz: tuple[float, float]
    azimuth_rad: float
    elevation_rad: float
    level_dbfs: float | None  # None for the method music
    level_db: float | None  # re 20 µPa; needs the sensitivity
    source_level_db: float | None  # re 20 µPa at 1 m; needs the distance, and at most 60 dB of absorption
    grid_error_rad: float = math.nan

    @classmethod
    def of(
        cls, found: "AcousticMap", band: int, angles_rad: tuple[float, float], power: float, error_rad: float = math.nan
    ) -> Self:
        """Return a direction in band number ``band`` of a map, with all known levels of a power above 0."""
        levels: dict[str, float | None] = dict.fromkeys(LEVEL_UNITS)
        if found.has_level:
            levels = known_levels(found.settings, float(found.centre_hz[band]), 10 * math.log10(power))
        low_hz, high_hz = found.band_hz[band].tolist()
        in_units = levels["level_dbfs"], levels["level_db"], levels["source_level_db"]
        return cls((low_hz, high_hz), *angles_rad, *in_units, error_rad)

    def as_dict(self) -> dict[str, Any]:
        """Return the direction in degrees and the levels for JSON; unknown or infinite numbers are null."""
        return {
            "band_hz": [round(edge_hz, 3) for edge_hz in self.band_hz],
            "azimuth_deg": _rounded(math.degrees(self.azimuth_rad)),
            "elevation_deg": _rounded(math.degrees(self.elevation_rad)),
            **{name: _rounded(getattr(self, name)) for name in reversed(LEVEL_UNITS)},
        }


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 4)


@dataclass(frozen=True, slots=True, eq=False)
class AcousticMap(DegreesFromRadians):
    """Sound power from each direction, in bands of frequencies.

    The properties ``azimuth_deg`` and ``elevation_deg`` are the angles in degrees.

    Attributes
    ----------
    power : (direction, band) float32
        Mean square of the sound from a direction at the array; full scale is 1, so that a full-scale tone has ½. For
        the method ``music``, a number without a level.
    azimuth_rad, elevation_rad : (direction,) float64
        Directions in the sensor frame: x is forward, azimuth counts towards y, elevation towards z.
    band_hz : (band, 2) float64
        Lower and upper edge of each band in hertz.
    settings : Settings
        Settings of the map; those of its method are in ``settings.passive``.
    stamp : Stamp
        Origin of the last measurement.
    n_measurements : int, default 1
        Measurements whose powers were averaged.
    n_blocks : int, default 1
        Blocks of samples whose powers were averaged.
    masked_s : float, default 0
        Time at the start of each measurement that was left out, because the sensor emitted its call.
    bearings : tuple of Bearing, default ()
        Bearings of the sources in each band, loudest first, as by `BearingFinder`.
    false_alarm : float, default NaN
        Probability that noise alone yields any bearing; NaN if no bearings were searched.

    Raises
    ------
    ArgumentError
        An attribute has another type, or the shapes do not agree.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     found = ertis.AcousticCamera(recording.settings).process(recording[0])
    >>> found.power.shape == (len(found.azimuth_rad), len(found.band_hz))
    True
    """

    power: NDArray[np.float32]
    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    band_hz: NDArray[np.float64]
    settings: Settings
    stamp: Stamp = Stamp()
    n_measurements: int = 1
    n_blocks: int = 1
    masked_s: float = 0.0
    bearings: tuple[Bearing, ...] = ()
    false_alarm: float = math.nan

    _repr_html_ = shown_in_notebooks

    def __post_init__(self) -> None:
        for name in ("power", "azimuth_rad", "elevation_rad", "band_hz"):
            checks.instance(name, getattr(self, name), np.ndarray, "numpy.asarray makes")
        checks.instance("settings", self.settings, Settings, "a recording contains, or Settings.from_preset returns")
        checks.shape("elevation_rad", self.elevation_rad.shape, self.azimuth_rad.shape)
        checks.shape("band_hz", self.band_hz.shape, (len(self.band_hz), 2))
        checks.shape("power", self.power.shape, (*self.azimuth_rad.shape, len(self.band_hz)))
        checks.integer("n_measurements", self.n_measurements, 1)
        checks.integer("n_blocks", self.n_blocks, 1)
        checks.between("masked_s", self.masked_s, 0.0, math.inf)
        for _ in checks.items("bearings", self.bearings, Bearing, "BearingFinder.find returns"):
            pass

    @property
    def has_bearings(self) -> bool:
        """True if the bearings of sources were searched; there may be none."""
        return not math.isnan(self.false_alarm)

    @property
    def level_dbfs(self) -> NDArray[np.float32]:
        """Level at the array in dBFS: (direction, band) float32. A full-scale tone has -3; silence has -inf."""
        with np.errstate(divide="ignore"):
            return np.asarray(10 * np.log10(self.power), np.float32)

    @property
    def level_db(self) -> NDArray[np.float32] | None:
        """Sound pressure level at the array in dB re 20 µPa: (direction, band) float32.

        None if the settings do not state the sensitivity of the microphones.
        """
        return self._in_unit(LEVEL_UNITS["level_db"])

    @property
    def source_level_db(self) -> NDArray[np.float32] | None:
        """Source level in dB re 20 µPa at 1 m: (direction, band) float32.

        The source level is the level at 1 m from a source at the distance ``passive.focus_m``, without absorption by
        the air. It is the level at the array plus the transmission loss at the centre of the band. None if the settings
        do not state both the distance and the sensitivity of the microphones. NaN in bands of which the air absorbs
        more than 60 dB over this distance: the absorption is known to ±10 %, so that 6 dB or more would be unknown.
        """
        return self._in_unit(LEVEL_UNITS["source_level_db"])

    @property
    def centre_hz(self) -> NDArray[np.float64]:
        """Geometric centre of each band in hertz: (band,) float64."""
        return np.asarray(np.sqrt(self.band_hz.prod(axis=1)))

    @property
    def reference(self) -> LevelReference:
        """Reference of all levels: source level, sound pressure level or full scale, the first known in every band."""
        return LevelReference.of(self.settings, self.centre_hz, is_complete=True)

    def _in_unit(self, unit: LevelUnit) -> NDArray[np.float32] | None:
        offset_db = level_offset_db(self.settings, self.centre_hz, unit)
        return None if offset_db is None else np.asarray(self.level_dbfs + offset_db, np.float32)

    @property
    def has_level(self) -> bool:
        """True unless the numbers of the method find directions only, as those of ``music``."""
        return self.settings.passive.traits.has_level

    @property
    def is_silent(self) -> NDArray[np.bool_]:
        """True for bands without sound: (band,) bool. No direction of such a band is listed."""
        highest = self.power.max(axis=0, initial=0.0)
        return np.asarray(highest <= (_SILENCE if self.has_level else 0.0))

    def in_band(self, low_hz: float, high_hz: float) -> NDArray[np.float32]:
        """Return the power from each direction in the bands within limits.

        Parameters
        ----------
        low_hz, high_hz : float
            Limits of the bands' centres, in hertz.

        Returns
        -------
        (direction,) float32

        Raises
        ------
        ArgumentError
            A limit is not a frequency, or no band has its centre within the limits.
        """
        checks.between("low_hz", low_hz, 0.0, 1e9)
        checks.between("high_hz", high_hz, 0.0, 1e9)
        centre_hz = self.centre_hz
        chosen = (centre_hz >= low_hz) & (centre_hz <= high_hz)
        if not chosen.any():
            raise ArgumentError(
                f"no band lies within {low_hz:g} to {high_hz:g} Hz; the map has bands from {self.band_hz.min():g} to "
                f"{self.band_hz.max():g} Hz; use wider limits"
            )
        return np.asarray(self.power[:, chosen].sum(axis=1), np.float32)

    def loudest(self) -> list[SoundDirection]:
        """Return the loudest direction of the grid in each band; none in bands of silence.

        It may be noise or a side lobe: ``bearings`` has the sources. A source may also lie between the directions of
        the grid, with a higher level: `find_sound_sources` interpolates.
        """
        return [
            SoundDirection.of(
                self,
                band,
                (float(self.azimuth_rad[place]), float(self.elevation_rad[place])),
                float(self.power[place, band]),
            )
            for band, place in enumerate(np.argmax(self.power, axis=0))
            if not self.is_silent[band]
        ]

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed.

        Parameters
        ----------
        **changes
            New values of fields, by name.

        Raises
        ------
        ArgumentError
            There is no such field, or the shapes do not agree.
        """
        return replaced("an acoustic map", self, changes)

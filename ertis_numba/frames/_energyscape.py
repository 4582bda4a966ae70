"""Energyscapes: acoustic images over direction and range."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.notebook_html import shown_in_notebooks
from ertis_numba.frames._point_cloud import PointCloud
from ertis_numba.frames._replacing import replaced
from ertis_numba.frames._stamp import Stamp
from ertis_numba.frames._xarray import data_array
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    import xarray

__all__ = ["Energyscape"]

_TURN_DEG = 360.0
_ROUNDING = 1e-9  # of degrees and metres, so that limits include the directions and ranges they name


@dataclass(frozen=True, slots=True, eq=False)
class Energyscape(DegreesFromRadians):
    """Acoustic image: the envelope of each beam at each range.

    NumPy functions accept an energyscape as the array ``amplitude``; the properties ``azimuth_deg`` and
    ``elevation_deg`` are the angles in degrees.

    Attributes
    ----------
    amplitude : (direction, range) float32
        Envelope amplitude; a full-scale echo of the whole call in every microphone has 1.
    azimuth_rad, elevation_rad : (direction,) float64
        Directions in the sensor frame: x is forward, azimuth counts towards y, elevation towards z. If
        ``settings.processing.level_directions`` is true, they refer to the horizontal plane instead: z is up, and x has
        the heading of the sensor.
    range_m : (range,) float64
        Half of the sound's path, at the speed of sound in the air of the settings.
    settings : Settings
        Settings of the image, with its complete plan.
    stamp : Stamp
        Origin of the measurement.
    points : PointCloud, optional
        Reflectors that the fusion of several sensors has located, in the frame of the platform; None for the image of
        one sensor. Lists, plots, exports and views show these points in place of maxima of the image.
    level_step_db : float
        Step to which levels were rounded in a file or message of type uint8; 0 if they were not. Amplitudes below its
        lowest level are 0.

    Raises
    ------
    ArgumentError
        An attribute has another type, or the shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> near = image.select(azimuth_deg=(-30, 30), range_m=(0.5, 2))
    >>> bool(np.max(near) <= np.max(image)), near.is_planar
    (True, True)
    """

    amplitude: NDArray[np.float32]
    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    range_m: NDArray[np.float64]
    settings: Settings
    stamp: Stamp = Stamp()
    points: PointCloud | None = None
    level_step_db: float = 0.0

    _repr_html_ = shown_in_notebooks

    def __post_init__(self) -> None:
        for name in ("amplitude", "azimuth_rad", "elevation_rad", "range_m"):
            checks.instance(name, getattr(self, name), np.ndarray, "numpy.asarray makes")
        checks.instance("settings", self.settings, Settings, "a recording contains, or Settings.from_preset returns")
        checks.shape("elevation_rad", self.elevation_rad.shape, self.azimuth_rad.shape)
        checks.shape("amplitude", self.amplitude.shape, (*self.azimuth_rad.shape, *self.range_m.shape))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:  # noqa: FBT001  NumPy's
        """Return the amplitudes for NumPy functions: (direction, range)."""
        return np.array(self.amplitude, dtype=dtype, copy=copy)

    @property
    def level_db(self) -> NDArray[np.float32]:
        """Level relative to the strongest point of the image in dB, at most 0: (direction, range) float32.

        Points without sound have -inf.
        """
        strongest = np.float32(self.amplitude.max(initial=0.0)) or np.float32(1)
        return _decibels(self.amplitude / strongest)

    @property
    def level_dbfs(self) -> NDArray[np.float32]:
        """Level relative to a full-scale echo in every microphone in dBFS: (direction, range) float32.

        Points without sound have -inf.
        """
        return _decibels(self.amplitude)

    @property
    def is_planar(self) -> bool:
        """True if all directions lie in the horizontal plane."""
        return not np.any(self.elevation_rad)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed.

        Parameters
        ----------
        **changes
            New values of fields, such as ``amplitude=image.amplitude - background.amplitude``.

        Raises
        ------
        ArgumentError
            There is no such field, or the shapes do not agree.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     image = ertis.Pipeline(recording.settings).process(recording[0])
        >>> float(image.replace(amplitude=0 * image.amplitude).amplitude.max())
        0.0
        """
        return replaced("an image", self, changes)

    def select(
        self,
        *,
        azimuth_deg: tuple[float, float] | None = None,
        elevation_deg: tuple[float, float] | None = None,
        range_m: tuple[float, float] | None = None,
    ) -> Self:
        """Return the part of the image within limits, which are included.

        Parameters
        ----------
        azimuth_deg : (low, high), optional
            Limits of the azimuth in degrees. The azimuth is circular: (170, 190) includes -175°.
        elevation_deg : (low, high), optional
            Limits of the elevation in degrees.
        range_m : (low, high), optional
            Limits of the range in metres; ``math.inf`` is no limit.

        Returns
        -------
        Energyscape
            Selected directions and ranges; the amplitudes are copied.

        Raises
        ------
        ArgumentError
            A pair is no pair of ascending numbers, or no direction or no range is within the limits.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     image = ertis.Pipeline(recording.settings).process(recording[0])
        >>> ahead = image.select(azimuth_deg=(-10, 10), range_m=(1, 2))
        >>> bool(abs(ahead.azimuth_deg).max() <= 10), bool(ahead.range_m.min() >= 1)
        (True, True)
        """
        directions = np.ones(len(self.azimuth_rad), dtype=np.bool_)
        ranges = np.ones(len(self.range_m), dtype=np.bool_)
        if azimuth_deg is not None:
            low, high = _limits("azimuth_deg", azimuth_deg)
            directions &= np.mod(self.azimuth_deg - low + _ROUNDING, _TURN_DEG) <= high - low + 2 * _ROUNDING
        if elevation_deg is not None:
            low, high = _limits("elevation_deg", elevation_deg)
            directions &= (self.elevation_deg >= low - _ROUNDING) & (self.elevation_deg <= high + _ROUNDING)
        if range_m is not None:
            low, high = _limits("range_m", range_m)
            ranges &= (self.range_m >= low - _ROUNDING) & (self.range_m <= high + _ROUNDING)
        if not directions.any():
            raise ArgumentError(
                f"no direction lies within azimuth_deg {azimuth_deg} and elevation_deg {elevation_deg}; the image has "
                f"azimuths from {self.azimuth_deg.min():g} to {self.azimuth_deg.max():g} and elevations from "
                f"{self.elevation_deg.min():g} to {self.elevation_deg.max():g} degrees"
            )
        if not ranges.any():
            raise ArgumentError(
                f"no range lies within range_m {range_m}; the image has ranges from {self.range_m.min():g} to "
                f"{self.range_m.max():g} m"
            )
        return self.replace(
            points=None if self.points is None else self._points_within(azimuth_deg, elevation_deg, range_m),
            amplitude=self.amplitude[np.ix_(directions, ranges)],
            azimuth_rad=self.azimuth_rad[directions],
            elevation_rad=self.elevation_rad[directions],
            range_m=self.range_m[ranges],
        )

    def _points_within(
        self,
        azimuth_deg: tuple[float, float] | None,
        elevation_deg: tuple[float, float] | None,
        range_m: tuple[float, float] | None,
    ) -> PointCloud | None:
        """Return the points within limits, which are included."""
        cloud = self.points
        if cloud is None:
            return None
        within = np.ones(len(cloud), dtype=np.bool_)
        level_m = np.hypot(*cloud.position_m[:, :2].T) if self.is_planar else cloud.range_m
        if azimuth_deg is not None:
            within &= np.mod(cloud.azimuth_deg - azimuth_deg[0], _TURN_DEG) <= azimuth_deg[1] - azimuth_deg[0]
        if elevation_deg is not None and not self.is_planar:
            within &= (cloud.elevation_deg >= elevation_deg[0]) & (cloud.elevation_deg <= elevation_deg[1])
        if range_m is not None:
            within &= (level_m >= range_m[0]) & (level_m <= range_m[1])
        return cloud.only(within)

    def to_xarray(self) -> "xarray.DataArray":
        """Return the image as an `xarray.DataArray`, with the names that energyscape files have.

        Returns
        -------
        xarray.DataArray
            ``amplitude`` of dimensions ``direction`` and ``range``, with the coordinates ``azimuth`` and ``elevation``
            in radians and ``range`` in metres. The scalar coordinate ``time`` joins several of them by
            ``xarray.concat(arrays, "time")``. Settings and the rest of the stamp are attributes. Memory is shared.

        Raises
        ------
        ArgumentError
            xarray is not installed (extra ``xarray``).

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     image = ertis.Pipeline(recording.settings).process(recording[0])
        >>> profile = image.to_xarray().max("direction")
        >>> profile.dims, bool(0.5 <= profile.idxmax("range") <= 5)
        (('range',), True)
        """
        return data_array(
            "amplitude",
            self.amplitude,
            ("direction", "range"),
            {
                "azimuth": ("direction", self.azimuth_rad, "azimuth, from x forward towards y", "radian"),
                "elevation": (
                    "direction",
                    self.elevation_rad,
                    "elevation, from the horizontal plane towards z",
                    "radian",
                ),
                "range": ("range", self.range_m, "half of the sound's path", "m"),
            },
            about="envelope amplitude; 1 is a full-scale echo in every microphone",
            settings=self.settings,
            stamp=self.stamp,
            **({"level_step_db": self.level_step_db} if self.level_step_db else {}),
        )


def _decibels(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    with np.errstate(divide="ignore"):
        return np.asarray(20 * np.log10(amplitude), dtype=np.float32)


def _limits(name: str, value: tuple[float, float]) -> tuple[float, float]:
    """Return ascending limits, which may be infinite."""
    try:
        low, high = map(float, value)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} is {value!r}; use a pair of numbers (low, high)") from error
    if math.isnan(low) or math.isnan(high) or low > high:
        raise ArgumentError(f"{name} runs from {low:g} to {high:g}; use two numbers, the smaller one first")
    return low, high

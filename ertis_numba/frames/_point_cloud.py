"""Point clouds: the reflectors of an image as points in space."""

from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.notebook_html import shown_in_notebooks
from ertis_numba.frames._replacing import replaced
from ertis_numba.frames._stamp import Stamp
from ertis_numba.settings import Settings

__all__ = ["PointCloud"]

_STAMPS: Final = ("session_id", "sequence", "sync_count", "timestamp_ns")
_POINT: Final = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "intensity", "uncertainty_range", "uncertainty_across")),
        *((name, "<i8") for name in _STAMPS),
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud(DegreesFromRadians):
    """Reflectors of an image as points.

    Attributes
    ----------
    position_m : (point, axis) float32
        Positions in metres, the strongest point first. The sensor frame is right-handed, as in REP-103: x is forward,
        y left, z up. If the directions of the image were levelled, they are those of `Energyscape`.
    amplitude : (point,) float32
        Envelope amplitude, as in `Energyscape`.
    settings : Settings
        Settings of the image.
    stamp : Stamp
        Origin of the measurement.
    translation_m : (x, y, z), optional
        Position of the sensor on its platform in metres; None if the mounting is unknown.
    rotation_xyzw : (x, y, z, w), optional
        Unit quaternion that rotates the sensor frame into the platform's frame; None if the mounting is unknown.
    uncertainty_m : (point, 2) float32, optional
        Standard deviations of the position along range and across it, in metres, from `PointExtractor`. None if they
        are unknown: the network does not transmit them.
    confirmed : (point,) bool, optional
        True for reflectors that echoes of enough pairs of emitter and receiver confirm. The others may be ghosts of
        sound that two surfaces reflected. None for points that are not fused.

    Raises
    ------
    ArgumentError
        An attribute has another type, or the shapes do not agree.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> cloud = ertis.PointExtractor(image.settings)(image)
    >>> cloud.position_m.shape == (len(cloud), 3)
    True
    """

    position_m: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    settings: Settings
    stamp: Stamp = Stamp()
    translation_m: tuple[float, float, float] | None = None
    rotation_xyzw: tuple[float, float, float, float] | None = None
    uncertainty_m: NDArray[np.float32] | None = None
    confirmed: NDArray[np.bool_] | None = None

    _repr_html_ = shown_in_notebooks

    def __post_init__(self) -> None:
        for name in ("position_m", "amplitude"):
            checks.instance(name, getattr(self, name), np.ndarray, "numpy.asarray makes")
        n_points = len(self.amplitude) if self.amplitude.ndim else 1
        checks.shape("amplitude", self.amplitude.shape, (n_points,))
        checks.shape("position_m", self.position_m.shape, (n_points, 3))
        if self.uncertainty_m is not None:
            checks.shape("uncertainty_m", np.shape(self.uncertainty_m), (n_points, 2))
        if self.confirmed is not None:
            checks.shape("confirmed", np.shape(self.confirmed), (n_points,))

    def __len__(self) -> int:
        return len(self.amplitude)

    @property
    def azimuth_rad(self) -> NDArray[np.float64]:  # type: ignore[override]  # derived rather than stored
        """Azimuth of each point in the sensor frame: (point,) float64, in radians."""
        return np.arctan2(self.position_m[:, 1], self.position_m[:, 0], dtype=np.float64)

    @property
    def elevation_rad(self) -> NDArray[np.float64]:  # type: ignore[override]  # derived rather than stored
        """Elevation of each point in the sensor frame: (point,) float64, in radians."""
        level_m = np.hypot(self.position_m[:, 0], self.position_m[:, 1], dtype=np.float64)
        return np.arctan2(self.position_m[:, 2], level_m, dtype=np.float64)

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Distance of each point from the sensor's origin: (point,) float64, in metres."""
        return np.asarray(np.linalg.norm(self.position_m.astype(np.float64), axis=1))

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed.

        Parameters
        ----------
        **changes
            New values of fields.

        Raises
        ------
        ArgumentError
            There is no such field, or the shapes do not agree.

        Examples
        --------
        >>> import numpy as np
        >>> import ertis_numba as ertis
        >>> cloud = ertis.PointCloud(np.ones((2, 3), np.float32), np.ones(2, np.float32), ertis.Settings())
        >>> cloud.replace(amplitude=cloud.amplitude / 2).amplitude
        array([0.5, 0.5], dtype=float32)
        """
        return replaced("a point cloud", self, changes)

    def only(self, chosen: NDArray[Any]) -> Self:
        """Return some of the points.

        Parameters
        ----------
        chosen : (point,) bool, or int indices
            Points to keep.

        Examples
        --------
        >>> import numpy as np
        >>> import ertis_numba as ertis
        >>> cloud = ertis.PointCloud(np.ones((2, 3), np.float32), np.ones(2, np.float32), ertis.Settings())
        >>> len(cloud.only(np.array([True, False])))
        1
        """
        return self.replace(
            position_m=self.position_m[chosen],
            amplitude=self.amplitude[chosen],
            uncertainty_m=None if self.uncertainty_m is None else self.uncertainty_m[chosen],
            confirmed=None if self.confirmed is None else self.confirmed[chosen],
        )

    def strongest(self, top: int | None, min_level_db: float) -> Self:
        """Return the strongest points, which come first, without uncertain reflectors of a fusion.

        Parameters
        ----------
        top : int or None
            Largest number of points; None for all.
        min_level_db : float
            Lowest level relative to the strongest point in dB.

        Examples
        --------
        >>> import numpy as np
        >>> import ertis_numba as ertis
        >>> cloud = ertis.PointCloud(np.ones((2, 3), np.float32), np.ones(2, np.float32), ertis.Settings())
        >>> len(cloud.strongest(1, -20.0))
        1
        """
        lowest = self.amplitude[self.is_certain].max(initial=0.0) * 10 ** (min_level_db / 20)
        return self.only(np.flatnonzero((self.amplitude >= lowest) & (self.amplitude > 0) & self.is_certain)[:top])

    @property
    def is_certain(self) -> NDArray[np.bool_]:
        """Points that are no ghosts of a fusion: (point,) bool.

        These are confirmed reflectors and the nearest one, whose echo no other surface can have reflected. All points
        are certain if `confirmed` is unknown.
        """
        if self.confirmed is None:
            return np.ones(len(self), np.bool_)
        range_m = np.linalg.norm(self.position_m, axis=1)
        return np.asarray(self.confirmed | (range_m <= range_m.min(initial=np.inf)))

    def to_structured(self) -> NDArray[np.void]:
        """Return the points as a NumPy structured array, with the field names of exported files.

        Returns
        -------
        (point,) structured
            ``x``, ``y``, ``z`` in metres, ``intensity``, ``uncertainty_range`` and ``uncertainty_across`` in metres
            (NaN if unknown), all float32; ``session_id``, ``sequence``, ``sync_count`` and ``timestamp_ns`` of the
            measurement, all int64. Positions are in the sensor frame.

        Examples
        --------
        >>> import numpy as np
        >>> import ertis_numba as ertis
        >>> cloud = ertis.PointCloud(np.ones((2, 3), np.float32), np.ones(2, np.float32), ertis.Settings())
        >>> cloud.to_structured()["x"]
        array([1., 1.], dtype=float32)
        """
        points = np.empty(len(self), _POINT)
        points["x"], points["y"], points["z"] = self.position_m.T
        points["intensity"] = self.amplitude
        unknown_m = np.full((len(self), 2), np.nan, dtype=np.float32)
        uncertainty_m = unknown_m if self.uncertainty_m is None else self.uncertainty_m
        points["uncertainty_range"], points["uncertainty_across"] = uncertainty_m.T
        for name in _STAMPS:
            points[name] = getattr(self.stamp, name)
        return points

    def on_platform_m(self) -> NDArray[np.float64]:
        """Return the positions in the platform's frame: (point, axis) float64.

        Mountings may be in coordinates of a country, of which float32 resolves half a metre only.

        Raises
        ------
        ArgumentError
            The mounting of the sensor is unknown, or the directions of the image were levelled.
        """
        self.settings.processing.require_sensor_frame("a mounting applies to directions in the frame of the sensor")
        if self.translation_m is None or self.rotation_xyzw is None:
            raise ArgumentError(
                f"the mounting of sensor {self.stamp.sensor!r} is unknown, so its points have no place on a platform; "
                "use position_m, which is in the sensor's frame, or add the mounting with 'ertis capture --mounting "
                "FILE'"
            )
        axis, w = np.array(self.rotation_xyzw[:3]), self.rotation_xyzw[3]
        position_m = self.position_m.astype(np.float64)
        # v + 2 w (q × v) + 2 q × (q × v), the rotation of v by the unit quaternion (q, w)
        across = 2 * np.cross(axis, position_m)
        turned = position_m + w * across + np.cross(axis, across)
        return np.asarray(turned + np.array(self.translation_m))

"""What flows through the system: measurements in, energyscapes and peaks out."""

import math
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from typing import Any, Final, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.settings import Settings

__all__ = ["Energyscape", "Measurement", "Peak", "PointCloud", "Reflector", "Stamp"]

_MIN_CLOCK_NS: Final = 946_684_800 * 10**9  # the year 2000: nobody has recorded before


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamp:
    """Which sensor measured, which of its measurements this is, and when.

    Attributes
    ----------
    sensor : str
        Serial number or name of the sensor.
    sequence : int
        Number given at capture; a gap is a loss.
    session_id : int
        Number of the run of the sensor that gave the sequence numbers: (sensor, epoch, sequence) is unique.
    sync_count : int
        Pulse of the SYNC chain; equal for all sensors that emitted together.
    timestamp_ns : int
        Nanoseconds since 1970-01-01 UTC.
    timestamp_uncertainty_ns : int
    """

    sensor: str = "sensor"
    sequence: int = 0
    sync_count: int = 0
    timestamp_ns: int = 0
    timestamp_uncertainty_ns: int = 0
    session_id: int = 0

    @property
    def is_timed(self) -> bool:
        """Whether its clock was that of the world: one that was never set, or is simulated, begins at 1970."""
        return self.timestamp_ns >= _MIN_CLOCK_NS

    @property
    def iso(self) -> str | None:
        """Its time as ISO 8601 has it, to a nanosecond; None where that is not known."""
        if not self.is_timed:
            return None
        seconds, nanoseconds = divmod(self.timestamp_ns, 10**9)
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{nanoseconds:09d}Z"

    @property
    def utc(self) -> str | None:
        """Its time in words, to a millisecond; None where that is not known."""
        iso = self.iso
        return iso and f"{iso[:10]} {iso[11:23]} UTC"


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """What the microphones gave for one emission.

    Attributes
    ----------
    words : (sample,) or (sample, word) uint8, uint16, uint32 or uint64; of PCM (sample, channel) int16 or float32
        Bits: one word per PDM clock; bit m (least significant first) is channel m. An array with more
        channels than a word has bits has a second axis. PCM, where ``settings.recording.encoding`` says so: one
        number per channel.
    settings : Settings
    stamp : Stamp
    """

    data: NDArray[Any]
    settings: Settings
    stamp: Stamp = Stamp()

    def __post_init__(self) -> None:
        checks.instance("data", self.data, np.ndarray, "a recording holds, or numpy.asarray makes")
        checks.instance("settings", self.settings, Settings, "a recording holds, or Settings.from_preset returns")


@dataclass(frozen=True, slots=True, eq=False)
class Energyscape:
    """An image: the envelope of every beam.

    Attributes
    ----------
    amplitude : (direction, range) float32
        Envelope amplitude; 1 is a full-scale echo of the whole call in every microphone.
    azimuth_rad, elevation_rad : (direction,) float64
        Sensor frame: x forward, azimuth towards y, elevation towards z.
    range_m : (range,) float64
        Half of the way of the sound, at the speed of sound of the settings' air.
    settings : Settings
    stamp : Stamp
    """

    amplitude: NDArray[np.float32]
    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    range_m: NDArray[np.float64]
    settings: Settings
    stamp: Stamp = Stamp()

    def __post_init__(self) -> None:
        for name in ("amplitude", "azimuth_rad", "elevation_rad", "range_m"):
            checks.instance(name, getattr(self, name), np.ndarray, "numpy.asarray makes")
        checks.instance("settings", self.settings, Settings, "a recording holds, or Settings.from_preset returns")
        checks.shape("elevation_rad", self.elevation_rad.shape, self.azimuth_rad.shape)
        checks.shape("amplitude", self.amplitude.shape, (*self.azimuth_rad.shape, *self.range_m.shape))

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:  # noqa: FBT001  NumPy's
        """Return the energies for NumPy functions: (direction, range)."""
        return np.array(self.amplitude, dtype=dtype, copy=copy)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed.

        Raises
        ------
        ArgumentError
            There is no such field, or the shapes do not agree.
        """
        _require_fields("an image", self, changes)
        return replace(self, **changes)

    @property
    def is_planar(self) -> bool:
        """Whether all directions lie in the horizontal plane."""
        return not np.any(self.elevation_rad)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Where an image has reflectors, as points.

    Attributes
    ----------
    position_m : (point, axis) float32
        Sensor frame: x forward, y left, z up, in metres and right-handed, as REP-103 has it; the strongest point first.
    amplitude : (point,) float32
        Envelope amplitude, as in `Energyscape`.
    settings : Settings
    stamp : Stamp
    translation_m : (x, y, z), optional
        Where the sensor is on its platform; None if its mounting is unknown.
    rotation_xyzw : (x, y, z, w), optional
        The unit quaternion that turns the sensor frame into the platform's.
    uncertainty_m : (point, 2) float32, optional
        Standard deviations of the position along range and across it, as `PointExtractor` tells them; None where they
        are not known, as of what came over the network, which does not carry them.
    """

    position_m: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    settings: Settings
    stamp: Stamp = Stamp()
    translation_m: tuple[float, float, float] | None = None
    rotation_xyzw: tuple[float, float, float, float] | None = None
    uncertainty_m: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        for name in ("position_m", "amplitude"):
            checks.instance(name, getattr(self, name), np.ndarray, "numpy.asarray makes")
        n_points = len(self.amplitude) if self.amplitude.ndim else 1
        checks.shape("amplitude", self.amplitude.shape, (n_points,))
        checks.shape("position_m", self.position_m.shape, (n_points, 3))
        if self.uncertainty_m is not None:
            checks.shape("uncertainty_m", np.shape(self.uncertainty_m), (n_points, 2))

    def __len__(self) -> int:
        return len(self.amplitude)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed.

        Raises
        ------
        ArgumentError
            There is no such field, or the shapes do not agree.
        """
        _require_fields("a point cloud", self, changes)
        return replace(self, **changes)

    def on_platform_m(self) -> NDArray[np.float32]:
        """Return the positions in the platform's frame: (point, axis) float32.

        Raises
        ------
        ArgumentError
            The mounting of the sensor is unknown.
        """
        if self.translation_m is None or self.rotation_xyzw is None:
            raise ArgumentError(
                f"the mounting of sensor {self.stamp.sensor!r} is unknown, so its points have no place on a platform; "
                "use position_m, which is in the sensor's frame, or give 'ertis capture' a --mounting"
            )
        axis, w = np.array(self.rotation_xyzw[:3]), self.rotation_xyzw[3]
        position_m = self.position_m.astype(np.float64)
        # v + 2 w (q × v) + 2 q × (q × v), the rotation of v by the unit quaternion (q, w)
        across = 2 * np.cross(axis, position_m)
        turned = position_m + w * across + np.cross(axis, across)
        return np.asarray(turned + np.array(self.translation_m), dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflector:
    """What an image ought to show at one place: the truth of a simulated measurement.

    Attributes
    ----------
    name : str
        What it is in the scene, such as ``points[2]``, or by which walls the sound came.
    azimuth_deg, elevation_deg, range_m : float
        In the sensor frame, when the emission began.
    level_db : float
        Level of its echo relative to the strongest of the sensor's own call, so at most 0, except for other emitters.
    velocity_m_s : (x, y, z)
        In the sensor frame, relative to the sensor.
    emitter : str
        Another sensor, if this is the echo of its call; images show it, but at no place where anything is.
    """

    name: str
    azimuth_deg: float
    elevation_deg: float
    range_m: float
    level_db: float
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emitter: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak:
    """One reflector seen in an energyscape.

    Attributes
    ----------
    azimuth_deg, elevation_deg, range_m : float
    level_db : float
        Relative to the strongest reflector of the same energyscape, so at most 0.
    level_dbfs : float
        Relative to a full-scale echo in every microphone; NaN if it is unknown.
    """

    azimuth_deg: float
    elevation_deg: float
    range_m: float
    level_db: float
    level_dbfs: float = field(default=math.nan, compare=False)


def _require_fields(what: str, given: Energyscape | PointCloud, changes: dict[str, Any]) -> None:
    known = [each.name for each in fields(given)]
    for name in changes.keys() - set(known):
        raise ArgumentError(f"{what} has no field {name!r}; give some of {', '.join(known)}")

"""Sensors of a scene: settings, pose, emitter and electronics."""

import math
import re
from typing import Annotated, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.constants import MAX_MICROPHONES
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import EMITTER_M, Limits
from ertis_numba.simulation.trajectory import Coordinate, Instant, Placed, Position, Velocity

__all__ = ["Electronics", "Emitter", "Sensor"]

_LEVEL_DB: Final = Limits(-300.0, 120.0)
_Channel = Annotated[int, Limits(0, MAX_MICROPHONES - 1)]
_Offset = Annotated[float, Limits(-10.0, 10.0)]  # size of one housing; a farther emitter belongs to another sensor
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]*")  # characters that are valid in files
_QUALITY_FACTOR = 5.0


class Emitter(TomlTable, frozen=True, kw_only=True):
    """Loudspeaker of a sensor; it faces forward.

    Attributes
    ----------
    level_db : float
        Sound pressure level of the call at 1 m on the axis, in decibels relative to full scale of the microphones; 0
        by default.
    diameter_m : float
        Diameter of the emitter as a circular piston, in metres. Its beam narrows as the frequency rises. 0, the
        default, emits equally in all directions.
    direct_sound_db : float, optional
        Level of the direct sound to the sensor's own microphones, at 1 m from the emitter; no direct sound by default.
    silent : bool
        True if the sensor only receives; False by default.
    position_m : (x, y, z)
        Position in the sensor frame in metres; the origin by default. The origin is the centroid of the enabled
        microphones.
    resonance_hz : float, optional
        Resonance of the transducer, which then filters the call and rings; the response is flat by default.
    quality_factor : float, optional
        Quality factor of the resonance, 5 by default. The bandwidth is ``resonance_hz / quality_factor``.

    Examples
    --------
    >>> from ertis_numba.simulation import Emitter
    >>> Emitter(resonance_hz=40e3).resonance_quality
    5.0
    """

    level_db: Annotated[float, _LEVEL_DB] = 0.0
    diameter_m: Annotated[float, EMITTER_M] = 0.0
    direct_sound_db: Annotated[float, _LEVEL_DB] | None = None
    silent: bool = False
    position_m: tuple[_Offset, _Offset, _Offset] = (0.0, 0.0, 0.0)
    resonance_hz: Annotated[float, Limits(1e3, 1e6)] | None = None
    quality_factor: Annotated[float, Limits(1e-6, 200.0)] | None = None  # from a flat film to a bare crystal

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quality_factor is not None:
            if self.quality_factor == _QUALITY_FACTOR and self.resonance_hz is None:
                # Scenes in older recordings hold the default without a resonance.
                msgspec.structs.force_setattr(self, "quality_factor", None)
            elif self.resonance_hz is None:
                raise ArgumentError(
                    f"emitter.quality_factor is {self.quality_factor:g}, but the emitter has no resonance; "
                    "add emitter.resonance_hz, or remove quality_factor"
                )

    @property
    def resonance_quality(self) -> float:
        """Quality factor of the resonance."""
        return _QUALITY_FACTOR if self.quality_factor is None else self.quality_factor


class Electronics(TomlTable, frozen=True, kw_only=True):
    """Microphones, their converters and the sample clock.

    Attributes
    ----------
    noise_dbfs : float, optional
        RMS of each microphone's white noise in dBFS, over the whole band up to half of the sample rate; no noise by
        default. Over a bandwidth B it is lower by ``10 log10(sample_rate / 2 B)`` decibels.
    modulator_order : int
        Order of the sigma-delta modulators; 4 by default.
    dither : float
        Width of the uniform dither at the quantiser, full scale 1; 0.5 by default.
    microphone_diameter_m : float
        Diameter of the port as a circular piston, in metres. 0, the default, is omnidirectional.
    gain_spread_db, delay_spread_s : float
        Standard deviations of gains and delays that the calibration in the settings does not contain; 0 by default.
    dead_channels : tuple of int
        Channels whose microphones receive no sound; none by default. Their modulators run on silence.
    stuck_low, stuck_high : tuple of int
        Channels whose bit is always 0 or always 1, or whose PCM samples are always at either end of the scale; none by
        default.
    clock_drift_ppm : float
        Drift of the sensor's sample clock in parts per million; a positive value runs fast. 0 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Electronics
    >>> Electronics(dead_channels=(3,), stuck_low=(7,)).faulty_channels
    (3, 7)
    """

    noise_dbfs: Annotated[float, Limits(-300.0, 0.0)] | None = None
    modulator_order: Annotated[int, Limits(1, 4)] = 4
    dither: Annotated[float, Limits(0.0, 2.0)] = 0.5
    microphone_diameter_m: Annotated[float, EMITTER_M] = 0.0
    gain_spread_db: Annotated[float, Limits(0.0, 20.0)] = 0.0
    delay_spread_s: Annotated[float, Limits(0.0, 1e-4)] = 0.0
    dead_channels: tuple[_Channel, ...] = ()
    stuck_low: tuple[_Channel, ...] = ()
    stuck_high: tuple[_Channel, ...] = ()
    clock_drift_ppm: Annotated[float, Limits(-1000.0, 1000.0)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        both = set(self.stuck_low) & set(self.stuck_high)
        if both:
            raise ArgumentError(
                f"electronics has channel {min(both)} in both stuck_low and stuck_high; use only one of them"
            )

    @property
    def faulty_channels(self) -> tuple[int, ...]:
        """All channels without sound, in increasing order."""
        return tuple(sorted({*self.dead_channels, *self.stuck_low, *self.stuck_high}))


class _Pose(Placed, frozen=True, kw_only=True):
    @classmethod
    def label(cls) -> str:
        return "sensor"


class Sensor(Settings, frozen=True, kw_only=True):
    """Sensor of a scene: its settings, with a name, a pose, an emitter and electronics.

    Attributes
    ----------
    name : str
        Name in recordings and of the emulated port, different for each sensor; ``sensor`` by default.
    position_m : (x, y, z)
        Position of the sensor's origin in the world frame, in metres; the origin of the world by default.
    velocity_m_s : (x, y, z)
        Constant velocity in the world frame, in metres per second; 0 by default.
    waypoints : tuple of (time_s, x, y, z)
        Times in seconds and positions in metres, instead of position and velocity; none by default.
    yaw_deg, pitch_deg, roll_deg : float
        Rotation to the left, then nose up, then clockwise as seen from behind, in degrees; 0 by default.
    emitter : Emitter
        Loudspeaker at the origin of the sensor by default.
    electronics : Electronics
        Noise-free and fault-free microphones by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Sensor
    >>> Sensor(yaw_deg=90.0).rotation().round(3)[:, 0].tolist()
    [0.0, 1.0, 0.0]
    """

    name: str = "sensor"
    position_m: Position | None = None
    velocity_m_s: Velocity = (0.0, 0.0, 0.0)
    waypoints: tuple[tuple[Instant, Coordinate, Coordinate, Coordinate], ...] = ()
    yaw_deg: Annotated[float, Limits(-180.0, 180.0)] = 0.0
    pitch_deg: Annotated[float, Limits(-90.0, 90.0)] = 0.0
    roll_deg: Annotated[float, Limits(-180.0, 180.0)] = 0.0
    emitter: Emitter = Emitter()
    electronics: Electronics = Electronics()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.fullmatch(self.name):
            raise ArgumentError(
                f"sensor.name is {self.name!r}; use letters, digits and _, and from the second character also . @ + -"
            )
        self.path()

    def require_microphones(self) -> None:
        """Raise an error for faults of channels without a microphone, once the layout is read."""
        enabled = microphones(self.array.replace(disabled=None)).enabled
        for channel in self.electronics.faulty_channels:
            if channel >= len(enabled) or not enabled[channel]:
                raise ArgumentError(
                    f"sensor {self.name!r} has no microphone on channel {channel}, which electronics lists as faulty; "
                    f"choose one of its {len(enabled)} channels that has a microphone, counted from 0"
                )

    def path(self) -> Placed:
        """Return the position and motion of the sensor's origin; it rests at the origin of the world by default."""
        place = self.position_m if self.position_m is not None or self.waypoints else (0.0, 0.0, 0.0)
        return _Pose(position_m=place, velocity_m_s=self.velocity_m_s, waypoints=self.waypoints)

    def settings(self) -> Settings:
        """Return the settings with which its recordings are processed; they contain the diameter of the emitter."""
        return Settings(
            array=self.array.replace(emitter_diameter_m=self.emitter.diameter_m),
            call=self.call,
            recording=self.recording,
            air=self.air,
            processing=self.processing,
            passive=self.passive,
        )

    def rotation(self) -> NDArray[np.float64]:
        """Return the rotation matrix from the sensor frame to the world frame: (3, 3) float64."""
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        about_y = np.array([[math.cos(pitch), 0, -math.sin(pitch)], [0, 1, 0], [math.sin(pitch), 0, math.cos(pitch)]])
        about_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
        return np.asarray(about_z @ about_y @ about_x, dtype=np.float64)

    def quaternion(self) -> NDArray[np.float64]:
        """Return the same rotation as a quaternion x, y, z, w: (4,) float64."""
        half = [math.radians(angle) / 2 for angle in (self.yaw_deg, -self.pitch_deg, self.roll_deg)]
        (cz, cy, cx), (sz, sy, sx) = ([function(angle) for angle in half] for function in (math.cos, math.sin))
        return np.array(
            [
                sx * cy * cz - cx * sy * sz,
                cx * sy * cz + sx * cy * sz,
                cx * cy * sz - sx * sy * cz,
                cx * cy * cz + sx * sy * sz,
            ]
        )

"""The sensors of a scene: settings, place, emitter and electronics."""

import math
import re

import msgspec
import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.documents import TomlTable
from ertis_numba.errors import ArgumentError
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings
from ertis_numba.simulation.placed import Placed, Vector, check_vector

__all__ = ["Electronics", "Emitter", "Sensor"]

_LOUDEST_DB = 120.0
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]*")  # what can stand in a file
_LARGEST_M = 0.2  # of an emitter or a microphone
_MAX_OFFSET_M = 10.0  # one housing; whatever stands farther away is a sensor of its own
_QUALITY_FACTORS = 1e-6, 200.0  # from a film that sends all alike to a bare crystal
_QUALITY_FACTOR = 5.0
_MAX_DRIFT_PPM = 1000.0


class Emitter(TomlTable, frozen=True, kw_only=True):
    """The loudspeaker, which faces forward.

    Attributes
    ----------
    level_db : float
        Amplitude of the call 1 m ahead; full scale of the microphones is 0.
    diameter_m : float
        Of a circular piston, which sends to the sides less the higher the frequency. 0, the default, sends
        alike in all directions.
    direct_sound_db : float, optional
        Level 1 m from the emitter of what goes to the sensor's own microphones; they hear nothing by default.
    silent : bool
        The sensor only listens.
    position_m : (x, y, z)
        Position in the sensor frame, whose origin is the centroid of the enabled microphones.
    resonance_hz : float, optional
        Resonance of the transducer, which then filters the call and rings; the response is flat by default.
    quality_factor : float, optional
        Quality factor of the resonance, whose bandwidth is ``resonance_hz / quality_factor``; 5 by default.
    """

    level_db: float = 0.0
    diameter_m: float = 0.0
    direct_sound_db: float | None = None
    silent: bool = False
    position_m: Vector = (0.0, 0.0, 0.0)
    resonance_hz: float | None = None
    quality_factor: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_vector("emitter.position_m", self.position_m, _MAX_OFFSET_M)
        if self.resonance_hz is not None:
            checks.between("emitter.resonance_hz", self.resonance_hz, 1e3, 1e6)
        if self.quality_factor is not None:
            checks.between("emitter.quality_factor", self.quality_factor, *_QUALITY_FACTORS)
            if self.quality_factor == _QUALITY_FACTOR and self.resonance_hz is None:
                # Scenes in older recordings hold the default without a resonance.
                msgspec.structs.force_setattr(self, "quality_factor", None)
            elif self.resonance_hz is None:
                raise ArgumentError(
                    f"emitter.quality_factor is {self.quality_factor:g}, but the emitter has no resonance; "
                    "give emitter.resonance_hz, or leave quality_factor out"
                )
        checks.between("emitter.level_db", self.level_db, -300.0, _LOUDEST_DB)
        checks.between("emitter.diameter_m", self.diameter_m, 0.0, _LARGEST_M)
        if self.direct_sound_db is not None:
            checks.between("emitter.direct_sound_db", self.direct_sound_db, -300.0, _LOUDEST_DB)

    @property
    def resonance_quality(self) -> float:
        """Quality factor of the resonance."""
        return _QUALITY_FACTOR if self.quality_factor is None else self.quality_factor


class Electronics(TomlTable, frozen=True, kw_only=True):
    """The microphones and what they do to the sound.

    Attributes
    ----------
    noise_dbfs : float, optional
        Root mean square of each microphone's white noise, over the whole band up to half of the
        record's rate; none by default. In a band B it is lower by ``10 log10(sample_rate / 2 B)`` decibels.
    modulator_order : int
        Order of the sigma-delta modulators, 1 to 4.
    dither : float
        Width of the uniform dither at the quantiser, full scale 1.
    microphone_diameter_m : float
        Of the port, as a circular piston; 0, the default, hears alike in all directions.
    gain_spread_db, delay_spread_s : float
        Standard deviation of what the calibration in the settings does not know.
    dead_channels : tuple of int
        Microphones that hear nothing; their modulators run on silence.
    stuck_low, stuck_high : tuple of int
        Channels whose bit is always 0 or always 1, or whose number is that at either end of the scale.
    clock_drift_ppm : float
        Microseconds that the sensor's sample clock gains per second.
    """

    noise_dbfs: float | None = None
    modulator_order: int = 4
    dither: float = 0.5
    microphone_diameter_m: float = 0.0
    gain_spread_db: float = 0.0
    delay_spread_s: float = 0.0
    dead_channels: tuple[int, ...] = ()
    stuck_low: tuple[int, ...] = ()
    stuck_high: tuple[int, ...] = ()
    clock_drift_ppm: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise_dbfs is not None:
            checks.between("electronics.noise_dbfs", self.noise_dbfs, -300.0, 0.0)
        checks.integer("electronics.modulator_order", self.modulator_order, 1, 4)
        checks.between("electronics.dither", self.dither, 0.0, 2.0)
        checks.between("electronics.microphone_diameter_m", self.microphone_diameter_m, 0.0, _LARGEST_M)
        checks.between("electronics.gain_spread_db", self.gain_spread_db, 0.0, 20.0)
        checks.between("electronics.delay_spread_s", self.delay_spread_s, 0.0, 1e-4)
        checks.between("electronics.clock_drift_ppm", self.clock_drift_ppm, -_MAX_DRIFT_PPM, _MAX_DRIFT_PPM)
        both = set(self.stuck_low) & set(self.stuck_high)
        if both:
            raise ArgumentError(
                f"electronics has channel {min(both)} in stuck_low and in stuck_high; give it in one of them"
            )

    @property
    def faulty_channels(self) -> tuple[int, ...]:
        """All channels that carry no sound."""
        return tuple(sorted({*self.dead_channels, *self.stuck_low, *self.stuck_high}))


class _Pose(Placed, frozen=True, kw_only=True):
    position_m: Vector | None = None

    @classmethod
    def label(cls) -> str:
        return "sensor"


class Sensor(Settings, frozen=True, kw_only=True):
    """A sensor of a scene: its settings, with a name, a pose, an emitter and electronics.

    Attributes
    ----------
    name : str
        Name in recordings and of the port, different for each sensor.
    position_m : (x, y, z)
        Of its origin, in the world frame.
    velocity_m_s : (x, y, z)
        Constant velocity in the world frame.
    waypoints : tuple of (time_s, x, y, z)
        Instead of position and velocity.
    yaw_deg, pitch_deg, roll_deg : float
        Turn to the left, then nose up, then clockwise seen from behind.
    emitter : Emitter
    electronics : Electronics
    """

    name: str = "sensor"
    position_m: Vector | None = None
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    waypoints: tuple[tuple[float, float, float, float], ...] = ()
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    emitter: Emitter = Emitter()
    electronics: Electronics = Electronics()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.fullmatch(self.name):
            raise ArgumentError(
                f"sensor.name is {self.name!r}; give letters, digits and _, after the first also . @ + -"
            )
        checks.between("sensor.yaw_deg", self.yaw_deg, -180.0, 180.0)
        checks.between("sensor.pitch_deg", self.pitch_deg, -90.0, 90.0)
        checks.between("sensor.roll_deg", self.roll_deg, -180.0, 180.0)
        self.path()
        for name in ("dead_channels", "stuck_low", "stuck_high"):
            for channel in getattr(self.electronics, name):
                checks.integer(f"electronics.{name}", channel, 0, 1023)

    def require_microphones(self) -> None:
        """Refuse faults of channels that carry no microphone, which only the layout can tell.

        Raises
        ------
        ArgumentError
            There is such a channel.
        """
        enabled = microphones(self.array.replace(disabled=None)).enabled
        for channel in self.electronics.faulty_channels:
            if channel >= len(enabled) or not enabled[channel]:
                raise ArgumentError(
                    f"sensor {self.name!r} has no microphone on channel {channel}, which is to be faulty; "
                    f"give one of its {len(enabled)} channels, counted from 0"
                )

    def path(self) -> Placed:
        """Return the place of its origin, which is that of the world by default."""
        place = self.position_m if self.position_m is not None or self.waypoints else (0.0, 0.0, 0.0)
        return _Pose(position_m=place, velocity_m_s=self.velocity_m_s, waypoints=self.waypoints)

    def settings(self) -> Settings:
        """Return what its recordings are processed with."""
        return Settings(
            array=self.array, call=self.call, recording=self.recording, air=self.air, processing=self.processing
        )

    def rotation(self) -> NDArray[np.float64]:
        """Return the matrix that turns vectors of the sensor frame into the world frame: (3, 3) float64."""
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        about_y = np.array([[math.cos(pitch), 0, -math.sin(pitch)], [0, 1, 0], [math.sin(pitch), 0, math.cos(pitch)]])
        about_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
        return np.asarray(about_z @ about_y @ about_x, dtype=np.float64)

    def quaternion(self) -> NDArray[np.float64]:
        """Return the same turn as x, y, z, w: (4,) float64."""
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

"""Scenes: the complete content of a scene file.

Levels and strengths are relative to full scale. A signal of amplitude 1, or 0 dB, would hold all PDM bits at one value.
"""

from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
import numpy as np

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.geometry import require_plausible_size, written_out
from ertis_numba.settings.documents import TomlDocument
from ertis_numba.settings.limits import Limits
from ertis_numba.simulation.effects import EFFECTS, INDISPENSABLE
from ertis_numba.simulation.platform import MovingPose, Platform
from ertis_numba.simulation.sensors import Sensor
from ertis_numba.simulation.sources import Ambient, Noise, Sonar, Tone
from ertis_numba.simulation.targets import Box, Point, Sphere, Wall
from ertis_numba.simulation.trajectory import Placed

__all__ = ["Scene", "load_scene"]


class Scene(TomlDocument, frozen=True, kw_only=True):
    """Sensors, and the reflectors and sound sources around them.

    Attributes
    ----------
    seed : int
        Seed of noise, dither and the spread of microphones; 0 by default. Only the index makes measurements of one
        scene differ.
    rate_hz : float
        Measurements per second; 20 by default.
    count : int
        Number of measurements; 1 by default.
    sync_every : int
        Number of measurements from one SYNC to the next; 1 by default. Between SYNCs, sample clocks run freely.
    tolerance_db : float
        Largest acceptable change of an image in decibels; 0.1 by default. Effects that change no image by more are left
        out, unless a key of the scene requests them. 0 keeps all effects.
    max_reflections : int
        Maximum number of walls on a sound path; 2 by default.
    effects : dict of str to bool
        Effects to switch on or off by name, regardless of the tolerance; none by default.
    platform : Platform, optional
        Platform that moves all sensors; their positions and rotations are then relative to it. None by default.
    sensors : tuple of Sensor
        Sensors, which emit together; one eRTIS at the origin by default.
    points, spheres, walls, boxes
        Reflectors; none by default.
    tones, noises, sonars, ambient
        Other sound sources; none by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Point, Scene
    >>> scene = Scene(points=(Point(azimuth_deg=10.0, range_m=1.5),))
    >>> scene.moves
    False
    """

    seed: Annotated[int, Limits(0, 2**63 - 1)] = 0
    rate_hz: Annotated[float, Limits(1e-6, 1e6)] = 20.0
    count: Annotated[int, Limits(1, 10**9)] = 1
    sync_every: Annotated[int, Limits(1, 10**9)] = 1
    tolerance_db: Annotated[float, Limits(0.0, 60.0)] = 0.1
    max_reflections: Annotated[int, Limits(0, 4)] = 2
    effects: dict[str, bool] = msgspec.field(default_factory=dict)
    platform: Platform | None = None
    sensors: tuple[Sensor, ...] = (Sensor(),)
    points: tuple[Point, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    walls: tuple[Wall, ...] = ()
    boxes: tuple[Box, ...] = ()
    tones: tuple[Tone, ...] = ()
    noises: tuple[Noise, ...] = ()
    sonars: tuple[Sonar, ...] = ()
    ambient: Ambient | None = None

    @classmethod
    def _load(cls, path: Path) -> tuple[Self, dict[str, Any]]:
        """Return the scene and the tables of a file, which sets at least one key."""
        scene, tables = super()._load(path)
        if not tables:
            raise SettingsError(
                f"{path} sets no key; add sensors, reflectors or sources, see 'ertis reference settings scene'"
            )
        return scene, tables

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, wanted in self.effects.items():
            checks.choice("effect", name, EFFECTS)
            if name in INDISPENSABLE and not wanted:
                raise ArgumentError(
                    f"effect {name!r} cannot be left out ({INDISPENSABLE[name]}); remove it from effects"
                )
        if not self.sensors:
            raise ArgumentError("the scene has no sensors; add at least one")
        names = [sensor.name for sensor in self.sensors]
        for name in names:
            if names.count(name) > 1:
                raise ArgumentError(f"the scene has {names.count(name)} sensors named {name!r}; name each differently")
        for sensor in self.sensors:
            if self.platform is not None and (sensor.waypoints or any(sensor.velocity_m_s)):
                raise ArgumentError(
                    f"sensor {sensor.name!r} moves by itself, but the scene has a platform, which carries all sensors; "
                    "remove velocity_m_s and waypoints of the sensor, or the platform"
                )

    @property
    def moves(self) -> bool:
        """True if any object changes its position or rotation."""
        carried = self.platform is not None and self.platform.moves
        return carried or any(thing.moves for thing in self.things())

    def pose_of(self, sensor: Sensor, time_s: float) -> MovingPose:
        """Return the pose and the motion of a sensor in the world frame at a time in seconds."""
        place, rotation = sensor.path(), sensor.rotation()
        if self.platform is not None:
            return self.platform.pose_at(time_s).at(place.position_at(time_s), rotation)
        return MovingPose(place.position_at(time_s), place.velocity_at(time_s), rotation, np.zeros(3))

    def things(self) -> tuple[Placed, ...]:
        """Return all objects that have a position, including the sensors."""
        targets = (*self.points, *self.spheres, *self.walls, *self.boxes)
        return (*targets, *self.tones, *self.noises, *self.sonars, *(sensor.path() for sensor in self.sensors))

    def all_walls(self) -> tuple[tuple[str, Wall], ...]:
        """Return the walls and the sides of the boxes with their names."""
        sides = [
            (f"boxes[{number}].{side}", wall)
            for number, box in enumerate(self.boxes)
            for side, wall in zip(("front", "back", "left", "right", "top", "bottom"), box.walls(), strict=True)
        ]
        return (*((f"walls[{number}]", wall) for number, wall in enumerate(self.walls)), *sides)

    def sensor(self, name: str | None = None) -> Sensor:
        """Return a sensor by name, the first by default.

        Raises
        ------
        ArgumentError
            The scene has no sensor of this name.
        """
        names = [sensor.name for sensor in self.sensors]
        if name is not None:
            checks.choice("sensor", name, names)
        return self.sensors[0 if name is None else names.index(name)]

    def with_files_of(self, folder: Path) -> Self:
        """Return a scene that contains the layouts and calls of its files.

        Paths are relative to ``folder``; paths of direction files are resolved but not read.
        """
        sensors = [sensor.resolve_paths(folder) for sensor in self.sensors]
        for sensor in sensors:
            require_plausible_size(sensor)
        return self.replace(
            sensors=tuple(
                sensor.replace(array=written_out(sensor.array)) if sensor.array.is_file else sensor
                for sensor in sensors
            ),
            sonars=tuple(sonar.replace(call=sonar.call.resolve_paths(folder)) for sonar in self.sonars),
        )


def load_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Paths in the file are relative to its folder. Layouts are read and stored in the scene, so that the scene does not
    depend on layout files.

    Parameters
    ----------
    path : str or Path
        TOML file.

    Raises
    ------
    SettingsError
        The file cannot be read or used.
    ArgumentError
        A layout cannot be read or used, or a sensor does not have a channel that the file names.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> from ertis_numba import load_scene
    >>> path = Path(mkdtemp(), "scene.toml")
    >>> _ = path.write_text("points = [{range_m = 1.0}]")
    >>> load_scene(path).points[0].range_m
    1.0
    """
    path = Path(path)
    scene = Scene.load(path).with_files_of(path.parent)
    for sensor in scene.sensors:
        try:
            sensor.require_microphones()
        except ArgumentError as error:
            raise ArgumentError(f"{path}: {error}") from error
    return scene

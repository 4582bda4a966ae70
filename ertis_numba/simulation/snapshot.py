"""Positions and velocities of all objects of a scene at one instant, in the world frame."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import Layout, microphones
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sensors import Sensor

__all__ = ["Mirror", "ReceiverPose", "Snapshot", "Targets", "TransmitterPose", "snapshot"]

Floats = NDArray[np.float64]
Found = TypeVar("Found")


@dataclass(frozen=True, slots=True, eq=False)
class TransmitterPose:
    """Pose of an emitter, or of its mirror image in walls.

    Attributes
    ----------
    position_m, velocity_m_s : (axis,) float64
    facing : (axis,) float64
        Unit vector along the emitter's axis.
    sways_m_s : tuple of (axis,) float64
        Velocity that the motion of each wall adds to the image, starting at the emitter.
    walls : tuple of str
        Names of the walls in the order in which the sound meets them.
    reflection : float
        Amplitude reflection factor of these walls.
    """

    position_m: Floats
    velocity_m_s: Floats
    facing: Floats
    sways_m_s: tuple[Floats, ...] = ()
    walls: tuple[str, ...] = ()
    reflection: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ReceiverPose:
    """Poses of the microphones of a sensor, or of their mirror image in walls.

    Attributes
    ----------
    positions_m : (mic, axis) float64
    centre_m, velocity_m_s : (axis,) float64
    axes : (3, axis) float64
        The sensor's x, y and z as unit vectors. An odd number of reflections makes them left-handed.
    sways_m_s : tuple of (axis,) float64
        Velocity that the motion of each wall adds to the image, starting at the microphones.
    walls : tuple of str
        Names of the walls in the order in which the sound meets them.
    reflection : float
        Amplitude reflection factor of these walls.
    """

    positions_m: Floats
    centre_m: Floats
    velocity_m_s: Floats
    axes: Floats
    sways_m_s: tuple[Floats, ...] = ()
    walls: tuple[str, ...] = ()
    reflection: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Points, discs and spheres of a scene.

    Attributes
    ----------
    names : tuple of str
    positions_m, velocities_m_s : (target, axis) float64
    strength : (target,) float64
        Amplitude of the echo at 1 m from a point, or amplitude reflection factor of a sphere.
    radius_m : (target,) float64
        Radius of spheres, 0 for points.
    diameter_m : (target,) float64
        Diameter of discs, 0 for others.
    normals : (target, axis) float64
        Unit normals of discs.
    """

    names: tuple[str, ...]
    positions_m: Floats
    velocities_m_s: Floats
    strength: Floats
    radius_m: Floats
    diameter_m: Floats
    normals: Floats

    def __len__(self) -> int:
        return len(self.names)

    def chosen(self, places: NDArray[np.intp]) -> Self:
        """Return a selection of targets by index: (target,) int."""
        arrays = {each.name: getattr(self, each.name)[places] for each in fields(self)[1:]}
        return replace(self, names=tuple(self.names[k] for k in places), **arrays)


@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """Wall that reflects sound.

    Attributes
    ----------
    name : str
    point_m, velocity_m_s : (axis,) float64
        Centre of the wall, and its velocity.
    axes : (3, axis) float64
        Normal, width and height as unit vectors.
    half_size_m : (2,) float64
        Half of width and height; infinite for an unbounded wall.
    reflection : float
        Amplitude reflection factor.
    """

    name: str
    point_m: Floats
    velocity_m_s: Floats
    axes: Floats
    half_size_m: Floats
    reflection: float


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Scene at the start of one measurement of one sensor.

    Attributes
    ----------
    scene : Scene
    sensor : Sensor
        The receiving sensor.
    time_s : float
        Start of the emission.
    layout : Layout
        Microphones of the sensor.
    channels : (mic,) int64
        Channels of the microphones.
    receiver : ReceiverPose
    transmitters : tuple of TransmitterPose
        Emitters, one per sensor of the scene.
    targets : Targets
    mirrors : tuple of Mirror
    speed_m_s : float
        Speed of sound.
    memory : dict
        Cache of intermediate results for this snapshot.
    """

    scene: Scene
    sensor: Sensor
    time_s: float
    layout: Layout
    channels: NDArray[np.int64]
    receiver: ReceiverPose
    transmitters: tuple[TransmitterPose, ...]
    targets: Targets
    mirrors: tuple[Mirror, ...]
    speed_m_s: float
    memory: dict[object, Any] = field(default_factory=dict, repr=False)

    def once(self, key: object, make: Callable[[], Found]) -> Found:
        """Return the cached result of ``make`` for this key; the first call computes it."""
        if key not in self.memory:
            self.memory[key] = make()
        found: Found = self.memory[key]
        return found

    @property
    def number(self) -> int:
        """Index of the receiving sensor in the scene, and on the SYNC chain."""
        return self.scene.sensors.index(self.sensor)

    @property
    def transmitter(self) -> TransmitterPose:
        """The receiving sensor's own emitter."""
        return self.transmitters[self.number]

    def of_mics(self, mics: slice) -> Self:
        """Return a copy with some of the microphones."""
        receiver = replace(self.receiver, positions_m=self.receiver.positions_m[mics])
        return replace(self, receiver=receiver, channels=self.channels[mics], memory={})

    def at_centre(self) -> Self:
        """Return a copy with one microphone at the centre of the array."""
        receiver = replace(self.receiver, positions_m=self.receiver.centre_m[None])
        return self.once("centre", lambda: replace(self, receiver=receiver, memory={}))


def snapshot(scene: Scene, sensor: Sensor, time_s: float) -> Snapshot:
    """Return the scene at a time in seconds, for one receiving sensor."""
    layout = microphones(sensor.array)
    place, rotation = sensor.path(), sensor.rotation()
    centre_m = place.position_at(time_s)
    return Snapshot(
        scene=scene,
        sensor=sensor,
        time_s=time_s,
        layout=layout,
        channels=np.flatnonzero(layout.enabled),
        receiver=ReceiverPose(
            positions_m=centre_m + layout.enabled_positions_m @ rotation.T,
            centre_m=centre_m,
            velocity_m_s=place.velocity_at(time_s),
            axes=rotation.T,
        ),
        transmitters=tuple(
            TransmitterPose(
                position_m=other.path().position_at(time_s),
                velocity_m_s=other.path().velocity_at(time_s),
                facing=other.rotation()[:, 0],
            )
            for other in scene.sensors
        ),
        targets=_targets(scene, time_s),
        mirrors=tuple(
            Mirror(
                name=name,
                point_m=wall.position_at(time_s),
                velocity_m_s=wall.velocity_at(time_s),
                axes=wall.axes(),
                half_size_m=np.array(wall.size_m or (np.inf, np.inf)) / 2,
                reflection=10 ** (wall.reflection_db / 20),
            )
            for name, wall in scene.all_walls()
        ),
        speed_m_s=sound_speed_m_s(sensor.air),
    )


def _targets(scene: Scene, time_s: float) -> Targets:
    things = [*scene.points, *scene.spheres]
    names = [f"points[{n}]" for n in range(len(scene.points))] + [f"spheres[{n}]" for n in range(len(scene.spheres))]
    none = np.zeros(3)
    return Targets(
        names=tuple(names),
        positions_m=np.array([thing.position_at(time_s) for thing in things]).reshape(-1, 3),
        velocities_m_s=np.array([thing.velocity_at(time_s) for thing in things]).reshape(-1, 3),
        strength=10
        ** (
            np.array([p.strength_db for p in scene.points] + [s.reflection_db for s in scene.spheres], dtype=np.float64)
            / 20
        ),
        radius_m=np.array([0.0 for _ in scene.points] + [s.radius_m for s in scene.spheres]),
        diameter_m=np.array([p.diameter_m for p in scene.points] + [0.0 for _ in scene.spheres]),
        normals=np.array([p.normal_at(time_s) for p in scene.points] + [none for _ in scene.spheres]).reshape(-1, 3),
    )

"""Positions and velocities of all objects of a scene at one instant, in the world frame."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import Layout, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.simulation.cache import Cache
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sensors import Sensor

__all__ = ["Mirrors", "Receivers", "Snapshot", "Targets", "Transmitters", "snapshot"]

Floats = NDArray[np.float64]
Found = TypeVar("Found")


@dataclass(frozen=True, slots=True, eq=False)
class Transmitters:
    """Poses (image, axis) of an emitter and of its mirror images in walls.

    ``facing`` is along the emitter's axis. ``sways_m_s`` (wall, image, axis) is the velocity that the motion of each
    wall adds to the image, 0 beyond its last wall. ``walls`` are in the order in which the sound meets them, and
    ``reflection`` (image,) is their amplitude factor.
    """

    position_m: Floats
    velocity_m_s: Floats
    facing: Floats
    sways_m_s: Floats = field(default_factory=lambda: np.zeros((0, 1, 3)))
    walls: tuple[tuple[str, ...], ...] = ((),)
    reflection: Floats = field(default_factory=lambda: np.ones(1))

    @property
    def centre_m(self) -> Floats:
        """The positions: (image, axis) float64."""
        return self.position_m

    def chosen(self, images: NDArray[np.intp]) -> Self:
        """Return a selection of images by index, which may repeat: (image,) int."""
        return replace(self, **_arrays(self, images))


@dataclass(frozen=True, slots=True, eq=False)
class Receivers:
    """Poses (image, mic, axis) of a sensor's microphones and of their mirror images in walls, as for `Transmitters`.

    ``centre_m`` and ``velocity_m_s`` are those of the centre, about which ``spin_rad_s`` turns. ``axes`` (image, 3,
    axis) are the sensor's x, y and z; an odd number of reflections makes them left-handed.
    """

    positions_m: Floats
    centre_m: Floats
    velocity_m_s: Floats
    spin_rad_s: Floats
    axes: Floats
    sways_m_s: Floats = field(default_factory=lambda: np.zeros((0, 1, 3)))
    walls: tuple[tuple[str, ...], ...] = ((),)
    reflection: Floats = field(default_factory=lambda: np.ones(1))

    def chosen(self, images: NDArray[np.intp]) -> Self:
        """Return a selection of images by index, which may repeat: (image,) int."""
        return replace(self, **_arrays(self, images))


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Points, discs and spheres (target,) of a scene.

    ``strength`` is the amplitude of the echo at 1 m from a point, or the amplitude reflection factor of a sphere.
    ``radius_m`` is 0 but for spheres, and ``diameter_m`` but for discs, whose unit normals are ``normals``.
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
class Mirrors:
    """Walls (wall,) that reflect sound, with their centres, velocities and amplitude reflection factors.

    ``axes`` (wall, 3, axis) are normal, width and height; ``half_sizes_m`` (wall, 2) are infinite without bounds.
    """

    names: tuple[str, ...]
    points_m: Floats
    velocities_m_s: Floats
    axes: Floats
    half_sizes_m: Floats
    reflection: Floats

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Scene at the start ``time_s`` of one emission of one sensor, without mirror images.

    ``channels`` (mic,) are those of the microphones, ``transmitters`` one per sensor of the scene, and ``token`` is the
    identity in the cache.
    """

    scene: Scene
    sensor: Sensor
    time_s: float
    layout: Layout
    channels: NDArray[np.int64]
    receiver: Receivers
    transmitters: tuple[Transmitters, ...]
    targets: Targets
    mirrors: Mirrors
    speed_m_s: float
    token: object = field(default_factory=object, repr=False)
    cache: Cache = field(default_factory=Cache, repr=False)

    def once(self, key: object, make: Callable[[], Found]) -> Found:
        """Return the result of ``make`` for this key, computed at the first call unless the cache discards it."""
        return self.cache.once((self.token, key), make)

    @property
    def number(self) -> int:
        """Index of the receiving sensor in the scene, and on the SYNC chain."""
        return self.scene.sensors.index(self.sensor)

    @property
    def transmitter(self) -> Transmitters:
        """The receiving sensor's own emitter."""
        return self.transmitters[self.number]

    def of_mics(self, mics: slice) -> Self:
        """Return a copy with some of the microphones."""
        receiver = replace(self.receiver, positions_m=self.receiver.positions_m[:, mics])
        return replace(self, receiver=receiver, channels=self.channels[mics], token=(self.token, mics.start, mics.stop))

    def without_targets(self) -> Self:
        """Return a copy without points, discs and spheres."""
        return replace(self, targets=self.targets.chosen(np.arange(0)), token=(self.token, "without targets"))

    def at_centre(self) -> Self:
        """Return a copy with one microphone at the centre of the array."""
        receiver = replace(self.receiver, positions_m=self.receiver.centre_m[:, None])
        return replace(self, receiver=receiver, token=(self.token, "centre"))


def snapshot(scene: Scene, sensor: Sensor, time_s: float, cache: Cache | None = None) -> Snapshot:
    """Return the scene at a time in seconds, for one receiving sensor; it may share a cache with others."""
    layout = microphones(sensor.array)
    pose = scene.pose_of(sensor, time_s)
    emitters = [scene.pose_of(other, time_s) for other in scene.sensors]
    return Snapshot(
        scene=scene,
        sensor=sensor,
        time_s=time_s,
        layout=layout,
        channels=np.flatnonzero(layout.enabled),
        receiver=Receivers(
            positions_m=(pose.position_m + layout.enabled_positions_m @ pose.rotation.T)[None],
            centre_m=pose.position_m[None],
            velocity_m_s=pose.velocity_m_s[None],
            spin_rad_s=pose.spin_rad_s[None],
            axes=pose.rotation.T[None],
        ),
        transmitters=tuple(
            Transmitters(
                position_m=each.position_m[None],
                velocity_m_s=each.velocity_m_s[None],
                facing=each.rotation[:, 0][None],
            )
            for each in emitters
        ),
        targets=_targets(scene, time_s),
        mirrors=_mirrors(scene, time_s),
        speed_m_s=sound_speed_m_s(sensor.air),
        cache=cache or Cache(),
    )


def _mirrors(scene: Scene, time_s: float) -> Mirrors:
    walls = scene.all_walls()
    return Mirrors(
        names=tuple(name for name, _ in walls),
        points_m=np.array([wall.position_at(time_s) for _, wall in walls]).reshape(-1, 3),
        velocities_m_s=np.array([wall.velocity_at(time_s) for _, wall in walls]).reshape(-1, 3),
        axes=np.array([wall.axes() for _, wall in walls]).reshape(-1, 3, 3),
        half_sizes_m=np.array([wall.size_m or (np.inf, np.inf) for _, wall in walls]).reshape(-1, 2) / 2,
        reflection=10 ** (np.array([wall.reflection_db for _, wall in walls], dtype=np.float64) / 20),
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


def _arrays(poses: Transmitters | Receivers, images: NDArray[np.intp]) -> dict[str, Any]:
    """Return the fields of a selection of images."""
    arrays = {each.name: getattr(poses, each.name) for each in fields(poses)}
    walls, sways_m_s = arrays.pop("walls"), arrays.pop("sways_m_s")
    return {
        "walls": tuple(walls[image] for image in images),
        "sways_m_s": sways_m_s[:, images],
        **{name: values[images] for name, values in arrays.items()},
    }

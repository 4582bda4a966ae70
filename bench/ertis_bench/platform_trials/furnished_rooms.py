"""Random furnished rooms, and measurements of a platform with four sensors that moves through them."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

import ertis_numba as ertis
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.fusion.rig import Mountings
from ertis_numba.settings import Processing
from ertis_numba.simulation import Box, Electronics, Emitter, Platform, Point, Scene, Sensor
from ertis_numba.simulation.effect_plan import EffectPlan, Verdict
from ertis_numba.simulation.effects import EFFECTS

__all__ = [
    "HALL_M",
    "HEIGHT_M",
    "N_PULSES",
    "Motion",
    "PlatformImager",
    "half_size_of_room_m",
    "half_size_of_space_m",
    "hall",
    "mountings",
    "random_motion",
    "random_room",
    "random_space",
]

HEIGHT_M: Final = 0.4
"""Height of the sensors."""
_YAWS_DEG: Final = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}
_OFFSET_M: Final = 0.2
_MAX_SPEED_M_S: Final = 1.5
_MAX_YAW_RATE_RAD_S: Final = math.radians(90.0)
_WALL_SPACING_M: Final = 0.15  # Mean spacing of the scatterers of a rough wall.
_CLEARANCE_M: Final = 0.8
_SPACE_CLEARANCE_M: Final = 1.0
_SURFACE_DB: Final = -20.0  # Strength of the scatterers of a surface; more of them echo at once than of a line.
HALL_M: Final = 16.0, 10.0
"""Length and width of the hall, whose centre is the origin."""
N_PULSES: Final = 1268
"""Pulses of the drive through the hall."""
_PULSE_HZ: Final = 14.0
_SPEED_M_S: Final = 1.0
_TO_WALL_M: Final = 2.5  # Distance of the path from the walls.
_CORNER_M: Final = 1.0  # Radius of the path at corners, so that the platform turns at 57°/s.
_N_CHORDS: Final = 8  # Straight parts of a corner, whose middle is 5 mm from the arc.
_N_POSTS: Final = 24
# The simulator would decide again for each instant which effects matter, and this takes longer than the rest.
_ABSENT: Final = {
    "emitter_offset", "clock_drift", "target_size", "emitter_response", "microphone_directivity", "direct_sound",
    "interference", "ambient_noise", "microphone_spread", "microphone_faults",
}  # fmt: skip
_PLAN: Final = EffectPlan(
    tuple(
        Verdict(name=name, on=name not in _ABSENT, reason="all effects that apply to the room", estimate_db=None)
        for name in EFFECTS
    )
)


class Motion(NamedTuple):
    """Pose and motion of a platform at one instant, in the plane."""

    x_m: float
    y_m: float
    yaw_rad: float
    forward_m_s: float
    left_m_s: float
    yaw_rate_rad_s: float

    @classmethod
    def of(cls, platform: Platform, time_s: float) -> "Motion":
        """Return the motion of a platform of a scene at one instant."""
        pose = platform.pose_at(time_s)
        forward_m_s, left_m_s, _ = (pose.rotation.T @ pose.velocity_m_s).tolist()
        x_m, y_m, _ = pose.position_m.tolist()
        yaw_rad = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
        return cls(x_m, y_m, yaw_rad, forward_m_s, left_m_s, float(pose.spin_rad_s[2]))

    def after(self, time_s: float) -> "Motion":
        """Return the motion after some time at the same velocity in the frame of the platform."""
        turn_rad = self.yaw_rate_rad_s * time_s
        half_rad = self.yaw_rad + turn_rad / 2
        # The chord of an arc.
        chord_s = time_s * float(np.sinc(turn_rad / (2 * math.pi)))
        c, s = math.cos(half_rad) * chord_s, math.sin(half_rad) * chord_s
        return self._replace(
            x_m=self.x_m + c * self.forward_m_s - s * self.left_m_s,
            y_m=self.y_m + s * self.forward_m_s + c * self.left_m_s,
            yaw_rad=self.yaw_rad + turn_rad,
        )


def random_room(seed: int, wall_spacing_m: float = _WALL_SPACING_M) -> tuple[tuple[Point, ...], tuple[Box, ...]]:
    """Return the scatterers and boxes of a furnished room with rough walls, around the origin.

    Walls are rows of scatterers with random strengths. Posts and boxes stand in the room, away from its middle.
    """
    random, half_x_m, half_y_m = _room(seed)
    points = _walls(random, half_x_m, half_y_m, wall_spacing_m)
    for x, y in _places(random, 6, half_x_m, half_y_m):
        points.append(Point(position_m=(x, y, HEIGHT_M), strength_db=random.uniform(-12.0, -4.0)))
    boxes = tuple(
        Box(
            position_m=(x, y, HEIGHT_M),
            size_m=(random.uniform(0.2, 0.5), random.uniform(0.2, 0.5), 0.8),
            yaw_deg=random.uniform(0.0, 90.0),
            reflection_db=-6.0,
        )
        for x, y in _places(random, 2, half_x_m, half_y_m)
    )
    return tuple(points), boxes


def half_size_of_room_m(seed: int) -> tuple[float, float]:
    """Return the distances of the walls of `random_room` from the origin, along x and y."""
    return _room(seed)[1:]


def _room(seed: int) -> tuple[np.random.Generator, float, float]:
    random = np.random.default_rng([seed, 24])
    return random, random.uniform(2.2, 3.2), random.uniform(1.8, 2.6)


def random_space(seed: int, spacing_m: float) -> tuple[tuple[Point, ...], tuple[Box, ...]]:
    """Return the scatterers and boxes of a furnished room with rough walls, floor and ceiling, around the sensors."""
    random, half_x_m, half_y_m, half_z_m = _space(seed)
    half_m = half_x_m, half_y_m, half_z_m
    points = []
    for axis, side in ((axis, side) for axis in range(3) for side in (1, -1)):
        others = [other for other in range(3) if other != axis]
        n_points = round(4 * half_m[others[0]] * half_m[others[1]] / spacing_m**2)
        place_m = np.zeros((n_points, 3))
        place_m[:, axis] = side * half_m[axis] + random.normal(0.0, 0.01, n_points)
        for other in others:
            place_m[:, other] = random.uniform(-half_m[other], half_m[other], n_points)
        strength_db = _SURFACE_DB + 20 * np.log10(random.rayleigh(0.8, n_points))
        points += _at_height(place_m, strength_db)
    posts = [
        (x, y, random.uniform(-half_z_m, half_z_m))
        for x, y in _places(random, 6, half_x_m, half_y_m, _SPACE_CLEARANCE_M)
    ]
    points += _at_height(np.array(posts), random.uniform(-12.0, -4.0, len(posts)))
    boxes = []
    for x, y in _places(random, 2, half_x_m, half_y_m, _SPACE_CLEARANCE_M):
        length_m, width_m, height_m = random.uniform(0.2, 0.5), random.uniform(0.2, 0.5), random.uniform(0.5, 1.0)
        z = HEIGHT_M - half_z_m + height_m / 2
        boxes.append(
            Box(
                position_m=(x, y, z),
                size_m=(length_m, width_m, height_m),
                yaw_deg=random.uniform(0.0, 90.0),
                reflection_db=-6.0,
            )
        )
    return tuple(points), tuple(boxes)


def half_size_of_space_m(seed: int) -> tuple[float, float, float]:
    """Return the distances of the surfaces of `random_space` from the middle of the sensors, along x, y and z."""
    return _space(seed)[1:]


def _space(seed: int) -> tuple[np.random.Generator, float, float, float]:
    random = np.random.default_rng([seed, 27])
    return random, random.uniform(1.6, 2.2), random.uniform(1.3, 1.7), random.uniform(1.1, 1.3)


def _at_height(place_m: NDArray[np.float64], strength_db: NDArray[np.float64]) -> list[Point]:
    """Return points around the middle of the sensors."""
    return [
        Point(position_m=(x, y, z + HEIGHT_M), strength_db=max(-40.0, each))
        for (x, y, z), each in zip(place_m.tolist(), strength_db.tolist(), strict=True)
    ]


def _walls(random: np.random.Generator, half_x_m: float, half_y_m: float, spacing_m: float) -> list[Point]:
    points = []
    for is_x, side in ((True, 1), (True, -1), (False, 1), (False, -1)):
        away_m, reach_m = (half_x_m, half_y_m) if is_x else (half_y_m, half_x_m)
        n_points = round(2 * reach_m / spacing_m)
        along_m = random.uniform(-reach_m, reach_m, n_points)
        depth_m = side * away_m + random.normal(0.0, 0.01, n_points)
        strength_db = -14.0 + 20 * np.log10(random.rayleigh(0.8, n_points))
        for a, d, strength in zip(along_m.tolist(), depth_m.tolist(), strength_db.tolist(), strict=True):
            points.append(Point(position_m=(*((d, a) if is_x else (a, d)), HEIGHT_M), strength_db=max(-40.0, strength)))
    return points


def _places(
    random: np.random.Generator, count: int, half_x_m: float, half_y_m: float, clearance_m: float = 2 * _CLEARANCE_M
) -> list[tuple[float, float]]:
    found: list[tuple[float, float]] = []
    while len(found) < count:
        x, y = random.uniform(-half_x_m, half_x_m), random.uniform(-half_y_m, half_y_m)
        if math.hypot(x, y) > clearance_m:
            found.append((x, y))
    return found


def hall(seed: int, wall_spacing_m: float = _WALL_SPACING_M, names: Sequence[str] = tuple(_YAWS_DEG)) -> Scene:
    """Return a hall of 16 m by 10 m, and a platform that drives round it for 90 m with 1,268 pulses.

    Walls are rough: rows of scatterers with random strengths. Posts stand on both sides of the path.
    """
    random = np.random.default_rng([seed, 26])
    half_x_m, half_y_m = HALL_M[0] / 2, HALL_M[1] / 2
    points = _walls(random, half_x_m, half_y_m, wall_spacing_m)
    for _ in range(_N_POSTS):
        # Posts keep clear of the path, which is 2.5 m from the walls.
        x, y = random.uniform(-half_x_m, half_x_m), random.uniform(-half_y_m, half_y_m)
        if abs(max(abs(x) - half_x_m, abs(y) - half_y_m) + _TO_WALL_M) > _CLEARANCE_M:
            points.append(Point(position_m=(x, y, HEIGHT_M), strength_db=random.uniform(-14.0, -6.0)))
    return Scene(
        seed=seed,
        rate_hz=_PULSE_HZ,
        count=N_PULSES,
        platform=Platform(waypoints=tuple(_round_hall(N_PULSES / _PULSE_HZ))),
        sensors=tuple(_sensor(name, max_range_m=5.0) for name in names),
        points=tuple(_rounded(point) for point in points),
    )


def _round_hall(duration_s: float) -> list[tuple[float, float, float, float, float]]:
    """Return waypoints of a drive at 1 m/s round the hall, to the left, with rounded corners."""
    half_x_m, half_y_m = HALL_M[0] / 2 - _TO_WALL_M, HALL_M[1] / 2 - _TO_WALL_M
    x, y, yaw_deg, time_s = 0.0, -half_y_m, 0.0, 0.0
    found = [(time_s, x, y, 0.0, yaw_deg)]
    straights_m = [2 * (half_m - _CORNER_M) for half_m in (half_y_m, half_x_m)]
    legs = [(half_x_m - _CORNER_M, 0.0)]
    # A chord of the arc and the turn on it.
    chord_m, turn_deg = 2 * _CORNER_M * math.sin(math.radians(45.0 / _N_CHORDS)), 90.0 / _N_CHORDS
    while time_s < duration_s:
        if not legs:
            n_corners = round(yaw_deg / 90.0)
            legs = [*[(chord_m, turn_deg)] * _N_CHORDS, (straights_m[n_corners % 2], 0.0)]
        way_m, turn_deg_here = legs.pop(0)
        heading_rad = math.radians(yaw_deg + turn_deg_here / 2)
        x, y = x + way_m * math.cos(heading_rad), y + way_m * math.sin(heading_rad)
        time_s, yaw_deg = time_s + way_m / _SPEED_M_S, yaw_deg + turn_deg_here
        found.append((round(time_s, 4), round(x, 4), round(y, 4), 0.0, yaw_deg))
    return found


def _rounded(point: Point) -> Point:
    """Return a point whose numbers have few digits, for short scene files."""
    x, y, z = point.position_m or (0.0, 0.0, 0.0)
    return Point(position_m=(round(x, 3), round(y, 3), z), strength_db=round(point.strength_db, 1))


def random_motion(seed: int) -> Motion:
    """Return a random motion near the middle of a room, at up to 1.5 m/s and 90°/s."""
    random = np.random.default_rng([seed, 25])
    speed_m_s, heading_rad = random.uniform(0.0, _MAX_SPEED_M_S), random.uniform(-math.pi, math.pi)
    x_m, y_m = random.uniform(-0.4, 0.4, 2).tolist()
    return Motion(
        x_m,
        y_m,
        random.uniform(-math.pi, math.pi),
        speed_m_s * math.cos(heading_rad),
        speed_m_s * math.sin(heading_rad),
        random.uniform(-_MAX_YAW_RATE_RAD_S, _MAX_YAW_RATE_RAD_S),
    )


def mountings(names: Sequence[str] = tuple(_YAWS_DEG)) -> Mountings:
    """Return the mountings of sensors on the platform."""
    return {
        name: (
            (_OFFSET_M * math.cos(yaw_rad), _OFFSET_M * math.sin(yaw_rad), HEIGHT_M),
            (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)),
        )
        for name, yaw_rad in ((name, math.radians(_YAWS_DEG[name])) for name in names)
    }


class PlatformImager:
    """Simulator of the images of a moving platform, through PDM.

    Each instant is a scene of its own, with the reflectors that are near.

    Parameters
    ----------
    things : tuple of (points, boxes)
        Scatterers and boxes, as from `random_room`.
    seed : int
        Seed of the noise.
    names : sequence of str
        Sensors on the platform.
    max_range_m : float
        End of the images.
    directions : str
        Directions of the images.
    """

    def __init__(
        self,
        things: tuple[tuple[Point, ...], tuple[Box, ...]],
        seed: int,
        names: Sequence[str] = tuple(_YAWS_DEG),
        max_range_m: float = 4.0,
        directions: str = "90",
    ) -> None:
        self._things, self._seed, self._max_range_m = things, seed, max_range_m
        self._sensors = tuple(_sensor(name, max_range_m, directions) for name in names)
        self._pipelines: dict[str, ertis.Pipeline] = {}

    def __call__(self, motion: Motion, number: int, time_s: float) -> list[Energyscape]:
        """Return the images of all sensors at one instant."""
        points, boxes = self._things
        near = tuple(
            point
            for point in points
            if point.position_m is None
            or math.hypot(point.position_m[0] - motion.x_m, point.position_m[1] - motion.y_m) < self._max_range_m + 0.5
        )
        scene = Scene(
            seed=self._seed * 1000 + number,
            platform=Platform(waypoints=_way(motion)),
            sensors=self._sensors,
            points=near,
            boxes=boxes,
        )
        images = []
        for sensor in scene.sensors:
            measurement = ertis.Simulator(scene, sensor=sensor.name, plan=_PLAN, threads=1).render()
            if sensor.name not in self._pipelines:
                self._pipelines[sensor.name] = ertis.Pipeline(sensor.settings(), predict=False, threads=1)
            image = self._pipelines[sensor.name].process(measurement)
            stamp = Stamp(
                sensor=sensor.name, sequence=number, sync_count=number, timestamp_ns=1_000_000_000 + round(1e9 * time_s)
            )
            images.append(image.replace(stamp=stamp))
        return images

    def close(self) -> None:
        """Close the pipelines."""
        for pipeline in self._pipelines.values():
            pipeline.close()


def _way(motion: Motion) -> tuple[tuple[float, float, float, float, float], ...]:
    """Return waypoints from a motion, at its present velocity for a second."""
    c, s = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
    later_m = (
        motion.x_m + c * motion.forward_m_s - s * motion.left_m_s,
        motion.y_m + s * motion.forward_m_s + c * motion.left_m_s,
    )
    yaws_deg = math.degrees(motion.yaw_rad), math.degrees(motion.yaw_rad + motion.yaw_rate_rad_s)
    return (0.0, motion.x_m, motion.y_m, 0.0, yaws_deg[0]), (1.0, *later_m, 0.0, yaws_deg[1])


def _sensor(name: str, max_range_m: float, directions: str = "90") -> Sensor:
    """Return a sensor of the platform, in its frame."""
    translation_m, _ = mountings([name])[name]
    x, y, z = (round(each, 6) for each in translation_m)
    return Sensor(
        name=name,
        position_m=(x, y, z),
        yaw_deg=_YAWS_DEG[name],
        processing=Processing(range_m=(0.4, max_range_m), directions=directions),
        emitter=Emitter(level_db=-24.0, diameter_m=0.012),
        electronics=Electronics(noise_dbfs=-60.0),
    )

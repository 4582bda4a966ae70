"""Random furnished rooms, and measurements of a platform with four sensors that moves through them."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

import ertis_numba as ertis
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.fusion.rig import Mountings
from ertis_numba.settings import Processing
from ertis_numba.simulation import Box, Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.simulation.effect_plan import EffectPlan, Verdict
from ertis_numba.simulation.effects import EFFECTS

__all__ = [
    "HALL_M",
    "Motion",
    "PlatformImager",
    "drive",
    "half_size_of_room_m",
    "mountings",
    "random_hall",
    "random_motion",
    "random_room",
]

HEIGHT_M: Final = 0.4
_YAWS_DEG: Final = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}
_OFFSET_M: Final = 0.2
_MAX_SPEED_M_S: Final = 1.5
_MAX_YAW_RATE_RAD_S: Final = math.radians(90.0)
_WALL_SPACING_M: Final = 0.15  # Mean spacing of the scatterers of a rough wall.
_CLEARANCE_M: Final = 0.8
HALL_M: Final = 16.0, 10.0
_TO_WALL_M: Final = 2.5  # Distance of the path from the walls.
_CORNER_M: Final = 1.0  # Radius of the path at corners, so that the platform turns at 86°/s.
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
    """Pose and motion of a platform at one instant, in the plane.

    Attributes
    ----------
    x_m, y_m, yaw_rad : float
        Pose in the world.
    forward_m_s, left_m_s, yaw_rate_rad_s : float
        Velocity in the frame of the platform.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    forward_m_s: float
    left_m_s: float
    yaw_rate_rad_s: float

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


def _places(random: np.random.Generator, count: int, half_x_m: float, half_y_m: float) -> list[tuple[float, float]]:
    found: list[tuple[float, float]] = []
    while len(found) < count:
        x, y = random.uniform(-half_x_m, half_x_m), random.uniform(-half_y_m, half_y_m)
        if math.hypot(x, y) > 2 * _CLEARANCE_M:
            found.append((x, y))
    return found


def random_hall(seed: int, wall_spacing_m: float = _WALL_SPACING_M) -> tuple[tuple[Point, ...], tuple[Box, ...]]:
    """Return the scatterers of a hall of 16 m by 10 m with rough walls and posts, around the origin."""
    random = np.random.default_rng([seed, 26])
    half_x_m, half_y_m = HALL_M[0] / 2, HALL_M[1] / 2
    points = _walls(random, half_x_m, half_y_m, wall_spacing_m)
    for _ in range(_N_POSTS):
        # Posts stand on both sides of the path, which is 2.5 m from the walls.
        x, y = random.uniform(-half_x_m, half_x_m), random.uniform(-half_y_m, half_y_m)
        if abs(max(abs(x) - half_x_m, abs(y) - half_y_m) + _TO_WALL_M) > _CLEARANCE_M:
            points.append(Point(position_m=(x, y, HEIGHT_M), strength_db=random.uniform(-14.0, -6.0)))
    return tuple(points), ()


def drive(length_m: float, time_s: float, *, speed_m_s: float = 1.5) -> list[Motion]:
    """Return the motions of a platform that drives round the hall, with rounded corners.

    Parameters
    ----------
    length_m : float
        Length of the path; one round has about 28 m.
    time_s : float
        Time between two motions.
    speed_m_s : float, default 1.5
        Speed along the path.
    """
    half_x_m, half_y_m = HALL_M[0] / 2 - _TO_WALL_M, HALL_M[1] / 2 - _TO_WALL_M
    motion = Motion(0.0, -half_y_m, 0.0, speed_m_s, 0.0, 0.0)
    corner_s = _CORNER_M * math.pi / 2 / speed_m_s
    straights_s = [2 * (half_m - _CORNER_M) / speed_m_s for half_m in (half_y_m, half_x_m, half_y_m, half_x_m)]
    legs = [((half_x_m - _CORNER_M) / speed_m_s, 0.0)]
    while sum(duration_s for duration_s, _ in legs) * speed_m_s < length_m:
        legs += [(corner_s, speed_m_s / _CORNER_M), (straights_s[len(legs) // 2 % 4], 0.0)]
    motions, leg, left_s = [motion], 0, legs[0][0]
    for _ in range(round(length_m / speed_m_s / time_s)):
        step_s = time_s
        while step_s > left_s:
            motion = motion._replace(yaw_rate_rad_s=legs[leg][1]).after(left_s)
            step_s -= left_s
            leg += 1
            left_s = legs[leg][0]
        motion = motion._replace(yaw_rate_rad_s=legs[leg][1]).after(step_s)
        left_s -= step_s
        motions.append(motion)
    return motions


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

    Each instant is a scene of its own, because the sensors of a scene do not turn. Sensors keep their orientation
    during a measurement, and move with the velocity of their mounting.

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
    """

    def __init__(
        self,
        things: tuple[tuple[Point, ...], tuple[Box, ...]],
        seed: int,
        names: Sequence[str] = tuple(_YAWS_DEG),
        max_range_m: float = 4.0,
    ) -> None:
        self._things, self._seed, self._names, self._max_range_m = things, seed, tuple(names), max_range_m
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
            sensors=tuple(self._sensor(name, motion) for name in self._names),
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

    def _sensor(self, name: str, motion: Motion) -> Sensor:
        place = motion.yaw_rad + math.radians(_YAWS_DEG[name])
        dx, dy = _OFFSET_M * math.cos(place), _OFFSET_M * math.sin(place)
        c, s = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
        rate = motion.yaw_rate_rad_s
        return Sensor(
            name=name,
            position_m=(motion.x_m + dx, motion.y_m + dy, HEIGHT_M),
            velocity_m_s=(
                c * motion.forward_m_s - s * motion.left_m_s - rate * dy,
                s * motion.forward_m_s + c * motion.left_m_s + rate * dx,
                0.0,
            ),
            yaw_deg=math.degrees(math.remainder(place, 2 * math.pi)),
            processing=Processing(range_m=(0.4, self._max_range_m), directions="90"),
            emitter=Emitter(level_db=-24.0, diameter_m=0.012),
            electronics=Electronics(noise_dbfs=-60.0),
        )

"""Random scenes with many kinds of objects and effects, from negligible to strong."""

import math
from typing import Any

import numpy as np

from ertis_numba.settings import Air, Array, Call, Processing, Recording
from ertis_numba.simulation import Ambient, Electronics, Emitter, Noise, Point, Scene, Sensor, Sonar, Sphere, Tone, Wall

__all__ = ["OCTET", "random_scene", "varied_scene"]


OCTET = Array(
    layout="octet",
    positions_m=tuple(
        (0.0, 0.004 * (mic - 3.5) + 0.0007 * ((7 * mic) % 5 - 2), 0.004 * ((5 * mic) % 7 - 3)) for mic in range(8)
    ),
    word_bits=8,
)


class _Draws:
    """Seeded random draws."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def chance(self, part: float) -> bool:
        return bool(self.random.random() < part)

    def between(self, low: float, high: float) -> float:
        return float(self.random.uniform(low, high))

    def decades(self, low: float, high: float) -> float:
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def place(self) -> dict[str, Any]:
        return {
            "azimuth_deg": self.between(-60, 60),
            "elevation_deg": self.between(-3, 3),
            "range_m": self.between(0.35, 0.95),
        }


def random_scene(seed: int) -> Scene:
    """Return a scene of one measurement at short range, with few microphones.

    Few of the scenes overload a modulator.
    """
    dice = _Draws(seed)
    points = tuple(_point(dice) for _ in range(dice.random.integers(1, 4)))
    spheres = (_sphere(dice),) if dice.chance(0.3) else ()
    walls = _walls(dice)
    sensor = _sensor(dice)
    other = sensor.replace(
        name="other",
        position_m=(dice.between(0.6, 1.1), dice.between(-0.4, 0.4), 0.0),
        yaw_deg=180.0,
        emitter=Emitter(level_db=dice.between(-100, -20)),
        electronics=Electronics(),
    )
    return Scene(
        seed=seed,
        sensors=(sensor, other) if dice.chance(0.25) else (sensor,),
        points=points,
        spheres=spheres,
        walls=walls,
        **_sources(dice),
    )


def _point(dice: _Draws) -> Point:
    place = dice.place()
    more: dict[str, Any] = {}
    if dice.chance(0.3):
        more["velocity_m_s"] = tuple((dice.random.normal(size=3) * dice.decades(1e-3, 3)).tolist())
    if dice.chance(0.3):
        more["diameter_m"] = dice.decades(1e-3, 0.1)
    return Point(**place, strength_db=dice.between(-50, -3) + 40 * math.log10(place["range_m"]), **more)


def _sphere(dice: _Draws) -> Sphere:
    place, radius_m = dice.place(), dice.decades(2e-3, 0.2)
    echo_db = dice.between(-18, -3) + 40 * math.log10(place["range_m"]) - 20 * math.log10(radius_m / 2)
    return Sphere(**place, radius_m=radius_m, reflection_db=min(0.0, echo_db))


def _walls(dice: _Draws) -> tuple[Wall, ...]:
    walls = []
    if dice.chance(0.3):
        place = (0.0, dice.between(0.6, 1.4) * (1 if dice.chance(0.5) else -1), 0.0)
        size_m = None if dice.chance(0.5) else (dice.decades(0.2, 3), 2.0)
        walls.append(Wall(position_m=place, facing_deg=(90, 0), reflection_db=dice.between(-65, -5), size_m=size_m))
    if dice.chance(0.2):
        place, size_m = (dice.between(0.3, 1.2), dice.between(-0.5, 0.5), 0.0), (dice.decades(0.01, 0.5), 0.5)
        walls.append(Wall(position_m=place, facing_deg=(180, 0), reflection_db=dice.between(-65, -5), size_m=size_m))
    return tuple(walls)


def _sources(dice: _Draws) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if dice.chance(0.2):
        tone = Tone(**dice.place(), frequency_hz=dice.decades(15e3, 90e3), level_db=dice.between(-100, -30))
        found["tones"] = (tone,)
    if dice.chance(0.2):
        found["noises"] = (Noise(**dice.place(), level_db=dice.between(-100, -30)),)
    if dice.chance(0.2):
        call = Call() if dice.chance(0.5) else Call(start_frequency_hz=80e3, stop_frequency_hz=20e3)
        level_db, offset_s = dice.between(-100, -30), dice.between(0, 0.05)
        found["sonars"] = (Sonar(**dice.place(), level_db=level_db, offset_s=offset_s, call=call),)
    if dice.chance(0.3):
        found["ambient"] = Ambient(level_dbfs=dice.between(-110, -30))
    return found


def _sensor(dice: _Draws) -> Sensor:
    electronics: dict[str, Any] = {}
    emitter: dict[str, Any] = {"level_db": -15.0}
    if dice.chance(0.5):
        electronics["noise_dbfs"] = dice.between(-90, -20)
    if dice.chance(0.3):
        electronics["gain_spread_db"] = dice.decades(1e-3, 3)
    if dice.chance(0.2):
        electronics["delay_spread_s"] = dice.decades(1e-9, 3e-6)
    if dice.chance(0.1):
        electronics["dead_channels"] = (int(dice.random.integers(8)),)
    if dice.chance(0.4):
        electronics["microphone_diameter_m"] = dice.decades(5e-4, 8e-3)
    if dice.chance(0.4):
        emitter["diameter_m"] = dice.decades(1e-3, 0.04)
    if dice.chance(0.3):
        emitter["direct_sound_db"] = dice.between(-100, -50)
    return Sensor(
        array=OCTET,
        recording=Recording(n_samples=32_768),
        air=Air(temperature_c=dice.between(-20, 45), humidity_percent=dice.between(0, 100)),
        processing=Processing(directions="2d:61", range_m=(0.3, 1.05) if dice.chance(0.5) else (0.55, 1.05)),
        electronics=Electronics(**electronics),
        emitter=Emitter(**emitter),
    )


def varied_scene(seed: int) -> Scene:
    """Return a scene that can also contain motion, ringing, clock drift and overload.

    Calls, windows and converters vary, too.
    """
    scene, dice = random_scene(seed), _Draws(seed + 2**32)
    sensors = [_varied(dice, sensor) for sensor in scene.sensors]
    while len(sensors) < 3 and dice.chance(0.3):
        sensors.append(
            sensors[0].replace(
                name=f"sensor{len(sensors)}",
                position_m=(dice.between(-0.3, 1.1), dice.between(0.1, 0.6), 0.0),
                yaw_deg=dice.between(-180, 180),
                emitter=Emitter(level_db=dice.between(-70, -15)),
                electronics=Electronics(clock_drift_ppm=dice.between(-1, 1) * dice.decades(0.1, 200)),
                call=sensors[0].call if dice.chance(0.5) else _call(dice),
            )
        )
    spheres = scene.spheres
    if dice.chance(0.4):
        radius_m = dice.decades(1e-3, 0.05)
        spheres = (*spheres, Sphere(**dice.place(), radius_m=radius_m))
    count = 1 if dice.chance(0.5) else int(dice.random.integers(2, 40))
    return scene.replace(
        sensors=tuple(sensors),
        spheres=spheres,
        count=count,
        sync_every=1 if dice.chance(0.7) else count,
        points=tuple(_louder(dice, point) for point in scene.points),
    )


def _varied(dice: _Draws, sensor: Sensor) -> Sensor:
    emitter, electronics = sensor.emitter, sensor.electronics
    changes: dict[str, Any] = {}
    if dice.chance(0.3):
        emitter = emitter.replace(position_m=tuple((dice.random.normal(size=3) * dice.decades(1e-4, 0.1)).tolist()))
    if dice.chance(0.3):
        emitter = emitter.replace(resonance_hz=dice.between(25e3, 70e3), quality_factor=dice.decades(0.1, 50))
    if dice.chance(0.3):
        emitter = emitter.replace(direct_sound_db=dice.between(-80, -15))
    if dice.chance(0.3):
        electronics = electronics.replace(clock_drift_ppm=dice.between(-1, 1) * dice.decades(0.1, 300))
    if dice.chance(0.3):
        changes["processing"] = sensor.processing.replace(range_m=(dice.between(0.15, 0.5), dice.between(0.6, 1.05)))
    if dice.chance(0.2):
        changes["recording"] = Recording(encoding="int16", sample_rate_hz=450_000.0, n_samples=3276)
        changes["processing"] = changes.get("processing", sensor.processing).replace(range_decimation=10)
    if dice.chance(0.3):
        changes["call"] = _call(dice)
    return sensor.replace(emitter=emitter, electronics=electronics, **changes)


def _call(dice: _Draws) -> Call:
    low_hz, high_hz = dice.between(20e3, 35e3), dice.between(45e3, 80e3)
    both = (high_hz, low_hz) if dice.chance(0.7) else (low_hz, high_hz)
    return Call(start_frequency_hz=both[0], stop_frequency_hz=both[1], duration_s=dice.between(1e-3, 3e-3))


def _louder(dice: _Draws, point: Point) -> Point:
    return point.replace(strength_db=point.strength_db + dice.between(0, 20)) if dice.chance(0.3) else point

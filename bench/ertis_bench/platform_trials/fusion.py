"""Ghosts of foreign echoes and errors of positions in fused images, on random scenes through PDM.

Four sensors on a platform face in four directions and emit together. Nothing is timed except the fusion itself.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.platform_trials import (
    broken_emitters,
    clock_checks,
    differing_calls,
    emission_delays,
    fused_scans,
    wall_reflections,
)
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M, N_REFLECTORS, platform_scene, random_reflectors
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.frames import Energyscape
from ertis_numba.fusion import Fused, Fuser
from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator

__all__ = ["FORMS", "form", "run"]

Floats = NDArray[np.float64]

_PARTS: Final = {
    "calls": differing_calls,
    "clocks": clock_checks,
    "delays": emission_delays,
    "emitters": broken_emitters,
    "reflections": wall_reflections,
    "scans": fused_scans,
}

_LOUD_DB = -25.0  # Level of foreign echoes that count, relative to the strongest own echo.
_BEAM_RAD, _PULSE_M = math.radians(25.0), 0.12  # Distance of ghosts from all reflectors.
_NEAR_M = 0.06
_FOUND_M = 0.1
_ROOM_M = 5.0, 4.0
_SPACING_M = 0.04  # of the scatterers of rough walls
_WALL_M = 0.15  # Distance from a wall within which an azimuth shows the wall.


class _Shot(NamedTuple):
    """One fused SYNC pulse of a scene, with the images and the time of the fusion."""

    scene: Scene
    images: Mapping[str, Energyscape]
    fused: Fused
    took_s: float


def run(*, count: int, rooms: int, seed: int, say: Callable[[str], None], only: Sequence[str] = ()) -> dict[str, Any]:
    """Fuse images of random reflectors, and of rooms with rough walls."""
    if only:
        report: dict[str, Any] = {}
        for part in only:
            report |= _PARTS[part].run(count=count, seed=seed, say=say)
        return report
    rows, times = [], []
    for diameter_m in EMITTERS_M:
        ghosts, positions, levels, lost = [], [], [], 0
        for number in range(seed, seed + count):
            shot = _shot(platform_scene(number, random_reflectors(number), diameter_m), diameter_m)
            ghosts.append(_ghosts(shot))
            errors, n_lost = _position_errors_m(shot)
            positions += errors
            lost += n_lost
            levels += _levels_db(shot)
            times.append(shot.took_s)
            say(f"scene {number}, emitters of {1000 * diameter_m:g} mm: ghosts {_decibels(*ghosts[-1].sum(0)):.1f} dB")
        rows.append(_row(diameter_m, ghosts, np.array(positions), lost, count) | _level_row(np.array(levels)))
    walls = [_wall_errors_m(number, say) for number in range(seed, seed + rooms)]
    is_wall = np.concatenate([error < _WALL_M for error in walls]) if walls else np.zeros(0, bool)
    near = np.concatenate([error[error < _WALL_M] for error in walls]) if walls else np.zeros(0)
    return {
        "machine": machine.describe(),
        "count": count,
        "rooms": rooms,
        "seed": seed,
        "rows": rows,
        "wall_share": float(is_wall.mean()) if len(is_wall) else None,
        "wall_rms_m": float(np.sqrt(np.mean(near**2))) if len(near) else None,
        "median_s": float(np.median(times)),
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    parts = [part.form(report) for name, part in _PARTS.items() if name in report]
    if parts:
        return "\n\n".join(parts)
    head = [
        "emitters",
        "ghosts, fused / single (median)",
        "scenes below −20 dB",
        "strongest ghost, fused (single)",
        "position RMS, fused (better sensor)",
        "reflectors lost",
        "level of confirmed ones within 1 dB (5–95 %)",
    ]
    rows = [
        [
            f"{1000 * row['diameter_m']:g} mm" if row["diameter_m"] else "omnidirectional",
            f"{row['ghosts_db']:.1f} dB",
            f"{row['within_20_db']} of {row['scenes']}",
            f"{row['strongest_db']:.1f} dB ({row['strongest_single_db']:.1f} dB)",
            f"{1000 * row['rms_m']:.1f} mm ({1000 * row['single_rms_m']:.1f} mm), {row['n_positions']} reflectors",
            f"{row['lost']} of {N_REFLECTORS * report['count']}",
            f"{row['n_right']} of {row['n_confirmed']} ({row['low_db']:+.1f} to {row['high_db']:+.1f} dB)",
        ]
        for row in report["rows"]
    ]
    walls = ""
    if report["wall_share"] is not None:
        walls = (
            f" In {report['rooms']} rooms of {_ROOM_M[0]:g} × {_ROOM_M[1]:g} m with rough walls, the strongest range "
            f"of {report['wall_share']:.0%} of the azimuths lies within {100 * _WALL_M:g} cm of a wall, with an RMS "
            f"distance of {100 * report['wall_rms_m']:.1f} cm, from a single SYNC pulse."
        )
    return (
        f"{table(head, rows)}\n\n{report['count']} scenes of {N_REFLECTORS} reflectors from seed {report['seed']}, "
        f"four sensors. Ghosts are foreign echoes far from all reflectors, above {_LOUD_DB:g} dB; levels are relative "
        f"to the strongest reflector. Positions are those of reflectors that two sensors locate; "
        f"the better sensor faces it more directly. Levels are those of the fused image at reflectors "
        f"that a confirmed point locates, relative to the strength of the reflector and to the median.{walls} "
        f"A fusion takes {1000 * report['median_s']:.0f} ms (median). {sentence(report['machine'])}"
    )


def _shot(scene: Scene, diameter_m: float, **processing: Any) -> _Shot:
    images = {}
    for sensor in scene.sensors:
        settings = sensor.settings()
        settings = settings.replace(processing=settings.processing.replace(**processing))
        measurement = Simulator(scene, sensor=sensor.name).render(0)
        with Pipeline(settings, predict=False) as pipeline:
            images[sensor.name] = pipeline.process(measurement)
    fuser = Fuser(
        {each.name: (each.position_m or (), each.quaternion().tolist()) for each in scene.sensors},
        emitter_diameter_m=diameter_m,
    )
    fuser(images.values())
    begin_s = time.perf_counter()
    fused = fuser(images.values())
    assert fused.image.amplitude.size  # noqa: S101  computed when it is used
    return _Shot(scene, images, fused, time.perf_counter() - begin_s)


def _ghosts(shot: _Shot) -> Floats:
    """Return the powers of ghosts in the fused image, and in images that take all echoes for own ones: (ghost, 2).

    Both are powers at 1 m relative to the strongest reflector.
    """
    places = np.array([complex(*(point.position_m or ())[:2]) for point in shot.scene.points])
    reference = max(_highest(shot.fused.image, place) for place in places)
    found = []
    for sensor in shot.scene.sensors:
        image = shot.images[sensor.name]
        for echo in Simulator(shot.scene, sensor=sensor.name).reflectors():
            # A flat array shows sound from behind in front.
            azimuth_deg = echo.azimuth_deg if abs(echo.azimuth_deg) <= 90 else 180 - echo.azimuth_deg
            turn = np.exp(1j * math.radians(azimuth_deg + sensor.yaw_deg))
            place = complex(*(sensor.position_m or ())[:2]) + echo.range_m * turn
            apart = (np.abs(np.abs(places) - abs(place)) > _PULSE_M) | (np.abs(np.angle(place / places)) > _BEAM_RAD)
            inside = image.range_m[0] + _NEAR_M < echo.range_m < image.range_m[-1] - _NEAR_M
            if echo.emitter and echo.level_db > _LOUD_DB and inside and apart.all():
                limits = (azimuth_deg - 4, azimuth_deg + 4), (echo.range_m - _NEAR_M, echo.range_m + _NEAR_M)
                single = image.select(azimuth_deg=limits[0], range_m=limits[1])
                power = (float(single.amplitude.max()) * echo.range_m**2) ** 2
                found.append((_highest(shot.fused.image, place) ** 2, power))
    return np.array(found).reshape(-1, 2) / reference**2


def _position_errors_m(shot: _Shot) -> tuple[list[tuple[float, float]], int]:
    """Return errors of fused points and of the better sensor for reflectors that two sensors see, and lost ones.

    The better sensor is the one that faces the reflector most directly, among those that locate it.
    """
    clouds_m = []
    for sensor in shot.scene.sensors:
        image = shot.images[sensor.name]
        cloud = PointExtractor(image.settings)(image).position_m.astype(np.float64)
        clouds_m.append(cloud @ sensor.rotation().T + np.array(sensor.position_m))
    fused_m = shot.fused.points.position_m.astype(np.float64)
    reference = float(shot.fused.image.amplitude.max())
    errors, lost = [], 0
    for point in shot.scene.points:
        place_m = np.array(point.position_m)
        facing = sorted(shot.scene.sensors, key=lambda each: -_cosine(each, place_m))
        by_name = dict(zip(shot.images, clouds_m, strict=True))
        located = [error for each in facing if (error := _nearest_m(by_name[each.name], place_m)) < _FOUND_M]
        lost += _highest(shot.fused.image, complex(*place_m[:2])) < 0.03 * reference
        here = _nearest_m(fused_m, place_m)
        if len(located) > 1 and here < _FOUND_M:
            errors.append((here, located[0]))
    return errors, lost


def _levels_db(shot: _Shot) -> list[float]:
    """Return the level in the fused image relative to the strength, for reflectors that a confirmed point locates."""
    points = shot.fused.points
    assert points.confirmed is not None  # noqa: S101  by Fuser
    cloud_m = points.position_m[points.confirmed].astype(np.float64)
    return [
        _decibels(_highest(shot.fused.image, complex(*(point.position_m or ())[:2])) ** 2, 1.0) - point.strength_db
        for point in shot.scene.points
        if _nearest_m(cloud_m, np.array(point.position_m)) < _FOUND_M
    ]


def _level_row(levels_db: Floats) -> dict[str, Any]:
    if not len(levels_db):
        return {"n_confirmed": 0, "n_right": 0, "low_db": math.nan, "high_db": math.nan}
    error_db = levels_db - np.median(levels_db)
    low_db, high_db = np.percentile(error_db, (5, 95))
    n_right = int(np.sum(np.abs(error_db) <= 1))
    return {"n_confirmed": len(error_db), "n_right": n_right, "low_db": float(low_db), "high_db": float(high_db)}


def _cosine(sensor: Sensor, place_m: Floats) -> float:
    offset_m = place_m - np.array(sensor.position_m)
    return float(sensor.rotation()[:, 0] @ offset_m / np.linalg.norm(offset_m))


def _wall_errors_m(seed: int, say: Callable[[str], None]) -> Floats:
    """Return the distance of the strongest range of each azimuth from the nearest wall: (azimuth,) float64."""
    draws = np.random.default_rng(seed)
    centre = draws.uniform(-0.3, 0.3, 2)
    half = np.array(_ROOM_M) / 2
    along = [np.arange(-length, length, _SPACING_M) for length in half]
    places = [np.stack([along[0], np.full(len(along[0]), side * half[1])], axis=1) for side in (-1, 1)]
    places += [np.stack([np.full(len(along[1]), side * half[0]), along[1]], axis=1) for side in (-1, 1)]
    place_m = np.concatenate(places) + centre
    place_m += draws.normal(scale=3e-3, size=place_m.shape)
    strength_db = -14 + 20 * np.log10(np.abs(draws.normal(size=len(place_m))) + 0.3)
    points = tuple(
        Point(position_m=(x, y, 0.4), strength_db=level)
        for (x, y), level in zip(place_m.tolist(), strength_db.tolist(), strict=True)
    )
    image = _shot(platform_scene(seed, points, EMITTERS_M[0], -20.0), EMITTERS_M[0]).fused.image
    strongest_m = image.range_m[image.amplitude.argmax(axis=1)]
    shown_m = strongest_m[:, None] * np.stack([np.cos(image.azimuth_rad), np.sin(image.azimuth_rad)], axis=1) - centre
    error_m = np.abs(np.abs(shown_m) - half).min(axis=1)
    say(f"room {seed}: {np.mean(error_m < _WALL_M):.0%} of the azimuths show a wall")
    return np.asarray(error_m)


def _row(diameter_m: float, scenes: list[Floats], positions: Floats, lost: int, count: int) -> dict[str, Any]:
    by_scene_db = [_decibels(*ghosts.sum(axis=0)) for ghosts in scenes]
    ghosts = np.concatenate(scenes)
    rms_m = np.sqrt(np.mean(positions**2, axis=0)) if len(positions) else np.full(2, np.nan)
    return {
        "diameter_m": diameter_m,
        "ghosts_db": float(np.median(by_scene_db)),
        "within_20_db": int(np.sum(np.array(by_scene_db) <= -20)),
        "strongest_db": _decibels(float(ghosts[:, 0].max()), 1.0),
        "strongest_single_db": _decibels(float(ghosts[:, 1].max()), 1.0),
        "n_ghosts": len(ghosts),
        "rms_m": float(rms_m[0]),
        "single_rms_m": float(rms_m[1]),
        "n_positions": len(positions),
        "lost": int(lost),
        "scenes": count,
    }


def _highest(image: Energyscape, place: complex) -> float:
    """Return the highest amplitude near a place."""
    distance_m = np.abs(image.range_m * np.exp(1j * image.azimuth_rad)[:, None] - place)
    return float(image.amplitude[distance_m < _NEAR_M].max(initial=0.0))


def _nearest_m(cloud_m: Floats, place_m: Floats) -> float:
    return float(np.hypot(*(cloud_m[:, :2] - place_m[:2]).T).min(initial=np.inf))


def _decibels(power: float, reference: float) -> float:
    return 10 * math.log10(max(power, 1e-12) / reference)


FORMS = {"fusion": form}
"""Forms of the table, by the name in its markers."""

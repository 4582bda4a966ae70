"""Laser scans of confirmed reflectors among posts, smooth walls and boxes, compared with rays."""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from ertis_bench.markdown import table
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M
from ertis_bench.platform_trials.rendered_rooms import (
    Room,
    images_of,
    mounted,
    nearest_m,
    random_room,
    rendered,
    settings_of,
)
from ertis_numba.fusion import Fuser
from ertis_numba.interop.scans import scan_message

__all__ = ["form", "run"]

_KINDS: Final = "posts", "walls", "boxes", "both"
_SENSORS: Final = mounted(
    {"front": (0.2, 0.0, 0.0), "left": (0.0, 0.2, 90.0), "back": (-0.2, 0.0, 180.0), "right": (0.0, -0.2, -90.0)}
)
_OFF_M: Final = 0.15
_NEARER_M: Final = 0.10
_POST_M: Final = 0.1
_POST_RAD: Final = math.radians(2.0)
_N_RAYS: Final = 9  # of each beam


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the beams of scans that differ from rays, and the posts that scans show, by kind of emitter."""
    rows = []
    for diameter_m in EMITTERS_M:
        fuser, found = Fuser(_SENSORS, emitter_diameter_m=diameter_m), np.zeros(5, np.int64)
        for number in range(seed, seed + count):
            room, settings = random_room(number, _KINDS[number % len(_KINDS)]), settings_of()
            random = np.random.default_rng([number, 1])
            signals = rendered(_SENSORS, settings, room, diameter_m=diameter_m, random=random)
            fused = fuser(images_of(signals, settings).values())
            scan = scan_message(fused.image)
            found += (0, 0, 0, 0, len(room.posts_m))
            if scan is not None:
                found[:4] += _compared(scan, room)
            say(f"scene {number}, emitters of {1000 * diameter_m:g} mm: {found[1]} beams off so far")
        names = "beams", "off", "nearer", "shown", "posts"
        rows.append({"diameter_m": diameter_m, **dict(zip(names, found.tolist(), strict=True))})
    return {"count": count, "seed": seed, "scans": rows}


def _compared(scan: dict[str, Any], room: Room) -> tuple[int, int, int, int]:
    """Return the numbers of beams with an echo, of those that are off, of those too near, and of posts shown."""
    range_m = np.array(scan["ranges"])
    angle_rad = scan["angle_min"] + scan["angle_increment"] * np.arange(len(range_m))
    aside_rad = np.linspace(-0.5, 0.5, _N_RAYS) * scan["angle_increment"]
    true_m = np.array([nearest_m(room, angle_rad + each) for each in aside_rad])
    is_echo = np.isfinite(range_m)
    off_m = np.abs(true_m - np.where(is_echo, range_m, 0.0)).min(axis=0)
    shown = 0
    for x_m, y_m in room.posts_m:
        turn_rad = (angle_rad - math.atan2(y_m, x_m) + math.pi) % (2 * math.pi) - math.pi
        shown += bool(np.any((np.abs(turn_rad) < _POST_RAD) & (np.abs(range_m - math.hypot(x_m, y_m)) < _POST_M)))
    is_nearer = is_echo & (range_m < true_m.min(axis=0) - _NEARER_M)
    return int(is_echo.sum()), int((is_echo & ~(off_m <= _OFF_M)).sum()), int(is_nearer.sum()), shown


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = [
        "emitters",
        "beams with an echo",
        "off by more than 15 cm",
        "nearer than all surfaces by 10 cm",
        "posts shown",
    ]
    rows = [
        [
            f"{1000 * row['diameter_m']:g} mm" if row["diameter_m"] else "omnidirectional",
            f"{row['beams']}",
            f"{row['off']}",
            f"{row['nearer']}",
            f"{row['shown']} of {row['posts']}",
        ]
        for row in report["scans"]
    ]
    return (
        f"{table(head, rows)}\n\n{report['count']} scenes from seed {report['seed']} for each kind of emitter: four to "
        "eight posts, in half of the scenes with one or two smooth walls, and in half with two boxes. A separate "
        "program renders the sound by sums of delayed calls, and casts nine rays in each beam. Most of the other posts "
        "are more than 20 dB weaker than the strongest echo."
    )

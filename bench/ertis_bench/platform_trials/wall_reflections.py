"""Spurious confirmed points, and errors of confirmed posts, where walls reflect sound several times."""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench import machine
from ertis_bench.markdown import table
from ertis_bench.platform_trials.reflecting_scenes import KINDS, PLATFORMS, ReflectingScene
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion import Fuser

__all__ = ["compared", "form", "run"]

Floats = NDArray[np.float64]

_NEAR_M: Final = 0.1  # Distance from a surface within which a point shows it.
_MIN_IMAGES: Final = 2  # A single image confirms no reflector.
_IMAGES: Final = "all", "one missing"


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Fuse all images of scenes with walls and posts, and those without the image of each sensor in turn."""
    scenes = [ReflectingScene.drawn(number, kind) for number in range(seed, seed + count) for kind in KINDS]
    counts: dict[str, Counter[str]] = {each: Counter() for each in _IMAGES}
    errors: dict[str, list[Floats]] = {each: [np.empty((0, 2, 2))] for each in _IMAGES}
    for (platform, diameter_m), group in itertools.groupby(sorted(scenes, key=_platform), _platform):
        fuser = Fuser(PLATFORMS[platform], emitter_diameter_m=diameter_m)
        for scene in group:
            for which, images in _pulses(scene.images()):
                found, errors_m = compared(fuser(images).points, scene)
                counts[which].update(found)
                errors[which].append(errors_m)
            beside = ", ".join(f"{each}: {counts[each]['beside']}" for each in _IMAGES)
            say(f"scene {scene.seed}, {scene.kind}: spurious confirmed points so far, {beside}")
    rows = [{"images": each, **counts[each], **_statistics(np.concatenate(errors[each]))} for each in _IMAGES]
    return {"machine": machine.describe(), "count": count, "seed": seed, "reflections": rows}


def _platform(scene: ReflectingScene) -> tuple[int, float]:
    return scene.platform, scene.diameter_m


def _pulses(images: dict[str, Energyscape]) -> Iterator[tuple[str, list[Energyscape]]]:
    """Yield all images, and those without each one if at least two are left."""
    yield _IMAGES[0], [*images.values()]
    for missing in images if len(images) > _MIN_IMAGES else ():
        yield _IMAGES[1], [image for name, image in images.items() if name != missing]


def compared(points: PointCloud, scene: ReflectingScene) -> tuple[dict[str, int], Floats]:
    """Compare confirmed points with posts and walls.

    Returns
    -------
    found : dict of str to int
        Numbers of pulses, of spurious points, of confirmed posts, and of all posts.
    errors_m : (point, 2, 2) float64
        Error and uncertainty, along and across the range, of each point near a post.
    """
    confirmed = points.only(np.asarray(points.confirmed))
    place_m, posts_m = confirmed.position_m[:, :2].astype(np.float64), scene.room.posts_m
    offset_m = place_m[:, None] - posts_m
    point, post = np.nonzero(np.linalg.norm(offset_m, axis=2) < _NEAR_M)
    ahead = place_m[point] / np.linalg.norm(place_m[point], axis=1, keepdims=True)
    axes = np.stack([ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)], axis=1)
    errors_m = np.einsum("nij,nj->ni", axes, offset_m[point, post])
    found = {
        "pulses": 1,
        "beside": int(np.sum(scene.beside_m(place_m) > _NEAR_M)),
        "confirmed": len(np.unique(post)),
        "posts": len(posts_m),
    }
    return found, np.stack([errors_m, np.asarray(confirmed.uncertainty_m)[point]], axis=1)


def _statistics(errors_m: Floats) -> dict[str, float | None]:
    if not len(errors_m):
        return {"rms_m": None, "z": None, "largest_m": None}
    squared = np.sum(errors_m[:, 0] ** 2, axis=1)
    return {
        "rms_m": math.sqrt(squared.mean()),
        "z": math.sqrt(np.mean((errors_m[:, 0] / errors_m[:, 1]) ** 2)),
        "largest_m": math.sqrt(squared.max()),
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = [
        "images",
        "pulses",
        "spurious confirmed points",
        "confirmed posts",
        "position RMS",
        "error / uncertainty (RMS)",
        "largest error",
    ]
    rows = [
        [
            row["images"],
            f"{row['pulses']}",
            f"{row['beside']}",
            f"{row['confirmed']} of {row['posts']}",
            *(["–"] * 3 if row["z"] is None else _in_words(row)),
        ]
        for row in report["reflections"]
    ]
    return (
        f"{table(head, rows)}\n\n{report['count']} scenes from seed {report['seed']} for each of {len(KINDS)} kinds: "
        "corridors of 1.2 to 3 m, corners and a single wall, each with and without posts, four walls with posts, and "
        "posts alone. Platforms have two to four sensors in six arrangements, with omnidirectional emitters or pistons "
        "of 12 mm. Up to three walls in turn reflect sound from sensor to sensor, and one on each way to or from a "
        "post. A separate program renders the sound by sums of delayed calls. A confirmed point is spurious if it "
        f"is more than {100 * _NEAR_M:g} cm from all posts and walls. A post is confirmed if a confirmed point lies "
        f"within {100 * _NEAR_M:g} cm; errors are those of such points, along and across the range. Each image is left "
        "out in turn if two others remain, because a single one confirms no reflector. "
        f"{machine.sentence(report['machine'])}"
    )


def _in_words(row: dict[str, Any]) -> list[str]:
    return [f"{1000 * row['rms_m']:.1f} mm", f"{row['z']:.2f}", f"{1000 * row['largest_m']:.0f} mm"]

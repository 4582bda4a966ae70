"""Emitters that are broken or stated wrongly, on platforms in random surroundings."""

import math
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from ertis_bench.markdown import table
from ertis_bench.platform_trials.emitter_rooms import EmitterRoom
from ertis_bench.platform_trials.known_posts import silence_ratio
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M
from ertis_numba.fusion import Fused, Fuser

__all__ = ["form", "run"]

_N_PULSES: Final = 3  # within which a broken emitter is to be named
_CERTAIN: Final = math.log(1e3)
_STATED_EVERY: Final = 4  # One of so many platforms also serves for emitters that are stated wrongly.


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Fuse platforms whose emitters all work, and with a broken one, as stated and as the other kind."""
    rows: dict[tuple[float, int], Counter[str]] = {}
    for diameter_m, other_m in zip(EMITTERS_M, EMITTERS_M[::-1], strict=True):
        for number in range(seed, seed + count):
            drawn = EmitterRoom.drawn(number)
            row = rows.setdefault((diameter_m, len(drawn.mountings)), Counter())
            row.update(platforms=1)
            row.update(_healthy(drawn, diameter_m, other_m if number % _STATED_EVERY == 0 else None))
            row.update(_broken(drawn, diameter_m))
            say(f"platform {number}, {drawn.kind}, emitters of {1000 * diameter_m:g} mm: {dict(row)}")
    each = [{"diameter_m": diameter_m, "sensors": n, **row} for (diameter_m, n), row in sorted(rows.items())]
    return {"count": count, "seed": seed, "emitters": each}


def _healthy(drawn: EmitterRoom, diameter_m: float, other_m: float | None) -> dict[str, int]:
    """Return counts for working emitters: pulses, those that name a sensor, sensors without own echo, and warnings."""
    pulses = [drawn.images(pulse, diameter_m, is_broken=False) for pulse in range(_N_PULSES)]
    fuser = Fuser(drawn.mountings, emitter_diameter_m=diameter_m)
    every = [fuser(images) for images in pulses]
    shown = sum(silence_ratio(drawn, each, diameter_m, pulse, "") for pulse, each in enumerate(pulses))
    found = {
        "contrary": bool(np.any(np.asarray(shown) > _CERTAIN)),
        "pulses": len(every),
        "accused": sum(bool(each.unheard) for each in every),
        "doubted": len(every[-1].without_own_echo),
    }
    if other_m is None:
        return found
    other = Fuser(drawn.mountings, emitter_diameter_m=other_m)
    other(pulses[0])
    warnings = fuser.emitter_warning(), other.emitter_warning()
    return found | {"judged": 1, "contradicted": warnings[0] is not None, "found": warnings[1] is not None}


def _broken(drawn: EmitterRoom, diameter_m: float) -> dict[str, int]:
    """Return whether the broken emitter is named, or stated as one without echo, and whether others are named."""
    fuser = Fuser(drawn.mountings, emitter_diameter_m=diameter_m)
    pulses = [drawn.images(pulse, diameter_m, is_broken=True) for pulse in range(_N_PULSES)]
    every: list[Fused] = [fuser(images) for images in pulses]
    shown = sum(silence_ratio(drawn, each, diameter_m, pulse, drawn.broken) for pulse, each in enumerate(pulses))
    is_decidable = bool(np.asarray(shown)[[*drawn.mountings].index(drawn.broken)] > _CERTAIN)
    names = {name for each in every for name in each.unheard}
    is_named = drawn.broken in names
    return {
        "decidable": is_decidable,
        "decided": is_decidable and is_named,
        "named": is_named,
        "stated": is_named or drawn.broken in every[-1].without_own_echo,
        "others": bool(names - {drawn.broken}),
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = [
        "emitters",
        "sensors",
        "decidable",
        "broken ones named",
        "decidable ones named",
        "named, or without own echo",
        "others named then",
        "pulses of working emitters with a name",
        "working ones without own echo",
        "warnings if stated rightly",
        "warnings if stated wrongly",
    ]
    rows = [
        [
            f"{1000 * row['diameter_m']:g} mm" if row["diameter_m"] else "omnidirectional",
            f"{row['sensors']}",
            *(f"{row[key]} of {row['platforms']}" for key in ("decidable", "named")),
            f"{row['decided']} of {row['decidable']}",
            *(f"{row[key]} of {row['platforms']}" for key in ("stated", "others")),
            f"{row['accused']} of {row['pulses']}",
            f"{row['doubted']} of {row['sensors'] * row['platforms']}",
            *(f"{row.get(key, 0)} of {row.get('judged', 0)}" for key in ("contradicted", "found")),
        ]
        for row in report["emitters"]
    ]
    return (
        f"{table(head, rows)}\n\n{report['count']} platforms with two to four sensors for each kind of emitter, from "
        f"seed {report['seed']}, {_N_PULSES} SYNC pulses each. The surroundings are four to eight posts, alone or with "
        "one or two walls, a corridor or a corner with posts, or two to four posts. Platforms move by up to 4 cm from "
        "pulse to pulse. A separate program renders the sound by sums of delayed calls, over at most two walls. "
        "Sensors without own echo are those of `Fused.without_own_echo` after the last pulse. A broken emitter is "
        "decidable for an observer who knows the places and strengths of all posts: at posts that at least two echoes "
        "of other calls show, echoes of its call are missing, with a likelihood ratio of 1000 or more. This rule names "
        f"a working emitter on {sum(row['contrary'] for row in report['emitters'])} of "
        f"{sum(row['platforms'] for row in report['emitters'])} platforms."
    )

"""Output of ``ertis listen --fuse``: one line per SYNC pulse."""

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import click

from ertis_cli import options
from ertis_cli._listen_pulses import listen_pulses

if TYPE_CHECKING:
    from ertis_cli._mountings import Mounting
    from ertis_numba.network.fused_subscriber import FusedArrival
    from ertis_numba.network.keys import ClientKeys

__all__ = ["listen_fused"]

_CHECKED_EVERY = 10  # SYNC pulses: whether echoes prove emission takes longer than the points.
_HEAD = f"{'SYNC':>8}  {'age':>8}  {'points':>6}  {'nearest':24}  sensors"


def listen_fused(
    address: str,
    *,
    sensors: Sequence[str],
    mountings: "dict[str, Mounting] | None",
    keys: "ClientKeys | None",
    n: int | None,
    duration: float | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Print one line per fused pulse until a signal, a count or a duration ends it."""
    from ertis_numba.network.fused_subscriber import FusedSubscriber

    listen_pulses(
        address,
        sensors,
        lambda on_note: FusedSubscriber(
            address, mountings=mountings, sensors=sensors or None, keys=keys, on_note=on_note
        ),
        partial(_show, as_json=as_json),
        head=_HEAD,
        n=n,
        duration=duration,
        quiet=quiet,
        as_json=as_json,
    )


def _show(arrival: "FusedArrival", *, as_json: bool) -> None:
    import numpy as np

    fused = arrival.fused
    points = fused.points.only(np.flatnonzero(fused.points.is_certain))
    range_m = np.linalg.norm(points.position_m, axis=1)
    nearest = int(np.argmin(range_m)) if len(range_m) else None
    age_ms = None if arrival.age_s is None else round(1e3 * arrival.age_s, 3)
    is_checked = fused.stamp.sync_count % _CHECKED_EVERY == 0
    without_own = list(fused.without_own_echo) if is_checked else None
    if as_json:
        known = () if nearest is None or points.uncertainty_m is None else points.uncertainty_m[nearest].tolist()
        position_m = None if nearest is None else [round(each, 4) for each in points.position_m[nearest].tolist()]
        options.print_json(
            {
                "event": "fused",
                "sync_count": fused.stamp.sync_count,
                "timestamp_ns": fused.stamp.timestamp_ns,
                "age_ms": age_ms,
                "n_points": len(range_m),
                "nearest_m": position_m,
                "nearest_sd_m": [round(each, 5) for each in known] or None,
                "sensors": list(fused.sensors),
                "missing": list(fused.missing),
                "unheard": list(fused.unheard),
                "without_echo": list(fused.without_echo),
                "without_own_echo": without_own,
            }
        )
        return
    place = "no echo above noise" if fused.is_empty else "no reflector"
    if nearest is not None:
        x, y, _ = points.position_m[nearest].tolist()
        place = f"{range_m[nearest]:.3f} m at {math.degrees(math.atan2(y, x)):+.1f}°"
    absent = f", without {' '.join(fused.missing)}" if fused.missing else ""
    absent += f", {' '.join(fused.unheard)} not heard" if fused.unheard else ""
    unproven = [name for name in without_own or () if name not in fused.unheard]
    absent += f", emission of {' '.join(unproven)} not proven" if unproven and not fused.is_empty else ""
    age = "-" if age_ms is None else f"{age_ms:.1f} ms"
    row = f"{fused.stamp.sync_count:8d}  {age:>8}  {len(range_m):6d}  {place:24}  {' '.join(fused.sensors)}{absent}"
    click.echo(row)

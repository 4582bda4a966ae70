"""Output of ``ertis listen --odometry``: one line per SYNC pulse, and the trajectory at the end."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ertis_cli import options
from ertis_cli._listen_pulses import listen_pulses

if TYPE_CHECKING:
    from ertis_cli._mountings import Mounting
    from ertis_numba.network.keys import ClientKeys
    from ertis_numba.network.odometry_subscriber import OdometryArrival, OdometrySubscriber

__all__ = ["listen_odometry"]

_HEAD = f"{'SYNC':>8}  {'age':>8}  {'x':>8}  {'y':>8}  {'yaw':>7}  {'speed':>8}  {'yaw rate':>9}  sensors"
_DIGITS = 6
_REMARKS = {
    "pause": "last velocity assumed",
    "few echoes": "last velocity assumed",
    "copies": "images are copies of those before",
    "other motion": "another motion fits as well",
}


def listen_odometry(
    address: str,
    *,
    sensors: Sequence[str],
    mountings: "dict[str, Mounting] | None",
    keys: "ClientKeys | None",
    target: Path | None,
    n: int | None,
    duration: float | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Print one line per pulse until a signal, a count or a duration ends it; then write the trajectory, if any."""
    from ertis_numba.interop import check_tum_target
    from ertis_numba.network.odometry_subscriber import OdometrySubscriber

    if target is not None:
        check_tum_target(target, overwrite=force)
    listen_pulses(
        address,
        sensors,
        lambda on_note: OdometrySubscriber(
            address, mountings=mountings, sensors=sensors or None, keys=keys, on_note=on_note
        ),
        partial(_show, as_json=as_json),
        head=_HEAD,
        at_end=partial(_write, target, force=force, quiet=quiet),
        n=n,
        duration=duration,
        quiet=quiet,
        as_json=as_json,
    )


def _write(target: Path | None, subscriber: "OdometrySubscriber", *, force: bool, quiet: bool) -> None:
    """Write the trajectory; print a line if no pulse came."""
    from ertis_numba import write_tum

    if target is None:
        return
    trajectory = subscriber.trajectory
    if trajectory is None:
        options.say(f"{target} is not written, because no pulse was received", quiet=quiet)
        return
    write_tum(target, trajectory, overwrite=force)
    options.say(f"{target}: {options.counted(len(trajectory.time_ns), 'pose')}", quiet=quiet)


def _show(arrival: "OdometryArrival", *, as_json: bool) -> None:
    if as_json:
        options.print_json(_event(arrival))
        return
    pose, velocity = arrival.pose, arrival.velocity
    age = "-" if arrival.age_s is None else f"{1e3 * arrival.age_s:.0f} ms"
    speed, turn = "-", "-"
    if velocity is not None:
        speed = f"{math.hypot(*velocity.velocity_m_s.tolist()):.2f} m/s"
        turn = f"{math.degrees(velocity.yaw_rate_rad_s):+.1f} °/s"
    remarks = [f"without {' '.join(arrival.missing)}"] if arrival.missing else []
    remarks += [f"{options.counted(arrival.n_lost, 'pulse')} lost"] if arrival.n_lost else []
    remarks += [_REMARKS[pose.doubt]] if pose.doubt else []
    click.echo(
        f"{arrival.sync_count:8d}  {age:>8}  {pose.x_m:+6.3f} m  {pose.y_m:+6.3f} m  "
        f"{math.degrees(pose.yaw_rad):+6.1f}°  {speed:>8}  {turn:>9}  "
        f"{', '.join([' '.join(arrival.sensors), *remarks])}"
    )


def _event(arrival: "OdometryArrival") -> dict[str, object]:
    pose, velocity = arrival.pose, arrival.velocity
    event: dict[str, object] = {
        "event": "odometry",
        "sync_count": arrival.sync_count,
        "timestamp_ns": pose.timestamp_ns,
        "age_ms": None if arrival.age_s is None else round(1e3 * arrival.age_s, 3),
        "x_m": round(pose.x_m, _DIGITS),
        "y_m": round(pose.y_m, _DIGITS),
        "yaw_deg": round(math.degrees(pose.yaw_rad), _DIGITS),
        "covariance": pose.covariance.tolist(),
        "measured": pose.is_measured,
        "doubt": pose.doubt or None,
        "velocity_m_s": None,
        "yaw_rate_deg_s": None,
        "n_matches": None,
    }
    if velocity is not None:
        event["velocity_m_s"] = [round(each, _DIGITS) for each in velocity.velocity_m_s.tolist()]
        event["yaw_rate_deg_s"] = round(math.degrees(velocity.yaw_rate_rad_s), _DIGITS)
        event["n_matches"] = velocity.n_matches
    return event | {"sensors": list(arrival.sensors), "missing": list(arrival.missing), "lost": arrival.n_lost}

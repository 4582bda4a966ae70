"""Output of ``ertis listen --bearings``: one line per bearing of each acoustic map."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import click

from ertis_cli import options
from ertis_cli._listen_pulses import listen_pulses
from ertis_numba.base.constants import FALSE_ALARM

if TYPE_CHECKING:
    from ertis_numba.frames import AcousticMap, Bearing
    from ertis_numba.network.acoustic_map_subscriber import AcousticMapSubscriber
    from ertis_numba.network.keys import ClientKeys

__all__ = ["listen_bearings"]

_HEAD = f"{'sensor':12}  {'sequence':>8}  {'age':>8}  {'band':>15}  {'azimuth':>14}  {'elevation':>14}  {'level':>9}"


def listen_bearings(
    address: str,
    *,
    sensors: Sequence[str],
    average: int | None,
    keys: "ClientKeys | None",
    n: int | None,
    duration: float | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Print the bearings of each acoustic map until a signal, a count or a duration ends it."""
    from ertis_numba.network.acoustic_map_subscriber import AcousticMapSubscriber

    subscribers: list[AcousticMapSubscriber] = []
    checked: set[str] = set()
    outside: set[str] = set()
    doubtful: set[str] = set()

    def connect(on_note: Callable[[str], None]) -> AcousticMapSubscriber:
        changes = {} if average is None else {"passive.averages": average}
        subscribers.append(
            AcousticMapSubscriber(
                address, sensors=sensors or None, changes=changes, false_alarm=FALSE_ALARM, keys=keys, on_note=on_note
            )
        )
        return subscribers[0]

    def show(found: "AcousticMap") -> None:
        if (sensor := found.stamp.sensor) not in checked:
            checked.add(sensor)
            options.note_unknown_bearings(sensor, found.settings)
        if subscribers[0].band_note is not None and sensor not in outside:
            outside.add(sensor)
            options.warn_of(sensor, subscribers[0].band_note)
        if sensor not in doubtful and options.note_doubts(sensor, subscribers[0].bearings):
            doubtful.add(sensor)
        _show(found, subscribers[0].bearings, _age_ms(subscribers[0]), as_json=as_json)

    def report_active(subscriber: AcousticMapSubscriber) -> None:
        if subscriber.n_active:
            options.say(
                f"left out {options.counted(subscriber.n_active, 'measurement')} with a call; record with "
                "'ertis capture --passive', or set processing.mode to 'passive'",
                quiet=quiet,
            )

    listen_pulses(
        address,
        sensors,
        connect,
        show,
        head=_HEAD,
        of=("map", "measurements"),
        product="raw",
        at_end=report_active,
        n=n,
        duration=duration,
        quiet=quiet,
        as_json=as_json,
    )


def _age_ms(subscriber: "AcousticMapSubscriber") -> float | None:
    age_s = None if subscriber.latest is None else subscriber.latest.age_s
    return None if age_s is None else round(1e3 * age_s, 3)


def _show(found: "AcousticMap", bearings: "Sequence[Bearing]", age_ms: float | None, *, as_json: bool) -> None:
    stamp = found.stamp
    if as_json:
        options.print_json(
            {
                "event": "bearings",
                "sensor": stamp.sensor,
                "sequence": stamp.sequence,
                "sync_count": stamp.sync_count,
                "timestamp_ns": stamp.timestamp_ns,
                "age_ms": age_ms,
                "averages": found.n_measurements,
                "masked_s": found.masked_s,
                "bearings": [each.as_dict() for each in bearings],
            }
        )
        return
    age = "-" if age_ms is None else f"{age_ms:.1f} ms"
    start = f"{stamp.sensor:12}  {stamp.sequence:8d}  {age:>8}"
    if not bearings:
        click.echo(f"{start}  no source")
    for each in bearings:
        band = f"{each.band_hz[0] / 1e3:.1f}-{each.band_hz[1] / 1e3:.1f} kHz"
        azimuth, elevation = _angle(each.azimuth_deg, each.sideways_deg), _angle(each.elevation_deg, each.upwards_deg)
        level, unit = each.level
        doubt = "".join(f"  may be {name}" for name in each.doubts)
        click.echo(f"{start}  {band:>15}  {azimuth:>14}  {elevation:>14}  {level:.1f} {unit}{doubt}")


def _angle(angle_deg: float, size_deg: float) -> str:
    return f"{angle_deg:+.2f} ± {size_deg:.2f}°" if math.isfinite(size_deg) else "unknown"

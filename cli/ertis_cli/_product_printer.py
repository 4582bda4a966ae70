"""Output of ``ertis listen``: products and events of the connection."""

import functools
import time
import zlib
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.analysis.point_finder import PointFinder
    from ertis_numba.frames import Measurement, PointCloud
    from ertis_numba.network.messages import Group
    from ertis_numba.network.products import Arrival
    from ertis_numba.network.status import Status
    from ertis_numba.network.subscriber import SubscriberCounts

__all__ = ["PRINTERS", "ProductTable"]

_HEAD = f"{'sensor':12}  {'sequence':>8}  {'age':>8}  {'made in':>8}  {'dropped':>7}  what"
_MADE = frozenset({"energyscape", "points"})  # Products of measurements with a call.
_SOON_S = 3.0
_SILENT_S = 5.0
_STAMP = (
    *("sensor", "session_id", "sequence", "sync_count", "timestamp_ns", "uncertainty_ns", "monotonic_ns"),
    "behaviour",
)
_ROW = "{sensor:12}  {sequence:8d}  {age:>8}  {made_in:>8}  {dropped:7d}  {text}"


class _Connected(Protocol):
    counts: Any

    @property
    def connected(self) -> bool: ...


class ProductTable:
    """Printer of received products: one line per product, or one JSON object per event."""

    def __init__(self, *, as_json: bool, quiet: bool) -> None:
        self._as_json, self._quiet = as_json, quiet
        self._reported_names = self._noted = False
        self._of_sensors = ""
        self._subscribed_s: float | None = (
            None  # None once a product has arrived, or the absence of products was reported
        )

    def head(self) -> None:
        """Print the column headings."""
        if not self._as_json:
            click.echo(_HEAD)

    def connection(
        self, subscriber: _Connected, address: str, sensors: tuple[str, ...], products: tuple[str, ...], since_s: float
    ) -> None:
        """Report once that a publisher answers, that it does not answer, or that it sends nothing."""
        if subscriber.connected:
            self.subscribed(address, sensors, products)
            self.silent(address, products, subscriber.counts.received)
        else:
            self.unanswered(address, since_s)

    def subscribed(self, address: str, sensors: tuple[str, ...], products: tuple[str, ...]) -> None:
        """Report once that a publisher answers, and note the requested sensors for `silent`."""
        if self._as_json and not self._reported_names:
            options.print_json(
                {
                    "event": "subscribed",
                    "address": address,
                    "sensors": list(sensors) or None,
                    "products": list(products),
                }
            )
        if not self._reported_names:
            self._subscribed_s, self._of_sensors = time.monotonic(), f" of {', '.join(sensors)}" if sensors else ""
        self._reported_names = True

    def silent(self, address: str, products: tuple[str, ...], n_received: int, *, at_end: bool = False) -> None:
        """Report once, after a delay or at the end, that a connected publisher has sent nothing."""
        if self._subscribed_s is None:
            return
        if not (n_received or at_end) and time.monotonic() - self._subscribed_s < _SILENT_S:
            return
        self._subscribed_s = None
        if n_received:
            return
        with_call = " without --passive" if _MADE.issuperset(products) else ""
        text = (
            f"no {' and no '.join(products)}{self._of_sensors} received from {address} yet; is 'ertis capture --to' "
            f"running{with_call}? Check with 'ertis sensors status'"
        )
        if self._as_json:
            options.print_json({"event": "waiting", "address": address, "text": text})
        options.say(text, quiet=self._quiet)

    def require_answer(self, address: str, took_s: float) -> None:
        """Raise a ClickException if no publisher has answered at all."""
        if not self._reported_names:
            raise click.ClickException(
                f"{address} has not answered in {took_s:.3g} s; start 'ertis serve' there, or check the address"
            )

    def unanswered(self, address: str, since_s: float) -> None:
        """Report once, after a delay, that no node answers; `note` then reports the first connection too."""
        if self._reported_names or self._noted or since_s < _SOON_S:
            return
        self._noted = True
        text = f"waiting for {address}: no answer; is 'ertis serve' running?"
        if self._as_json:
            options.print_json({"event": "waiting", "address": address, "text": text})
        options.say(text, quiet=self._quiet)

    def note(self, text: str) -> None:
        """Report an event of the connection; the first connection is reported only after a reported wait."""
        was_quiet, self._noted = not self._noted and text == "connected", True
        if was_quiet:
            return
        if self._as_json:
            options.print_json({"event": "note", "text": text})
        options.say(text, quiet=self._quiet)

    def show_notes(self, notes: deque[str]) -> None:
        """Report the events of the connection that other threads have noted."""
        while notes:
            self.note(notes.popleft())

    def product(self, arrival: "Arrival", counts: "SubscriberCounts") -> None:
        """Print a received product."""
        header = arrival.header
        about, text = PRINTERS[header.product](self, arrival.item)
        age_s, made_in_s = arrival.age_s, arrival.made_in_s
        if self._as_json:
            stamp = {name: getattr(header, name) for name in _STAMP if hasattr(header, name)}
            times = {"age_ms": age_s, "made_in_ms": made_in_s}
            rounded = {name: None if value is None else round(1e3 * value, 3) for name, value in times.items()}
            options.print_json(
                {"event": header.product, "number": header.number, "dropped": counts.dropped}
                | stamp
                | rounded
                | {"arrived_ns": arrival.arrived_ns}
                | about
            )
            return
        click.echo(
            _ROW.format(
                sensor=getattr(header, "sensor", "-"),
                sequence=getattr(header, "sequence", header.number),
                age=_reported(age_s),
                made_in=_reported(made_in_s),
                dropped=counts.dropped,
                text=text,
            )
        )

    def end(self, counts: "SubscriberCounts", target: Path | None, took_s: float) -> None:
        """Print a summary."""
        if self._as_json:
            options.print_json(
                {
                    "event": "listened",
                    "received": counts.received,
                    "dropped": counts.dropped,
                    "missed": counts.missed,
                    "reconnects": counts.reconnects,
                    "output": None if target is None else str(target),
                    "seconds": round(took_s, 3),
                }
            )
        where = "" if target is None else f"{target}: "
        again = f", {options.counted(counts.reconnects, 'reconnect')}" if counts.reconnects else ""
        options.say(f"{where}{counts.received} received, {counts.dropped} dropped{again}", quiet=self._quiet)

    @functools.cached_property
    def find(self) -> "PointFinder":
        """Finder of points in energyscapes."""
        from ertis_numba.analysis.point_finder import PointFinder

        return PointFinder()


def _reported(time_s: float | None) -> str:
    return "-" if time_s is None else f"{1e3 * time_s:.1f} ms"


def _of_points(cloud: "PointCloud") -> tuple[dict[str, Any], str]:
    """Return the number of points and the nearest point, as JSON fields and as text."""
    import numpy as np

    about: dict[str, Any] = {"n_points": len(cloud), "nearest": None}
    if not len(cloud):
        return about, "no reflector"
    x, y, z = cloud.position_m[np.argmin(np.linalg.norm(cloud.position_m, axis=1))].tolist()
    range_m = float(np.linalg.norm((x, y, z)))
    azimuth_deg = float(np.degrees(np.arctan2(y, x)))
    elevation_deg = float(np.degrees(np.arcsin(z / range_m)))
    about["nearest"] = {
        "azimuth_deg": round(azimuth_deg, 2),
        "elevation_deg": round(elevation_deg, 2),
        "range_m": round(range_m, 4),
    }
    return about, f"{range_m:.3f} m at {azimuth_deg:+.1f}°, {elevation_deg:+.1f}°"


def _of_measurement(item: "Measurement") -> tuple[dict[str, Any], str]:
    crc32 = zlib.crc32(item.data.data)
    return {"crc32": crc32}, f"{item.data.nbytes} bytes, CRC-32 {crc32:08x}"


def _of_group(item: "Group") -> tuple[dict[str, Any], str]:
    odd = "".join(f", {flag}" for flag in item.flags)
    about = {"group": item.group, "sensors": item.sensors, "missing": item.missing, "flags": item.flags}
    return about | {"spread_ns": item.spread_ns}, f"{' '.join(item.sensors)}{odd}"


def _of_status(item: "Status") -> tuple[dict[str, Any], str]:
    received = sum(each.received for each in item.sensors.values())
    text = f"{item.state}, {options.counted(len(item.sensors), 'sensor')}, {received} received"
    return {"state": item.state, "received": received}, text


PRINTERS: Final[dict[str, Callable[[ProductTable, Any], tuple[dict[str, Any], str]]]] = {
    "energyscape": lambda table, item: _of_points(table.find(item)),
    "points": lambda _, item: _of_points(item),
    "raw": lambda _, item: _of_measurement(item),
    "group": lambda _, item: _of_group(item),
    "status": lambda _, item: _of_status(item),
}
"""Description of each product, as JSON fields and as text."""

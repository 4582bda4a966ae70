"""Capture that sends measurements to a central node, and its report."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_cli._naming import with_options
from ertis_cli._watch import Watch

if TYPE_CHECKING:
    from ertis_numba.devices.bits import BitCheck
    from ertis_numba.devices.capture import CaptureSession
    from ertis_numba.network.keys import ClientKeys
    from ertis_numba.network.sensor_node import Acknowledged, SensorNode, SettingsRequest
    from ertis_numba.settings import Settings

__all__ = ["Sending"]

_SAFE_S = 3.0
_SOON_S = 1.0
_COUNTS = ("refused", "overwritten", "damaged", "unacked")


class _Watch(Watch):
    """Reporter of a capture that also reports acknowledgements of the central node."""

    word = "kept"
    node: "SensorNode | None" = None

    def acked_through(self, acked_through: "Acknowledged") -> None:
        """Report acknowledged measurements."""
        if self._as_json:
            event = {
                "event": "acked_through",
                "sensor": acked_through.sensor,
                "session_id": acked_through.session_id,
                "acked_through": acked_through.acked_through,
            }
            self._print(
                event | {"status": acked_through.status, "dropped": [list(each) for each in acked_through.dropped]}
            )

    def linked(self, text: str) -> None:
        """Report an event of the connection to the central node."""
        text = with_options(text, self._context)
        if self._as_json:
            self._print({"event": "note", "text": text})
        self._say(text)

    def _more(self) -> Iterator[str]:
        if self.node is not None:
            yield f"{self.node.unacked} unacknowledged"
            yield f"central node: {self.node.central}"


class Sending:
    """Capture whose measurements go to a central node, with limits of spool and memory in MB or None."""

    def __init__(
        self,
        address: str,
        settings: "Settings",
        *,
        spool: Path | None,
        limits_mb: tuple[float | None, float | None],
        is_fixed: bool,
        quiet: bool,
        as_json: bool,
    ) -> None:
        for option, size_mb in zip(("--spool-size", "--ring"), limits_mb, strict=True):
            if size_mb is not None:
                _require_room(option, size_mb, settings)
        sizes_mb = dict(zip(("spool_bytes", "ring_bytes"), limits_mb, strict=True))
        self.address, self._spool, self._quiet = address, spool, quiet
        self._sizes = {name: round(1e6 * size_mb) for name, size_mb in sizes_mb.items() if size_mb is not None}
        self.watch = _Watch(quiet=quiet, as_json=as_json)
        self._is_fixed = is_fixed
        self._session: CaptureSession | None = None
        self.report: dict[str, Any] = {}
        self.n_lost = 0

    def node(self, keys: "ClientKeys | None") -> "SensorNode":
        """Return the sensor node; open it before `run`, and close it afterwards."""
        from ertis_numba.network.sensor_node import SensorNode

        self._node = self.watch.node = SensorNode(
            self.address,
            keys=keys,
            spool=self._spool,
            on_acked=self.watch.acked_through,
            on_note=self.watch.linked,
            on_settings=None if self._is_fixed else self._change,
            **self._sizes,
        )
        return self._node

    def run(self, session: "CaptureSession", checks: "dict[str, BitCheck]", *, patience_s: float) -> Exception | None:
        """Capture, wait for the acknowledgement of all measurements, and return the error, if any."""
        from ertis_numba.base.errors import NetworkError

        where = (
            f"unacknowledged measurements are safe in {self._spool}; the next capture with --spool sends them"
            if self._spool
            else "measurements that the central node has not acknowledged are lost"
        )
        self._session = session
        failure = self.watch.run(session, self._node, checks, where=where)
        if self._spool and self._node.central == "away":  # the spooled measurements can be sent later
            patience_s = min(patience_s, _SAFE_S)
        try:
            if not self._node.flush(min(patience_s, _SOON_S)) and patience_s > _SOON_S:
                self._say(f"waiting up to {patience_s:g} s for the central node; press Ctrl-C to stop waiting")
                self._node.flush(patience_s - _SOON_S)
        except (KeyboardInterrupt, SystemExit):
            click.echo(where, err=True)
            raise
        lost = self._account()
        if lost and failure is not None:
            click.echo(f"ertis: error: {lost}", err=True)
        return failure or (NetworkError(lost) if lost else None)

    def _change(self, request: "SettingsRequest") -> None:
        """Change the settings of all sensors at the request of an admin."""
        from ertis_numba.base.errors import SonarError
        from ertis_numba.devices.capture import SettingsChange

        session = self._session
        if session is None:
            request.refuse("the capture has not begun; try again")
            return
        if request.sensor not in session.counts:
            request.refuse(f"this capture has no sensor {request.sensor}, only {', '.join(session.counts)}")
            return

        def answer(error: Exception | None) -> None:
            sensors = list(session.counts)
            if error is not None:
                request.refuse(str(error))
                self.watch.note(request.sensor, f"new settings were refused: {error}")
                return
            request.accept(sensors)
            for sensor in sensors:
                self.watch.note(sensor, "new settings, requested by an admin")

        try:
            session.change(SettingsChange(request.settings, answer))
        except SonarError as error:
            request.refuse(str(error))

    def _account(self) -> str:
        """Summarise all measurements, and return an error message if some are lost."""
        counts = self._node.counts.values()
        total = {
            name: sum(getattr(each, name) for each in counts) for name in (*_COUNTS, "accepted", "stored", "taken")
        }
        dropped: Counter[str] = sum((each.dropped for each in counts), Counter())
        self.report = {
            "kept": total["accepted"],
            "central": {"stored": total["stored"], "accepted": total["taken"], "dropped": dict(dropped)},
            **{name: total[name] for name in _COUNTS},
            "reconnects": self._node.reconnects,
        }
        for reason, count in dropped.items():
            self._say(f"{options.counted(count, 'measurement')} dropped by the central node ({reason})")
        waiting = options.counted(total["unacked"], "measurement")
        if self._spool and total["unacked"]:
            self._say(f"{waiting} unacknowledged in {self._spool}; the next capture with --spool sends them")
        lost = sum(total[name] for name in _COUNTS) - (total["unacked"] if self._spool else 0)
        self.n_lost = lost
        reported = f"{options.counted(lost, 'measurement')} not acknowledged by the central node at {self.address}"
        return f"{reported}{self._remedy()}" if lost else ""

    def _remedy(self) -> str:
        """Return the cause of lost measurements, if known, and the remedy."""
        if self._node.refusal:  # contains the remedy
            return f": {self._node.refusal}"
        keep = "raise --spool-size" if "spool_bytes" in self._sizes else "keep the spool on a larger disk"
        if not self._spool:
            keep = "add --spool DIR to keep measurements on disk"
        if self._node.central == "away":
            return f", which does not answer; start 'ertis record' or 'ertis serve' there, or {keep}"
        return f"; {keep}"

    def _say(self, text: str) -> None:
        options.say(text, quiet=self._quiet)


def _require_room(option: str, size_mb: float, settings: "Settings") -> None:
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.journal import JournalSensor

    min_mb = 1e-6 * JournalSensor.from_settings("any", settings).n_bytes
    if size_mb < min_mb:
        raise ArgumentError(
            f"{option} is {size_mb:g} MB, but one measurement has {min_mb:.3g} MB; use a larger size, or remove it"
        )

"""Sensor nodes."""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Generic, Self, TypeVar

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.journal import Entry, JournalSensor
from ertis_numba.network import addresses
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.log import logger
from ertis_numba.network.messages import MAX_SEQUENCE
from ertis_numba.network.sensor_node._disk import DiskSpool
from ertis_numba.network.sensor_node._link import Central, Link
from ertis_numba.network.sensor_node._spool import SensorCounts, Spool
from ertis_numba.network.sensor_node._wire import Acknowledged
from ertis_numba.settings import Settings

__all__ = ["SensorNode"]

CallbackArgument = TypeVar("CallbackArgument")


class _UserCallback(Generic[CallbackArgument]):
    """Calls a function of the user; where that fails, it is logged once until it works again, and nothing ends."""

    def __init__(self, name: str, function: Callable[[CallbackArgument], None]) -> None:
        self._name, self._function, self._fails = name, function, False

    def __call__(self, reported: CallbackArgument) -> None:
        try:
            self._function(reported)
        except Exception as error:  # noqa: BLE001  measurements are sent whatever becomes of who watches
            if not self._fails:
                logger("sensor_node").error("listener", text=f"{self._name} failed: {type(error).__name__}: {error}")
            self._fails = True
        else:
            self._fails = False


class SensorNode:
    """Takes measurements, keeps them, and sends them until the central node has them.

    Use it in a ``with`` statement. It is a sink of `ertis_numba.capture.Session`. Threads may share it. It never
    waits for the network: while the central node is away, measurements are kept, in memory or on a disk.

    Parameters
    ----------
    address : str
        Of the central node, ``tcp://HOST:PORT``.
    keys : ClientKeys, optional
        Wanted by any address but loopback.
    spool : Path, optional
        Folder of journals where measurements are durable until the central node has them; what earlier nodes left
        there is sent first. In memory by default.
    ring_bytes : int
        Of measurements in memory. Without a spool, the oldest become gaps when it is full; with one, later ones are
        read from the disk when it is their turn.
    spool_bytes : int, optional
        Of measurements in the spool; when it is full, new ones are refused and become gaps. As much as the disk
        allows by default.
    on_acked : callable, optional
        Called with a `Acknowledged` when the central node has more, from another thread. An exception is logged.
    on_note : callable, optional
        Called with a line about what whoever watches should know, from another thread. An exception is logged.

    Raises
    ------
    ArgumentError
        The address cannot be used, or not without keys.
    """

    def __init__(
        self,
        address: str,
        *,
        keys: ClientKeys | None = None,
        spool: str | Path | None = None,
        ring_bytes: int = 64_000_000,
        spool_bytes: int | None = None,
        on_acked: Callable[[Acknowledged], None] = lambda _: None,
        on_note: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._address, self._keys = addresses.endpoint(address), keys
        addresses.require_keys(self._address, keys=keys)
        self._on_acked, self._on_note = _UserCallback("on_acked", on_acked), _UserCallback("on_note", on_note)
        if spool_bytes is not None and spool is None:
            raise ArgumentError("spool_bytes is given without a spool; give its folder, too")
        checks.integer("ring_bytes", ring_bytes, 1)
        self._spool = (
            Spool(ring_bytes)
            if spool is None
            else DiskSpool(Path(spool), ring_bytes, spool_bytes, on_note=self._on_note)
        )
        self._link: Link | None = None

    def __enter__(self) -> Self:
        self._spool.open()
        self._link = Link(
            self._address, keys=self._keys, spool=self._spool, on_acked=self._on_acked, on_note=self._on_note
        )
        self._link.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Send no more; closing twice does no harm. What is in memory only is lost, so `flush` before."""
        if self._link is not None:
            self._link.stop()
            self._link = None
        self._spool.close()

    def add_sensor(
        self,
        name: str,
        settings: Settings,
        *,
        firmware: str = "",
        translation_m: Sequence[float] | None = None,
        rotation_xyzw: Sequence[float] | None = None,
    ) -> None:
        """Tell of a sensor before its first measurement; told again, it counts for epochs that follow.

        Parameters are those of `ertis_numba.journal.Journal.add_sensor`.

        Raises
        ------
        ArgumentError
            No recording could hold this, or a measurement is longer than the memory.
        """
        made = JournalSensor.of(
            name, settings, firmware=firmware, translation_m=translation_m, rotation_xyzw=rotation_xyzw
        )
        self._spool.add_sensor(made)

    def append(self, entries: Sequence[Entry]) -> list[Entry]:
        """Keep measurements until the central node has them; with a spool, they are durable when this returns.

        Parameters
        ----------
        entries : sequence of Entry
            Of any sensors in any order, whose words nobody changes from now on. The sequence numbers of a sensor rise
            within an epoch. Their ``crc32`` is filled in where it is None.

        Returns
        -------
        list of Entry
            Those that are kept; the others have become gaps, as the spool had no room.

        Raises
        ------
        ArgumentError
            A measurement does not fit to its sensor, or its number does not rise.
        """
        kept = self._spool.append(entries)
        self._wake()
        return kept

    def note_gap(self, sensor: str, first: int, last: int, reason: str, *, session_id: int) -> None:
        """Say why sequence numbers of a run of a sensor are missing, ``first`` and ``last`` included.

        Raises
        ------
        ArgumentError
            There is no such sensor or epoch, ``last`` comes before ``first``, or the reason is no line of at most 64
            bytes.
        """
        checks.sequence_gap(first, last, reason)
        last = checks.integer("last missing sequence number", last, 0, MAX_SEQUENCE)
        self._spool.note_gap(
            sensor, int(first), last, reason, session_id=checks.integer("session_id", session_id, 0, 2**63 - 1)
        )
        self._wake()

    def _wake(self) -> None:
        if self._link is not None:
            self._link.wake()

    def flush(self, timeout_s: float, stop: Callable[[], bool] = lambda: False) -> bool:
        """Wait until the central node has everything, and return whether it has.

        Parameters
        ----------
        timeout_s : float
        stop : callable, optional
            Asked ten times a second whether to wait no longer.
        """
        return self._spool.wait(timeout_s, stop)

    @property
    def counts(self) -> dict[str, SensorCounts]:
        """What became of each sensor's measurements so far; a copy."""
        return self._spool.counts_now()

    @property
    def unacked(self) -> int:
        """Measurements that the central node does not have yet, as far as it has said."""
        return sum(counts.unacked for counts in self.counts.values())

    @property
    def central(self) -> Central:
        """How the central node is, as it says: "storage", "processing", "fault", "closing", or "away"."""
        return "away" if self._link is None else self._link.central

    @property
    def refusal(self) -> str:
        """Why the central node takes nothing of some sensor, and what to do about it; empty where it takes all."""
        return "" if self._link is None else self._link.refusal

    @property
    def reconnects(self) -> int:
        """How often the central node was away and came back."""
        return 0 if self._link is None else self._link.reconnects

    @property
    def is_durable(self) -> bool:
        """Whether what is kept outlives this process."""
        return self._spool.is_durable

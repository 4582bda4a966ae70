"""Sensor nodes."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, Self, TypeVar

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import JournalEntry, JournalSensor
from ertis_numba.network import addresses
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.log import logger
from ertis_numba.network.messages import MAX_SEQUENCE
from ertis_numba.network.owner import Owner
from ertis_numba.network.sensor_node._disk_spool import DiskSpool
from ertis_numba.network.sensor_node._link import Central, Link
from ertis_numba.network.sensor_node._memory_spool import SensorCounts, Spool
from ertis_numba.network.sensor_node._settings_requests import SettingsRequest
from ertis_numba.network.sensor_node._wire import Acknowledged, crc32_of
from ertis_numba.network.trace import mark
from ertis_numba.settings import Settings

__all__ = ["SensorNode"]

CallbackArgument = TypeVar("CallbackArgument")


class _UserCallback(Generic[CallbackArgument]):
    """Caller of a user's function; an error in it is logged once until it works again, and ends nothing."""

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
    """Node that keeps measurements and sends them until the central node has acknowledged them.

    Use it in a ``with`` statement. It is a sink of `ertis_numba.devices.capture.CaptureSession`. Threads may share it.
    It never waits for the network: while the central node is away, it keeps measurements in memory or on disk.

    Parameters
    ----------
    address : str
        Address of the central node, ``tcp://HOST:PORT``.
    keys : ClientKeys, optional
        Required for any address but loopback.
    spool : Path, optional
        Folder of journals that keep measurements on disk until the central node has acknowledged them. Measurements
        left by earlier nodes are sent first. By default, measurements are kept in memory.
    ring_bytes : int
        Limit on the data in memory. Without a spool, the oldest measurements of a full ring become gaps. With a spool,
        later ones are read from disk when they are sent.
    spool_bytes : int, optional
        Limit on the data in the spool. A full spool refuses new measurements, which become gaps. Limited by the disk by
        default.
    on_acked : callable, optional
        Called with an `Acknowledged` for each acknowledgement, from another thread. An exception is logged.
    on_note : callable, optional
        Called with a line for each event of interest to users, from another thread. An exception is logged.
    on_settings : callable, optional
        Called with a `SettingsRequest` when an admin requests new settings for a sensor, from another thread. Such
        requests are refused by default.

    Raises
    ------
    ArgumentError
        The address cannot be used, or requires keys.

    Examples
    --------
    >>> with SensorNode("tcp://127.0.0.1:5601", spool=Path("spool")) as node:  # doctest: +SKIP
    ...     node.add_sensor("front", settings)
    ...     node.append(entries)
    ...     node.flush(10.0)
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
        on_settings: Callable[[SettingsRequest], None] | None = None,
    ) -> None:
        self._address, self._keys = addresses.endpoint(address), keys
        addresses.require_keys(self._address, keys=keys)
        self._on_acked, self._on_note = _UserCallback("on_acked", on_acked), _UserCallback("on_note", on_note)
        self._on_settings = None if on_settings is None else _UserCallback("on_settings", on_settings)
        if spool_bytes is not None and spool is None:
            raise ArgumentError("spool_bytes is given without a spool; set its folder with spool")
        checks.integer("ring_bytes", ring_bytes, 1)
        self._spool = (
            Spool(ring_bytes)
            if spool is None
            else DiskSpool(Path(spool), ring_bytes, spool_bytes, on_note=self._on_note)
        )
        self._link: Link | None = None
        self._owner = Owner("sensor node")

    def __enter__(self) -> Self:
        self._owner = Owner("sensor node")
        self._spool.open()
        self._link = Link(
            self._address,
            keys=self._keys,
            spool=self._spool,
            on_acked=self._on_acked,
            on_note=self._on_note,
            on_settings=self._on_settings,
        )
        self._link.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop sending; closing twice is harmless. Measurements kept only in memory are lost, so call `flush` first."""
        if not self._owner.is_this_process:
            return
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
        """Register a sensor before its first measurement; new settings apply to the following sessions.

        Parameters are those of `ertis_numba.journal.Journal.add_sensor`.

        Raises
        ------
        ArgumentError
            A recording cannot contain this sensor, or a measurement exceeds the memory.
        """
        made = JournalSensor.from_settings(
            name, settings, firmware=firmware, translation_m=translation_m, rotation_xyzw=rotation_xyzw
        )
        self._spool.add_sensor(made)

    def append(self, entries: Sequence[JournalEntry]) -> list[JournalEntry]:
        """Keep measurements until the central node has acknowledged them; with a spool, they are on disk on return.

        Parameters
        ----------
        entries : sequence of JournalEntry
            Measurements of any sensors in any order, whose data must not change any more. The sequence numbers of a
            sensor rise within a session. ``crc32`` is filled in if it is None.

        Returns
        -------
        list of JournalEntry
            Kept measurements; the others have become gaps, because the spool is full.

        Raises
        ------
        ArgumentError
            A measurement does not match its sensor, or its number does not rise.
        """
        self._owner.require_this_process()
        kept = self._spool.append(entries)
        for entry in kept:
            mark("kept", entry.measurement.stamp.sensor, entry.measurement.stamp.sequence)
        for entry in kept[:1]:
            crc32_of(entry)
        self._wake()  # The first is sent while the CRC-32 of the others is computed.
        for entry in kept[1:]:
            crc32_of(entry)
        return kept

    def note_gap(self, sensor: str, first: int, last: int, reason: str, *, session_id: int) -> None:
        """Register missing sequence numbers of a sensor's session, ``first`` and ``last`` included, with their reason.

        Raises
        ------
        ArgumentError
            The sensor or session is unknown, ``last`` comes before ``first``, or the reason is not a line of at most 64
            bytes.
        """
        gap = SequenceGap(sensor, first, last, reason, session_id)
        checks.integer("last missing sequence number", gap.last, 0, MAX_SEQUENCE)
        self._spool.note_gap(gap)
        self._wake()

    def _wake(self) -> None:
        if self._link is not None:
            self._link.wake()

    def flush(self, timeout_s: float, stop: Callable[[], bool] = lambda: False) -> bool:
        """Wait until the central node has acknowledged everything, and return True if it has.

        Parameters
        ----------
        timeout_s : float
        stop : callable, optional
            Called ten times a second; the wait ends early once it returns True.
        """
        self._owner.require_this_process()
        return self._spool.wait(timeout_s, stop)

    @property
    def counts(self) -> dict[str, SensorCounts]:
        """Copy of the counts of each sensor's measurements."""
        return self._spool.counts_now()

    @property
    def unacked(self) -> int:
        """Number of unacknowledged measurements."""
        return sum(counts.unacked for counts in self.counts.values())

    @property
    def central(self) -> Central:
        """Last reported state of the central node: "storage", "processing", "fault", "closing", or "away"."""
        return "away" if self._link is None else self._link.central

    @property
    def refusal(self) -> str:
        """Reason and remedy if the central node refuses a sensor; empty if it accepts all."""
        return "" if self._link is None else self._link.refusal

    @property
    def reconnects(self) -> int:
        """Number of reconnections after the central node was away."""
        return 0 if self._link is None else self._link.reconnects

    @property
    def is_durable(self) -> bool:
        """True if kept measurements outlive this process."""
        return self._spool.is_durable

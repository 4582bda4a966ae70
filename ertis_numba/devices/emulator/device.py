"""An emulated eRTIS on a pseudo terminal, which sends given samples."""

import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self, TextIO

from ertis_numba.devices.emulator.faults import Faults, Stall, Unplug
from ertis_numba.devices.emulator.mainboard import Accepts, Mainboard, Quirks
from ertis_numba.devices.emulator.measurements import Measurements, Output, Pieces, Words
from ertis_numba.devices.emulator.registers import Registers
from ertis_numba.devices.emulator.terminal import Terminal
from ertis_numba.devices.links import HeldLink, require_terminals

__all__ = ["Emulator"]

_SECOND_NS = 1_000_000_000
_MAX_UNREAD = 1_000  # Limit on unread answers, above which the device accepts no more commands.
_PACE_S = 2e-3  # Interval between the portions of a slow device.
_CATCH_UP_NS = 20_000_000  # Limit on the delay that a device catches up on a busy machine.
_PATIENCE_S = 10.0


class Emulator:
    """Emulated device, active until it is closed; use it in a ``with`` statement.

    Each measurement gets the next number of the device's counter. A measurement triggered by a command, or by `trigger`
    without a number, contains the samples of this number, cyclically: the counter identifies the samples of a block.
    With a pulse number it contains the samples of the pulse, so that all devices of a SYNC chain measure the same time
    regardless of their counters.

    Its first byte is sent when the recording ends, the length of the measurement after its trigger, and the rest as
    fast as the host reads. The next one may be recorded meanwhile. A trigger during a recording is ignored. Two
    measurements wait for a reader; others are dropped as a whole, and the counter continues. Answers and measurements
    leave in order, so an answer waits for earlier measurements.

    The device answers an invalid command with 0. The authors' code for Linux sends ``J`` with four numbers, and that
    for Windows ``A`` without a line end: the device accepts both.

    Parameters
    ----------
    words : sequence of (sample,) uint32
        One array per measurement, cut or repeated to the length that the host requests.
    passive : sequence of (sample,) uint32, optional
        The same for measurements without emission: passive ones, and active ones while the amplifier is off. By default
        they use ``words``.
    name : str
    faults : Faults, optional
        Faults of the line.
    link : Path, optional
        Symbolic link to the port while the device is plugged in.
    log : TextIO, optional
        Receives a JSON line per measurement before its first byte is sent: name, index of the samples, counter, active
        or not, CRC-32 of the samples as little-endian bytes, fault (empty, "dropped", or as in `Faults`) and time_ns
        since 1970. Measurements that may not have been read when the device is unplugged get another line with the
        fault "unplugged"; the last line about a measurement counts. Lines about the device itself have an event
        instead, "unplugged" or "plugged in".
    accepts : callable, optional
        Called with a `DeviceConfig`, the call and the record that the host has configured. If it returns False, the
        device reports a wrong hash of the call and does not measure. By default, every configuration is accepted.
    quirks : Quirks
        May be replaced at any time.
    on_port : callable, optional
        Called with the new port when the device is plugged in again, from the device's thread; it must not wait for
        that thread.
    on_measurement : callable, optional
        Called for each measurement with the index of its samples, and True if it emits the call, from the device's
        thread.

    Attributes
    ----------
    port : str
        Path of the pseudo terminal. It may change when the device is plugged in again.
    error : Exception or None
        Error that has ended the device: unreadable samples or a failing log.

    Raises
    ------
    ArgumentError
        There are no samples, they are not uint32, or the link belongs to another device.
    SonarError
        This system has no pseudo terminals.

    Examples
    --------
    >>> import numpy as np
    >>> with Emulator([np.zeros(4096, np.uint32)], name="front") as device:  # doctest: +SKIP
    ...     print(device.port)
    """

    def __init__(
        self,
        words: Sequence[Words],
        *,
        passive: Sequence[Words] | None = None,
        name: str = "emulated",
        faults: Faults | None = None,
        link: Path | None = None,
        log: TextIO | None = None,
        accepts: Accepts | None = None,
        quirks: Quirks | None = None,
        on_port: Callable[[str], None] | None = None,
        on_measurement: Callable[[int, bool], None] | None = None,
    ) -> None:
        require_terminals()
        self._measurements = Measurements(
            words, passive, name=name, faults=faults, log=log, on_measurement=on_measurement
        )
        self.name, self.link, self.quirks = name, link, quirks or Quirks()
        self._on_port, self._accepts = on_port, accepts
        self._held = None if link is None else HeldLink(link)
        self.error: Exception | None = None
        self._refused = 0  # Before it was unplugged.
        self._changed = threading.Condition()
        self._wish_plugged = True
        self._back_ns: int | None = None
        self._closing = self._ended = False
        self._woken, self._wakeup_socket = os.pipe()
        os.set_blocking(self._wakeup_socket, False)
        self._terminal: Terminal | None = None
        self._plug_in()
        self._thread = threading.Thread(target=self._run, name=f"emulated {name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def registers(self) -> Registers:
        """Settings received since power-up, which happens when it is plugged in."""
        return self._board.registers

    @property
    def refused(self) -> int:
        """Number of invalid commands, and of those with unusable numbers."""
        return self._refused + self._board.refused

    def close(self) -> None:
        """Hang up permanently and remove the link; closing twice is harmless."""
        with self._changed:
            self._closing = True
            self._wake()
        self._thread.join()
        if self._held is not None:
            self._held.release()
            self._held = None

    def trigger(self, pulse: int | None = None, *, at_ns: int | None = None) -> bool:
        """Receive a SYNC pulse at the selected pin, and return True if it starts a measurement.

        The device ignores it while it is unplugged or records, or while its external trigger is off.

        Parameters
        ----------
        pulse : int, optional
            Number of the words to send; that of the counter by default.
        at_ns : int, optional
            Time of the trigger by the monotonic clock; now by default.
        """
        with self._changed:
            registers = self._board.registers
            if self._terminal is None or not registers.armed:
                return False
            at_ns = time.monotonic_ns() if at_ns is None else at_ns
            taken = self._board.begin(active=bool(registers.active), at_ns=at_ns, index=pulse)
            self._wake()
            return taken

    def unplug(self, for_s: float | None = None) -> None:
        """Unplug the device, until `replug` or for a time.

        A program with an open port gets a hang-up, and the link disappears.
        """
        self._wish(plugged=False, back_ns=None if for_s is None else time.monotonic_ns() + int(for_s * _SECOND_NS))

    def replug(self) -> None:
        """Plug the device in again as after power-up, on a new pseudo terminal."""
        self._wish(plugged=True, back_ns=None)

    def _wish(self, *, plugged: bool, back_ns: int | None) -> None:
        with self._changed:
            self._wish_plugged, self._back_ns = plugged, back_ns
            self._wake()
            self._changed.wait_for(
                lambda: self._ended or (self._terminal is not None) == self._wish_plugged, timeout=_PATIENCE_S
            )

    def _wake(self) -> None:
        if not self._ended:
            with suppress(BlockingIOError):  # Enough wake-ups are pending.
                os.write(self._wakeup_socket, b"!")

    def _forget(self) -> None:
        self._board = Mainboard(self._measurements, self._accepts)
        self._sent = Output(deque())  # Latest measurement.
        self._pause_ns = 0  # Nothing is sent before.

    def _plug_in(self) -> None:
        self._forget()
        self._terminal = Terminal()
        self.port = self._terminal.port
        if self._held is not None:
            self._held.point_to(self.port)

    def _pull_out(self) -> None:
        """Hang up, and log measurements that may not have been read."""
        if self._terminal is None:
            return
        if self._terminal.unread:
            self._measurements.notify(self._sent, "unplugged")
        self._board.lose()
        self._refused += self._board.refused
        self._forget()
        self._terminal.close()
        self._terminal = None
        if self._held is not None:
            self._held.clear()

    def _run(self) -> None:
        try:
            self._live()
        except Exception as error:  # noqa: BLE001  it is for those who look after the device
            self.error = error
        with self._changed:
            if self.error is not None:
                self._forget()  # The log itself may have failed.
            self._pull_out()
            self._ended = True
            os.close(self._woken)
            os.close(self._wakeup_socket)
            self._changed.notify_all()

    def _live(self) -> None:
        ready: list[int] = []
        while not self._closing:
            with self._changed:
                came_back, reads, writes, due_ns = self._step(ready, time.monotonic_ns())
            if came_back and self._on_port is not None:
                self._on_port(self.port)
            timeout_s = None if due_ns is None else max(0.0, (due_ns - time.monotonic_ns()) / _SECOND_NS)
            ready = select.select([self._woken, *reads], writes, [], timeout_s)[0]
            if self._woken in ready:
                os.read(self._woken, 4096)

    def _step(self, ready: list[int], now_ns: int) -> tuple[bool, list[int], list[int], int | None]:
        """Do pending work; return True if the device came back, the descriptors to wait for, and the next deadline."""
        came_back = self._follow_wish(now_ns)
        terminal, board = self._terminal, self._board
        full = False
        if terminal is not None:
            if terminal.master in ready:
                board.take(terminal.read(), self.quirks, now_ns)
            board.go_on(self.quirks, now_ns)
            full = self._send(terminal, now_ns)
        if terminal is None or terminal is not self._terminal:  # A fault may have unplugged it.
            return came_back, [], [], self._back_ns
        pause_ns = self._pause_ns if board.outputs and not full else None
        due_ns = min((each for each in (board.due_ns, self._back_ns, pause_ns) if each is not None), default=None)
        master = [terminal.master]
        return came_back, master if len(board.outputs) < _MAX_UNREAD else [], master if full else [], due_ns

    def _follow_wish(self, now_ns: int) -> bool:
        """Plug in or unplug as requested; return True if the device came back."""
        if self._back_ns is not None and now_ns >= self._back_ns:
            self._wish_plugged, self._back_ns = True, None
        if (self._terminal is not None) == self._wish_plugged:
            return False
        if self._wish_plugged:
            self._plug_in()
        else:
            self._pull_out()
        self._measurements.note("plugged in" if self._wish_plugged else "unplugged")
        self._changed.notify_all()
        return self._wish_plugged

    def _send(self, terminal: Terminal, now_ns: int) -> bool:
        """Send as much as possible; return True if no one has read."""
        outputs = self._board.outputs
        while outputs and now_ns >= self._pause_ns:
            pieces = outputs[0].pieces
            if not pieces:
                sent = outputs.popleft()
                self._sent = sent if sent.entry else self._sent
                continue
            piece = pieces.popleft()
            if isinstance(piece, Unplug):
                self._wish_plugged, self._back_ns = False, now_ns + int(self.quirks.away_s * _SECOND_NS)
                self._follow_wish(now_ns)
                return False
            if isinstance(piece, Stall):
                self._pause_ns = now_ns + int(piece.duration_s * _SECOND_NS)
            elif piece and not self._write(terminal, piece, pieces, now_ns):
                return True
        return False

    def _write(self, terminal: Terminal, piece: memoryview, pieces: Pieces, now_ns: int) -> bool:
        """Write a piece as far as possible, and return True if any byte was written; the rest is put back."""
        rate = self.quirks.bytes_per_s
        n_bytes = terminal.write(piece if rate is None else piece[: max(1, int(_PACE_S * rate))])
        if n_bytes < len(piece):
            pieces.appendleft(piece[n_bytes:])
        if rate is not None:
            since_ns = max(self._pause_ns, now_ns - _CATCH_UP_NS)
            self._pause_ns = since_ns + int(n_bytes / rate * _SECOND_NS)
        return n_bytes > 0

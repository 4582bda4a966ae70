"""Driver of a sensor on a serial port."""

import errno
import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, SonarDisconnectedError, SonarError
from ertis_numba.devices.block_receiver import Block, BlockReceiver
from ertis_numba.devices.blocks import COUNTERS, FRAME_BYTES
from ertis_numba.devices.commands import DAC_SAMPLES, Command, CustomCommand, firmware_version
from ertis_numba.devices.dialogue import Dialogue
from ertis_numba.devices.line import closed_error
from ertis_numba.devices.ports import Port, find_again, resolve
from ertis_numba.devices.reset_pin import pulse_reset_pin
from ertis_numba.devices.setup import Setup
from ertis_numba.frames import Behaviour

__all__ = ["SonarDriver"]

_TRANSFER_BYTES_PER_S = 5e6  # Lower limit.
_MARGIN_S = 0.5
_SLOWEST_BYTES_PER_S = 1e5  # A busy machine with four programs per core reads a pseudo terminal at 250 kB/s.
_RETRY_S = 0.05

_log = logging.getLogger("ertis_numba")


class SonarDriver:
    """A sensor; create it with `SonarDriver.open`, and use it in a ``with`` statement or `close` it.

    Other threads may call only `close`.

    Attributes
    ----------
    firmware : str
        Version such as ``1.2.3``; empty if nothing was sent to the sensor (``listen_only``).

    Examples
    --------
    >>> with SonarDriver.open("/dev/ttyACM0") as sonar:  # doctest: +SKIP
    ...     sonar.configure(Setup.of(settings))
    ...     block = sonar.measure()
    """

    def __init__(
        self, port: Port, *, timeout_s: float = 1.0, listen_only: bool = False, stop: Callable[[], bool] = lambda: False
    ) -> None:
        checks.instance("port", port, Port, "find_ports or resolve of ertis_numba.devices.ports returns")
        self.firmware = ""
        self._port = port
        self._timeout_s = timeout_s
        self._listen_only = listen_only
        self._closing = threading.Event()
        self._configured: tuple[Setup, BlockReceiver] | None = None
        self._next = 0  # Number of the next measurement.
        self._is_armed = False
        self._is_late = False  # An abandoned measurement may still arrive.
        self._dropped = 0
        self._line = self._opened(port, lambda: self._closing.is_set() or stop())
        self._line.stop = self._closing.is_set

    @classmethod
    def open(
        cls, port: str, *, timeout_s: float = 1.0, listen_only: bool = False, stop: Callable[[], bool] = lambda: False
    ) -> Self:
        """Open a sensor, stop an unfinished measurement of an earlier program, and query its firmware.

        Parameters
        ----------
        port : str
            Path, link, serial number, or name of an emulated device; see `ports.resolve`.
        timeout_s : float
            Maximum time for an answer, in seconds.
        listen_only : bool
            Send nothing: receive from a sensor that another program has set up.
        stop : callable
            Polled during the dialogue; once it returns True, opening fails.

        Raises
        ------
        SonarError
            The port is missing, in use, may not be used, is ambiguous, or no eRTIS is there. Its ``errno`` is ENOENT,
            EBUSY, EACCES, ETIMEDOUT without a valid answer, or EINVAL if ``port`` is not a serial port or matches
            several.
        """
        return cls(resolve(port), timeout_s=timeout_s, listen_only=listen_only, stop=stop)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def port(self) -> str:
        """Path of the serial port; another one after `reconnect`, perhaps."""
        return self._port.path

    @property
    def serial_number(self) -> str:
        """Serial number of the USB device, or name of the emulated one; empty if there is none."""
        return self._port.serial_number

    @property
    def listen_only(self) -> bool:
        """True if nothing is ever sent to it."""
        return self._listen_only

    @property
    def receiver(self) -> BlockReceiver:
        """Counts of received, lost and rejected blocks since `configure`."""
        return self._state()[1]

    @property
    def dropped(self) -> int:
        """Number of unexpected bytes, which the receiver has not seen."""
        return self._dropped + self._line.dropped

    @property
    def deadline_s(self) -> float:
        """Timeout of a measurement: its duration, its transfer at 5 MB/s, and half a second.

        On a busy machine, the transfer may take longer. A measurement is not late while its bytes arrive at 100 kB/s or
        more. The driver gives it up half a second after the latest byte.
        """
        setup = self._state()[0]
        transfer_s = (setup.n_bytes + FRAME_BYTES) / _TRANSFER_BYTES_PER_S
        return setup.n_samples / setup.pdm_rate_hz + transfer_s + _MARGIN_S

    def call_hash(self) -> int:
        """Return the hash of the sensor's call."""
        self._speak()
        return self._line.ask(Command("L"))

    def configure(
        self,
        setup: Setup,
        *,
        counter: int = 0,
        bits: Callable[[NDArray[np.uint32]], str | None] | None = None,
        on_words: Callable[[int, NDArray[np.uint32]], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Configure the sensor; the trigger stays off.

        The call is sent only if the sensor has another one. With ``listen_only``, nothing is sent, and the
        setup describes the measurements.

        Parameters
        ----------
        setup : Setup
        counter : int
            Number of the next measurement.
        bits : callable, optional
            Returns the reason why words are invalid, or None, as `bits.BitCheck.check` does.
        on_words : callable, optional
            Called with the number of the first and an array of words as they arrive, such as `WordStream.add` of
            `Pipeline.stream`; 0 begins another block. The last words come with the block, which may still be rejected.
            `measure` and `listen` raise its exceptions, and can be called again.
        stop : callable
            Polled during the dialogue; once it returns True, this fails.

        Raises
        ------
        SonarError
            The sensor does not answer, holds another call than it was sent, or ``stop`` returned True.
        """
        receiver = BlockReceiver(
            setup.n_samples,
            expected=None if self._listen_only else counter,
            shortest_s=setup.n_samples / setup.pdm_rate_hz,
            bits=bits,
            on_words=on_words,
        )
        self._configured, self._next = (setup, receiver), counter
        self._is_armed = self._is_late = False
        if self._listen_only:
            return
        self._line.stop = lambda: self._closing.is_set() or stop()
        try:
            self._line.notify(setup, counter=counter)
        finally:
            self._line.stop = self._closing.is_set

    def measure(self, *, active: bool | None = None) -> Block:
        """Measure now.

        Parameters
        ----------
        active : bool, optional
            True to emit the call; by default as in the setup.

        Raises
        ------
        ArgumentError
            The call is to be emitted, but the amplifier is off.
        SonarError
            No complete measurement arrived in time; the next one may be tried at once.
        SonarDisconnectedError
            The sensor was unplugged.
        """
        self._speak()
        (setup, receiver), deadline_s = self._state(), self.deadline_s
        active = setup.active if active is None else active
        if active and not setup.amplifier:
            raise ArgumentError(
                "active is True, but the sensor is configured with its amplifier off and would emit nothing; "
                "configure a setup with amplifier=True"
            )
        if self._is_armed:
            raise SonarError(
                f"{self.port} is armed, and SYNC pulses trigger it; receive its measurements with listen(), or disarm()"
            )
        if self._line.waiting:
            self._line.drain(within_s=deadline_s)
        if self._is_late:  # If that measurement still arrives, its number identifies it.
            self._line.ask(Command("B", self._next))
        receiver.expect(self._next)
        self._line.send(Command("A", int(active)).encode())
        self._next, self._is_late = (self._next + 1) % COUNTERS, True  # Its number is used, even if it fails.
        began, read = time.monotonic(), 0
        ends = began + deadline_s
        latest = ends + setup.n_bytes / _SLOWEST_BYTES_PER_S
        is_late = False
        while not is_late:
            is_late = time.monotonic() > ends  # Bytes that arrived while this process was suspended are still read.
            data, arrived = self._line.receive(receiver.missing)
            read += len(data)
            if data and read < setup.n_bytes + FRAME_BYTES:
                ends = min(max(ends, time.monotonic() + _MARGIN_S), latest)
                is_late = time.monotonic() > ends
            blocks = receiver.feed(data, arrived)
            if data and not (blocks or receiver.missing):
                blocks = receiver.finish()  # No other block will decide.
            if blocks:
                return self._counted(blocks[-1], _behaviour(active))
        receiver.expire()
        raise SonarError(
            f"{self.port}: no complete measurement within {ends - began:.2f} s; {read} of "
            f"{setup.n_bytes + FRAME_BYTES} bytes arrived: measure again, and check the cable if this repeats"
        )

    def arm(self) -> None:
        """Let SYNC pulses trigger measurements from now on; `listen` yields them."""
        self._speak()
        setup, receiver = self._state()
        self._is_armed = True  # even if this fails, so that `reconnect` repeats it, and `close` undoes it
        if self._line.waiting:
            self._line.drain(within_s=self.deadline_s)
        receiver.expect(self._next)
        self._line.ask(Command("J", 1, setup.pin), alone=False)

    def disarm(self) -> None:
        """Ignore SYNC pulses; a measurement on its way is dropped."""
        self._speak()
        self._line.quieten(Command("J", 0, self._state()[0].pin), within_s=self.deadline_s)
        self._is_armed = False

    def listen(self, *, stop: Callable[[], bool], timeout_s: float) -> Iterator[Block]:
        """Yield triggered measurements as they arrive.

        Parameters
        ----------
        stop : callable
            Called some hundred times a second; listening ends once it returns True.
        timeout_s : float
            Maximum time to wait for a measurement, in seconds; not less than `deadline_s`.

        Raises
        ------
        SonarError
            No measurement arrived within this time, or the driver was closed before.
        SonarDisconnectedError
            The sensor was unplugged.
        """
        (setup, receiver), deadline_s = self._state(), self.deadline_s
        self._require_armed()
        timeout_s = max(timeout_s, deadline_s)
        # Another program has set up a sensor that is only listened to.
        behaviour: Behaviour = "unknown" if self._listen_only else _behaviour(setup.active)
        latest_ns = latest_byte_ns = time.monotonic_ns()
        read = 0
        try:
            while not stop():
                data, arrived = self._line.receive(receiver.missing)
                now_ns = arrived.monotonic_ns
                blocks: list[Block] = []
                if data:
                    read, latest_byte_ns = read + len(data), now_ns
                    blocks = receiver.feed(data, arrived)
                elif (receiver.missing or receiver.held) and now_ns - latest_byte_ns > 1e9 * deadline_s:
                    blocks = receiver.expire()
                if blocks:
                    yield from (self._counted(block, behaviour) for block in blocks)
                    latest_ns, read = time.monotonic_ns(), 0
                elif now_ns - latest_ns > 1e9 * timeout_s:
                    raise self._nothing_whole(read, setup, timeout_s)
        except SonarDisconnectedError:
            yield from (self._counted(block, behaviour) for block in receiver.finish())
            raise
        except SonarError:
            if not self._closing.is_set():
                raise
        yield from (self._counted(block, behaviour) for block in receiver.finish())

    def reconnect(self, *, within_s: float, stop: Callable[[], bool] = lambda: False) -> bool:
        """Wait for an unplugged sensor, and configure it again as before.

        The sensor is found by its serial number, by its link, or otherwise by its path. Its numbers continue.

        Parameters
        ----------
        within_s : float
        stop : callable
            Waiting ends once it returns True.

        Returns
        -------
        bool
            True if the sensor is back; False after ``stop`` or `close`.

        Raises
        ------
        SonarDisconnectedError
            The sensor is not back within that time.
        """
        began = time.monotonic()

        def abandoned() -> bool:
            return self._closing.is_set() or stop()

        self.hang_up()
        while not abandoned():
            try:
                port = find_again(self._port)
                self._line, self._port = self._opened(port, abandoned), port
                self._go_on()
            except SonarError as error:
                self.hang_up(_why_absent(error))
                if time.monotonic() - began > within_s and not abandoned():
                    text = f"{self.port} did not return within {within_s:g} s: {error}"
                    raise SonarDisconnectedError(text) from error
                self._closing.wait(_RETRY_S)
            else:
                self._line.stop = self._closing.is_set
                _log.info("%s is back after %.2f s", self._port, time.monotonic() - began)
                break
        if self._closing.is_set():
            self.hang_up()  # close() has not seen this line.
        return not abandoned()

    def command(self, text: str) -> int:
        """Send a command as text, and return the answer.

        Unless it is a query, `configure` the sensor afterwards: the command may have changed its settings.

        Parameters
        ----------
        text : str
            ``!X,i,j,k``, such as ``!Y,0,0,0``; the firmware may know other codes than `Command`.

        Raises
        ------
        ArgumentError
            The text is not of this form, or it is the command to measure.
        SonarError
            The sensor does not answer.

        Examples
        --------
        >>> with SonarDriver.open("/dev/ttyACM0") as sonar:  # doctest: +SKIP
        ...     version = sonar.command("!Y,0,0,0")
        """
        command = CustomCommand(text)
        self._speak()
        if self._is_armed:
            self.disarm()
        if command.changes_settings:
            self._configured = None
        return self._line.ask(command)

    def reset(self, pulse: Callable[[], None] = pulse_reset_pin, *, within_s: float = 60.0) -> bool:
        """Reset the sensor, and wait until it answers again; `configure` it afterwards.

        It may be silent before. A sensor without a call gets a sample of one, because a reset erases the call.

        Parameters
        ----------
        pulse : callable
            Resets the hardware. By default, it sets pin 7 of a Jetson to 0 for a second, where an eRTIS has its reset
            line.
        within_s : float
            Longest time until the sensor answers.

        Returns
        -------
        bool
            False if the sensor still has its call, so that it was probably not reset.

        Raises
        ------
        SonarError
            ``pulse`` cannot reset the hardware.
        SonarDisconnectedError
            The sensor does not answer within this time.
        """
        self._speak()
        held = self._call_before_reset()
        pulse()  # If it fails, a sensor that could not be disarmed is still armed, and `close` must disarm it.
        self._configured, self._is_armed = None, False
        return not self.reconnect(within_s=within_s) or held is None or self._line.ask(Command("L")) != held

    def _call_before_reset(self) -> int | None:
        """Return the hash of the sensor's call, which is not 0; None if it does not answer."""
        try:
            if self._is_armed:
                self.disarm()
            if self._line.ask(Command("L")) == 0:
                self._line.ask(Command("E", DAC_SAMPLES[0]))
                self._line.ask(Command("C", 0, 1))
            return self._line.ask(Command("L"))
        except SonarError:
            return None

    def hang_up(self, why: str | None = None) -> None:
        """Give up a sensor that does not answer; use it again after `reconnect`, which configures it as before.

        Parameters
        ----------
        why : str, optional
            Message of the errors until then, as in `ertis_numba.devices.line.SerialLine.hang_up`.
        """
        self._line.hang_up(why)
        self._dropped += self._line.dropped
        self._line.dropped = 0

    def close(self) -> None:
        """Switch the trigger off if it is on, and close the port; a `listen` in another thread ends."""
        self._closing.set()
        self._line.close(Command("J", 0, self._state()[0].pin).encode() if self._is_armed else b"")

    def _opened(self, port: Port, stop: Callable[[], bool]) -> Dialogue:
        """Return the line to a quiet sensor, with its firmware version."""
        line = Dialogue(port.path, timeout_s=self._timeout_s, stop=stop)
        if self._listen_only:
            return line
        try:
            line.quieten(Command("J", 0, 1), within_s=self._timeout_s)
            self.firmware = firmware_version(line.ask_twice(Command("Y")))
        except BaseException:
            line.close()
            raise
        _log.info("%s: eRTIS, firmware %s", port, self.firmware)
        return line

    def _go_on(self) -> None:
        """Configure a sensor again after a power loss."""
        if self._configured is None:
            return
        setup, receiver = self._configured
        receiver.expire()
        if not self._listen_only:
            self._line.notify(setup, counter=self._next)
            self._is_late = False
        if self._is_armed:
            self.arm()

    def _speak(self) -> None:
        if self._listen_only:
            raise SonarError(f"{self.port} is open with listen_only; open it without")

    def _require_armed(self) -> None:
        if self._closing.is_set():
            raise closed_error(self.port)
        if not (self._is_armed or self._listen_only):
            raise SonarError(f"{self.port} is not armed; call arm() first")

    def _state(self) -> tuple[Setup, BlockReceiver]:
        if self._configured is None:
            raise SonarError(f"{self.port} is not configured; call configure() first")
        return self._configured

    def _counted(self, block: Block, behaviour: Behaviour) -> Block:
        """Return a block with its behaviour, after advancing the next number."""
        self._next, self._is_late = (block.counter + 1) % COUNTERS, False
        return replace(block, behaviour=behaviour)

    def _nothing_whole(self, read: int, setup: Setup, timeout_s: float) -> SonarError:
        if not read:
            return SonarError(f"{self.port}: nothing arrived within {timeout_s:g} s; check the trigger and its cable")
        return SonarError(
            f"{self.port}: {read} bytes arrived within {timeout_s:g} s, but no complete measurement of "
            f"{setup.n_samples} samples; use the length to which the sensor is set"
        )


def _why_absent(error: SonarError) -> str | None:
    """Return the message about a silent sensor, an empty text for an unplugged one, and None if it is not known."""
    if error.errno == errno.ETIMEDOUT:
        return str(error)
    return "" if error.errno == errno.ENOENT or isinstance(error, SonarDisconnectedError) else None


def _behaviour(active: bool) -> Behaviour:  # noqa: FBT001  the number of command A or H
    return "active" if active else "passive"

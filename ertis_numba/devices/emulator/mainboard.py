"""Behaviour of an emulated device, without a port, a thread or a clock."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ertis_numba.base import checks
from ertis_numba.base.errors import DataError
from ertis_numba.devices.blocks import COUNTERS
from ertis_numba.devices.commands import Command, encode_answer
from ertis_numba.devices.emulator.faults import Stall
from ertis_numba.devices.emulator.measurements import Measurements, Output
from ertis_numba.devices.emulator.registers import DeviceConfig, Registers
from ertis_numba.devices.emulator.terminal import CommandReader

__all__ = ["Accepts", "Mainboard", "Quirks"]

Accepts = Callable[[DeviceConfig], bool]
"""Return True if measurements exist for a configuration."""

_LEFT_NS = 20_000_000  # An unfinished line that is a complete command is accepted after this time.
_CONFIG_COMMANDS = frozenset("CDEFG")  # Commands that change the call or the record.
_BUFFERED = 2  # Limit on measurements that wait for a reader.


@dataclass(frozen=True, slots=True, kw_only=True)
class Quirks:
    """Faulty behaviour of a device apart from its data."""

    silent: bool = False  # obeys but answers nothing
    wrong_hash: bool = False  # reports a wrong hash of the call
    answer_delay_s: float = 0.0
    bytes_per_s: float | None = None  # None: as fast as the host reads
    away_s: float = 1.0  # absence after a fault has unplugged it

    def __post_init__(self) -> None:
        checks.between("answer_delay_s", self.answer_delay_s, 0.0, 3600.0)
        checks.between("away_s", self.away_s, 0.0, 3600.0)
        if self.bytes_per_s is not None:
            checks.between("bytes_per_s", self.bytes_per_s, 1e3, 1e12)


@dataclass(slots=True, eq=False)
class _PendingRecording:
    due_ns: int
    index: int
    counter: int
    active: bool
    n_samples: int
    output: Output | None = None  # Created during the recording.


class Mainboard:
    """Device that obeys commands and records, from power-up until it is unplugged."""

    def __init__(self, measurements: Measurements, accepts: Accepts | None = None) -> None:
        self.registers = Registers()
        self.outputs: deque[Output] = deque()
        self.refused = 0
        self._measurements, self._accepts = measurements, accepts
        # A new configuration, a complete call, a refused configuration.
        self._is_new = self._is_loaded = self._is_refused = False
        self._lines = CommandReader()
        self._left_ns: int | None = None  # Time at which an unfinished line is accepted.
        self._recording: _PendingRecording | None = None

    @property
    def due_ns(self) -> int | None:
        """Time of the next pending work, if any."""
        dues_ns = (self._left_ns, None if self._recording is None else self._recording.due_ns)
        return min((due_ns for due_ns in dues_ns if due_ns is not None), default=None)

    def take(self, data: bytes, quirks: Quirks, now_ns: int) -> None:
        """Process bytes from the host."""
        for line in self._lines.feed(data):
            self._obey(line, quirks, now_ns)
        self._left_ns = now_ns + _LEFT_NS if _command(self._lines.unfinished) else None

    def _obey(self, line: bytes, quirks: Quirks, now_ns: int) -> None:
        command = _command(line)
        if command is not None and not command.answers:
            self.begin(active=command.first == 1, at_ns=now_ns)
            return
        answer = None if command is None else self.registers.answer(command)
        self.refused += answer is None
        answer = answer or 0  # The answer of a real device to refused commands is unknown.
        if command is not None and command.code in _CONFIG_COMMANDS:
            self._is_new, self._is_loaded = True, command.code == "C"
            self._is_refused = self._is_refused and not self._is_loaded
        if command is not None and command.code == "L" and (quirks.wrong_hash or self._refuses(judge=self._is_loaded)):
            answer ^= 1
        if not quirks.silent:
            self.outputs.append(Output(deque([Stall(quirks.answer_delay_s), memoryview(encode_answer(answer))])))

    def begin(self, *, active: bool, at_ns: int, index: int | None = None) -> bool:
        """Start to record, unless a recording is in progress; return True if it was started."""
        if self._recording is not None or self._refuses(judge=True):
            return False
        registers = self.registers
        counter = registers.counter
        registers.counter = (counter + 1) % COUNTERS
        self._recording = _PendingRecording(
            due_ns=at_ns + registers.duration_ns,
            index=counter if index is None else index,
            counter=counter,
            active=active and bool(registers.amplifier),
            n_samples=registers.n_samples,
        )
        return True

    def _refuses(self, *, judge: bool) -> bool:
        """Return True if no measurements exist for the registers; check new registers only if ``judge`` is set."""
        if judge and self._is_new and self._accepts is not None:
            self._is_new = False
            self._is_refused = not self._accepts(self.registers.config)
        return self._is_refused

    def go_on(self, quirks: Quirks, now_ns: int) -> None:
        """Do pending work: an unfinished line, a complete measurement."""
        if self._left_ns is not None and now_ns >= self._left_ns:
            self._left_ns = None
            self._obey(self._lines.take(), quirks, now_ns)
        if self._recording is None:
            return
        output = self._output(self._recording)
        if now_ns < self._recording.due_ns:
            return
        self._recording = None
        if sum(bool(waiting.entry) for waiting in self.outputs) < _BUFFERED:
            self._measurements.notify(output)
            self.outputs.append(output)
        else:
            self._measurements.notify(output, "dropped")

    def lose(self) -> None:
        """Unplug: log the measurements that will not be sent."""
        waiting = list(self.outputs)
        if self._recording is not None:
            waiting.append(self._output(self._recording))
        for output in waiting:
            self._measurements.notify(output, "unplugged")

    def _output(self, recording: _PendingRecording) -> Output:
        """Return the output of a measurement; it is created once."""
        if recording.output is None:
            recording.output = self._measurements.output(
                recording.index, recording.counter, active=recording.active, n_samples=recording.n_samples
            )
        return recording.output


def _command(line: bytes) -> Command | None:
    """Return the command in a line, or None for an invalid one."""
    if line.startswith(b"!J"):
        line = b",".join(line.split(b",")[:4])  # The authors' code for Linux sends another number.
    try:
        return Command.decode(line)
    except DataError:
        return None

"""Simulated line with faults between blocks and a receiver, and the receiver's results."""

import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_numba.devices.block_receiver import Block, BlockReceiver, Instant
from ertis_numba.devices.blocks import COUNTERS, encode_block
from ertis_numba.devices.emulator.faults import Faults, Spoilt, Stall, Unplug

__all__ = ["KINDS", "BlockReport", "Wire", "send"]

KINDS: Final[dict[str, float]] = {
    "flip": 0.12,
    "duplicate": 0.05,
    "lose": 0.12,
    "add": 0.1,
    "swap": 0.06,
    "cut": 0.08,
    "drop": 0.03,
    "stall": 0.1,
    "unplug": 0.01,
    "short_reads": True,
}
"""Probabilities of faults, which affect about half of all blocks."""

_MIN_INTERVAL_S: Final = 0.04  # shortest time between two triggers
_INTERVAL_S: Final = 0.05
_BYTES_PER_S: Final = 1e6  # lower limit; large blocks are sent faster
_BLOCK_S: Final = 0.02  # longest duration of a block
_MAX_REMEMBERED: Final = 64  # Number of recent blocks whose bytes may still be in the receiver.


@dataclass(slots=True)
class BlockReport:
    """Results for all blocks.

    Attributes
    ----------
    sent, spoilt, untouched : int
        All blocks; blocks with a fault; and blocks whose bytes arrived unchanged, even if stalled.
    delivered : int
        Blocks that were delivered with their own number and words.
    untouched_lost : int
        Untouched blocks that were not delivered.
    mixed : int
        Accepted blocks that consist of pieces of several blocks, or are displaced.
    wrong_counter : int
        Blocks that were accepted with a wrong number.
    twice : int
        Blocks that were accepted again.
    altered : int
        Blocks that were accepted with their number and changed words. Bits were flipped, or as many bytes were lost as
        were added. The frame cannot reveal such faults, but the check of the bits may.
    lost, pending : int
        Counts of the receiver. ``pending`` includes the bytes of blocks that it holds.
    fed : int
        Bytes that the receiver was given.
    rejected, rejected_blocks : Counter of str
        Counts of the receiver, by reason.
    """

    sent: int = 0
    spoilt: int = 0
    untouched: int = 0
    delivered: int = 0
    untouched_lost: int = 0
    mixed: int = 0
    wrong_counter: int = 0
    twice: int = 0
    altered: int = 0
    lost: int = 0
    fed: int = 0
    pending: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    rejected_blocks: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True)
class _Sent:
    crc32: int
    data: bytes  # as sent, including faults
    untouched: bool
    delivered: bool = False


class Wire:
    """Triggers, a line with faults, and a receiver. Received blocks are compared with the sent ones.

    Parameters are those of `send`.
    """

    def __init__(
        self,
        *,
        n_samples: int,
        faults: Faults,
        counter: int = 0,
        triggers: Literal["regular", "irregular", "at once"] = "regular",
        deadline_s: float | None = None,
        bits: Callable[[NDArray[np.uint32]], str | None] | None = None,
        seed: int = 0,
    ) -> None:
        self.report = BlockReport()
        self._receiver = BlockReceiver(n_samples, expected=counter, shortest_s=_MIN_INTERVAL_S, bits=bits)
        self._faults, self._triggers, self._deadline_s = faults, triggers, deadline_s
        self._random = np.random.default_rng(seed)
        self._counter = counter
        self._sent: dict[int, _Sent] = {}
        self._trigger_s = self._now_s = 0.0
        self._bytes_per_s = max(_BYTES_PER_S, self._receiver.n_bytes / _BLOCK_S)

    def measure(self, words: NDArray[np.uint32]) -> None:
        """Send one more block."""
        self._wait()
        counter, self._counter = self._counter, (self._counter + 1) % COUNTERS
        block = encode_block(counter, words)
        spoilt = self._faults.spoil(block)
        self._register(counter, block, spoilt)
        for piece in spoilt.pieces:
            if isinstance(piece, Stall):
                self._now_s += piece.duration_s
            elif isinstance(piece, Unplug):
                self._compare(self._receiver.finish())
                self._receiver.expect(self._counter)
            else:
                at_ns = round(self._now_s * 1e9) if self._triggers != "at once" else 0
                self.report.fed += len(piece)
                self._compare(self._receiver.feed(piece, Instant(at_ns, at_ns, 0)))
                self._now_s += len(piece) / self._bytes_per_s

    def finish(self) -> BlockReport:
        """End the transmission, and return the results for all blocks."""
        receiver, report = self._receiver, self.report
        self._compare(receiver.finish())
        report.pending = receiver.pending + receiver.held * receiver.n_bytes
        report.lost, report.rejected, report.rejected_blocks = (
            receiver.lost,
            receiver.rejected,
            receiver.rejected_blocks,
        )
        for counter in [*self._sent]:
            self._forget(counter)
        return report

    def _wait(self) -> None:
        """Advance the time to the next trigger. If the deadline passes meanwhile, let the receiver expire."""
        interval_s = _INTERVAL_S
        if self._triggers == "irregular":
            interval_s = _MIN_INTERVAL_S + float(self._random.exponential(_INTERVAL_S))
        self._trigger_s = max(self._trigger_s + interval_s, self._now_s)
        if self._deadline_s is not None and self._trigger_s - self._now_s > self._deadline_s:
            while self._receiver.missing:
                self._compare(self._receiver.expire())
        self._now_s = self._trigger_s

    def _register(self, counter: int, block: bytes, spoilt: Spoilt) -> None:
        data, report = spoilt.data, self.report
        self._sent[counter] = _Sent(zlib.crc32(block[8:-4]), data, untouched=data == block)
        report.sent += 1
        report.spoilt += bool(spoilt.faults)
        report.untouched += data == block
        if len(self._sent) > _MAX_REMEMBERED:
            self._forget(next(iter(self._sent)))

    def _forget(self, counter: int) -> None:
        sent = self._sent.pop(counter)
        self.report.delivered += sent.delivered
        self.report.untouched_lost += sent.untouched and not sent.delivered

    def _compare(self, blocks: list[Block]) -> None:
        """Compare accepted blocks with the sent ones."""
        report = self.report
        for block in blocks:
            words = block.data.astype("<u4").tobytes()
            crc32 = zlib.crc32(words)
            sent = self._sent.get(block.counter)
            if sent is not None and crc32 == sent.crc32:
                report.twice += sent.delivered
                sent.delivered = True
            elif sent is not None and words in sent.data:
                report.altered += 1
            elif any(crc32 == other.crc32 or words == other.data[8:-4] for other in self._sent.values()):
                report.wrong_counter += 1
            else:
                report.mixed += 1


def send(
    n_blocks: int,
    *,
    seed: int = 1,
    n_samples: int = 128,
    words: NDArray[np.uint32] | None = None,
    kinds: Mapping[str, float] = KINDS,
    triggers: Literal["regular", "irregular", "at once"] = "regular",
    deadline_s: float | None = None,
    bits: Callable[[NDArray[np.uint32]], str | None] | None = None,
    progress: Callable[[], object] | None = None,
) -> BlockReport:
    """Send ``n_blocks`` over a line with faults and return the results.

    Parameters
    ----------
    n_blocks : int
        Number of blocks. The counter wraps around half-way.
    seed : int
    n_samples : int
        Words of a block.
    words : (sample,) uint32, optional
        Words from which each block uses a random section. By default, blocks contain random words.
    kinds : mapping of str to float
        Probabilities, as for `Faults`.
    triggers : {"regular", "irregular", "at once"}
        ``regular`` triggers every 50 ms. ``irregular`` triggers with a pause of 40 ms, and 50 ms more on average. ``at
        once`` sends all bytes without pauses, so that their times contain no information.
    deadline_s : float, optional
        Silence after which the receiver gives an incomplete block up. By default, it never does.
    bits : callable, optional
        The receiver's check of the bits.
    progress : callable, optional
        Called after each block.

    Returns
    -------
    BlockReport
    """
    random = np.random.default_rng(seed)
    wire = Wire(
        n_samples=n_samples,
        faults=Faults(seed, kinds),
        counter=(-n_blocks // 2) % COUNTERS,
        triggers=triggers,
        deadline_s=deadline_s,
        bits=bits,
        seed=seed,
    )
    for _ in range(n_blocks):
        if words is None:
            block = random.integers(0, 2**32, n_samples, dtype=np.uint32)
        else:
            begin = int(random.integers(len(words) - n_samples + 1))
            block = words[begin : begin + n_samples]
        wire.measure(block)
        if progress is not None:
            progress()
    return wire.finish()

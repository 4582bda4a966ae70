"""Extraction of measurements from the bytes of a sensor, without input, output or clock."""

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.devices.blocks import COUNTERS, FOOTER, FRAME_BYTES, HEADER, Block, Instant
from ertis_numba.devices.counter_check import BURST, CounterCheck

__all__ = ["Block", "BlockParser", "BlockReceiver", "Instant"]

_HEADER: Final = HEADER.to_bytes(4, "little")
_FOOTER: Final = FOOTER.to_bytes(4, "little")
_WORDS_AT: Final = 8  # After the header and the counter.
_MAX_SKIPPED = 256  # Limit on the numbers that a block skips after it has cut another one short.


class BlockParser:
    """Parser of blocks (header, counter, words, footer) in a stream of bytes, for any division into pieces.

    After a header without a footer, the parser searches again directly behind that header, so that damage costs only
    its own block. Two damaged blocks may have the correct length together; the later arrival of the second header, more
    than ``apart_s`` after the first byte, reveals this. At any time, ``bytes fed = n_bytes · blocks returned +
    rejected.total() + pending``; ``rejected_blocks`` counts headers without a block.
    """

    def __init__(self, n_samples: int, *, apart_s: float = math.inf) -> None:
        self.n_bytes = 4 * n_samples + FRAME_BYTES
        self.rejected: Counter[str] = Counter()
        self.rejected_blocks: Counter[str] = Counter()
        self._n_samples, self._apart_ns = n_samples, apart_s * 1e9
        self._data = bytearray()  # Begins with a header, or with a part of one.
        self._reason = "no header"  # Reason for rejecting bytes up to the next header.
        self._position = 0  # Position of the first byte in the stream.
        self._shown = 0, 0  # Position of the block of which `new_words` has returned words, and their number.
        self._pieces: deque[tuple[int, Instant]] = deque()  # End of each piece in the stream, and its time of arrival.

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete block."""
        return len(self._data)

    @property
    def missing(self) -> int:
        """Number of missing bytes of the incomplete block, 0 between blocks."""
        return self.n_bytes - len(self._data) if self._data else 0

    def new_words(self) -> tuple[int, NDArray[np.uint32]]:
        """Return new words of the incomplete block, perhaps none, and the number of the first, after `take`."""
        begin, n_shown = self._shown
        first = n_shown if begin == self._position else 0
        stop = max(first, min((len(self._data) - _WORDS_AT) // 4, self._n_samples))
        self._shown = self._position, stop
        # The slice is a copy, because a bytearray with a view cannot change its size.
        return first, np.frombuffer(self._data[_WORDS_AT + 4 * first : _WORDS_AT + 4 * stop], "<u4")

    def feed(self, data: bytes, arrived: Instant) -> list[Block]:
        """Return the blocks that ``data`` completes; all of it arrived at once."""
        self.add(data, arrived)
        return list(iter(self.take, None))

    def expire(self) -> None:
        """Abandon the incomplete block after its deadline; later bytes may have begun another."""
        if len(self._data) >= len(_HEADER):
            self._abandon("cut short")
        else:
            self._drop(len(self._data), self._reason)

    def add(self, data: bytes, arrived: Instant) -> None:
        """Add bytes; then call `take` until it returns None."""
        if data:
            self._data += data
            self._pieces.append((self._position + len(self._data), arrived))

    def take(self) -> Block | None:
        """Return the next complete block, or None."""
        while True:
            if not self._data.startswith(_HEADER):
                self._search(0)
            if len(self._data) < self.n_bytes:
                return None
            reason = self._fault()
            if reason is None:
                return self._accept()
            self._abandon(reason)

    def _fault(self) -> str | None:
        """Return the reason why the data is not a block, None if it is one."""
        footer = self.n_bytes - len(_FOOTER)
        if self._data[footer : self.n_bytes] != _FOOTER:
            return "footer"
        if self._pieces[-1][1].monotonic_ns - self._pieces[0][1].monotonic_ns < self._apart_ns:
            return None
        place = self._data.find(_HEADER, len(_HEADER), footer)
        while place >= 0:
            if self._is_apart(place) and (self._counter(place) - self._counter(0)) % COUNTERS <= _MAX_SKIPPED:
                return "cut short"
            place = self._data.find(_HEADER, place + 1, footer)
        return None

    def _is_apart(self, place: int) -> bool:
        """Return True if a byte came so late that it may belong to another block."""
        arrived = next(arrived for end, arrived in self._pieces if end > self._position + place)
        return arrived.monotonic_ns - self._pieces[0][1].monotonic_ns >= self._apart_ns

    def _counter(self, place: int) -> int:
        """Return the counter behind the header at ``place``."""
        return int.from_bytes(self._data[place + 4 : place + 8], "little")

    def _accept(self) -> Block:
        # The copy releases the view, because a bytearray with a view cannot change its size.
        words = np.frombuffer(self._data, "<u4", self._n_samples, _WORDS_AT).astype(np.uint32)
        words.flags.writeable = False
        block = Block(self._counter(0), words, self._pieces[0][1])
        self._reason = "no header"
        self._drop(self.n_bytes)
        return block

    def _abandon(self, reason: str) -> None:
        """Reject the incomplete block and search behind its header."""
        self.rejected_blocks[reason] += 1
        self._reason = reason
        self._search(len(_HEADER))

    def _search(self, begin: int) -> None:
        """Reject bytes before the next header from ``begin`` on; the end may be a partial header."""
        place = self._data.find(_HEADER, begin)
        if place < 0:
            place = max(begin, len(self._data) - len(_HEADER) + 1)
            while not _HEADER.startswith(self._data[place:]):
                place += 1
        self._drop(place, self._reason)

    def _drop(self, count: int, reason: str | None = None) -> None:
        """Remove the first ``count`` bytes, which a bytearray does without moving the others."""
        if count and reason is not None:
            self.rejected[reason] += count
        del self._data[:count]
        self._position += count
        while self._pieces and self._pieces[0][0] <= self._position:
            self._pieces.popleft()


class BlockReceiver:
    """Validation of a stream: framing, then the counter, then the bits.

    A block with an uncertain number is held until others decide (see `CounterCheck`), so that `feed` may return several
    at once, in order; none is held if `expect` is called before each commanded measurement. At any time, ``bytes fed =
    n_bytes · (blocks returned + held) + rejected.total() + pending``. ``on_words`` gets words of an incomplete block as
    they arrive, which may still be rejected. Its exceptions leave `feed` and lose no block.
    """

    def __init__(
        self,
        n_samples: int,
        *,
        expected: int | None = None,
        shortest_s: float,
        bits: Callable[[NDArray[np.uint32]], str | None] | None = None,
        on_words: Callable[[int, NDArray[np.uint32]], None] | None = None,
    ) -> None:
        self._on_words = on_words
        self._parser = BlockParser(n_samples, apart_s=BURST * shortest_s)
        self._counters = CounterCheck(shortest_s=shortest_s, expected=expected)
        self._bits = bits
        self._rejected_blocks: Counter[str] = Counter()
        self.n_bytes = self._parser.n_bytes

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete block."""
        return self._parser.pending

    @property
    def missing(self) -> int:
        """Number of missing bytes of the incomplete block, 0 between blocks."""
        return self._parser.missing

    @property
    def held(self) -> int:
        """Number of blocks with an undecided counter."""
        return self._counters.held

    @property
    def rejected(self) -> Counter[str]:
        """Number of rejected bytes by reason: the reasons of `BlockParser` and of the bit check, and ``counter``."""
        whole = Counter({reason: count * self.n_bytes for reason, count in self._rejected_blocks.items()})
        return self._parser.rejected + whole

    @property
    def rejected_blocks(self) -> Counter[str]:
        """Rejected blocks by reason."""
        return self._parser.rejected_blocks + self._rejected_blocks

    @property
    def lost(self) -> int:
        """Number of counts that the counter skipped."""
        return self._counters.lost

    def feed(self, data: bytes, arrived: Instant) -> list[Block]:
        """Return the measurements that ``data`` completes; all of it arrived at once."""
        good: list[Block] = []
        if data:
            self._counters.heard(arrived.monotonic_ns)
            self._parser.add(data, arrived)
        while (block := self._parser.take()) is not None:
            good += self._settle(self._counters.judge(block, self._parser.rejected.total() / self.n_bytes))
        # Complete blocks come first: an exception would lose them, and a new block discards what a stream has of one.
        if self._on_words is not None and not good:
            first, words = self._parser.new_words()
            if len(words):
                self._on_words(first, words)
        return good

    def expire(self) -> list[Block]:
        """Abandon an incomplete block after its deadline; between blocks, return held ones that fit the time."""
        if self.missing:
            self._parser.expire()
            return []
        return self._settle(self._counters.finish())

    def finish(self) -> list[Block]:
        """Return the held blocks that fit the elapsed time, because the stream has ended."""
        self._clear()
        return self._settle(self._counters.finish())

    def expect(self, counter: int) -> None:
        """Set the next number to counter or its successor; discard the blocks of the time before."""
        self._clear()
        self._settle(self._counters.expect(counter))

    def _clear(self) -> None:
        while self.missing:
            self._parser.expire()

    def _settle(self, decided: list[tuple[Block, bool]]) -> list[Block]:
        """Return valid blocks, and count the others."""
        good = []
        for block, follows in decided:
            reason = (self._bits(block.data) if self._bits else None) if follows else "counter"
            if reason is None:
                good.append(block)
            else:
                self._rejected_blocks[reason] += 1
        return good

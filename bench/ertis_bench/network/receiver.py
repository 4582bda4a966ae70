"""Application that checks every image, and writes a diary: ``python -m ertis_bench.network.receiver JOB``."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_bench.network.diary import DiaryKey
from ertis_bench.network.processes import JsonLinesProcess, until
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.network.keys import ClientKeys, KeyPair
from ertis_numba.network.messages import Product
from ertis_numba.network.subscriber import Subscriber

__all__ = ["STEP", "TOLERANCE", "Received", "ReceiverJob", "read_received", "receive", "subscriber_of"]

STEP: Final = 61
"""Distance of compared values. One value in 61 is compared, so that all rows and columns are covered in turn."""

# Relative to the largest value. Each process chooses its own plan, and images of other measurements differ far more.
TOLERANCE: Final = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverJob:
    """Options of a receiver.

    Attributes
    ----------
    address, diary : str
    products : tuple of str
    keys : (path of a secret, public key of the central node), optional
    expected : str, optional
        File of expected images, written by `serving.expected_of`. Measurements use them in turn.
    waits_s : float
        Pause after each product, as for other work.
    credit : int
    """

    address: str
    diary: str
    products: tuple[Product, ...] = ("energyscape",)
    keys: tuple[str, str] | None = None
    expected: str | None = None
    waits_s: float = 0.0
    credit: int = 2

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return replace(self, **changes)

    def start(self, *, mark: str = "") -> JsonLinesProcess:
        """Start the receiver. Its stderr goes to a file beside its diary."""
        command = [sys.executable, "-m", "ertis_bench.network.receiver", json.dumps(asdict(self))]
        return JsonLinesProcess(command, stated=Path(self.diary).with_suffix(".txt"), mark=mark)


@dataclass(slots=True)
class Received:
    """Results of a receiver."""

    times_ms: dict[DiaryKey, float] = field(default_factory=dict)
    twice: int = 0
    disordered: int = 0
    wrong: int = 0
    numbers: list[int] = field(default_factory=list)
    dropped: int = 0

    @property
    def unrecorded(self) -> int:
        """Difference between the number of missing products and the reported number of dropped ones."""
        return abs(max(self.numbers, default=-1) + 1 - len(self.numbers) - self.dropped)


def read_received(path: Path) -> Received:
    """Return the results of a receiver."""
    found = Received()
    for line in path.read_bytes().splitlines(keepends=True) if path.exists() else ():
        if not line.endswith(b"\n"):
            continue
        sensor, session_id, sequence, number, dropped, time_ns, wrong = json.loads(line)
        key = DiaryKey(sensor, session_id, sequence)
        found.twice += key in found.times_ms
        found.disordered += bool(found.numbers) and number <= found.numbers[-1]
        found.wrong += wrong
        found.times_ms[key] = time_ns / 1e6
        found.numbers.append(number)
        found.dropped = dropped
    return found


@dataclass(frozen=True, slots=True)
class _Expected:
    values: NDArray[np.float32]
    shape: tuple[int, ...]

    @classmethod
    def load(cls, path: str) -> Self:
        with np.load(path) as loaded:
            return cls(loaded["values"], tuple(loaded["shape"].tolist()))

    def spoilt(self, image: Energyscape) -> bool:
        """Return True if an image does not match its measurement."""
        if image.amplitude.shape != self.shape:
            return True
        number = image.stamp.sequence % len(self.values)
        wanted = self.values[number]
        came = image.amplitude.reshape(-1)[number % STEP :: STEP][: len(wanted)]
        return bool(np.abs(came - wanted).max() > TOLERANCE * np.abs(wanted).max())


def main(look: ReceiverJob) -> None:
    """Receive until SIGTERM."""
    subscriber = subscriber_of(look, on_note=lambda text: _emit_event(event="note", text=text))
    signal.signal(signal.SIGTERM, lambda *_: subscriber.close())
    if until(lambda: subscriber.connected):
        _emit_event(event="subscribed", pid=os.getpid())
    receive(look, subscriber)
    _emit_event(event="received", **asdict(subscriber.counts))


def subscriber_of(look: ReceiverJob, *, on_note: Callable[[str], None]) -> Subscriber[Any]:
    """Return the subscriber of a receiver."""
    keys = None if look.keys is None else ClientKeys(pair=KeyPair.load(Path(look.keys[0])), server=look.keys[1])
    return Subscriber(look.address, products=look.products, keys=keys, credit=look.credit, on_note=on_note)


def receive(look: ReceiverJob, subscriber: Subscriber[Any]) -> None:
    """Check all products, and write them into the diary, until the subscriber is closed."""
    expected = None if look.expected is None else _Expected.load(look.expected)
    diary = os.open(look.diary, os.O_CREAT | os.O_APPEND | os.O_WRONLY, 0o644)
    with subscriber:
        for item in subscriber:
            now_ns = time.monotonic_ns()
            if subscriber.latest is None or not isinstance(item, Energyscape | Measurement):
                continue
            header: Any = subscriber.latest.header
            stamp = item.stamp
            wrong = expected is not None and isinstance(item, Energyscape) and expected.spoilt(item)
            line = [
                stamp.sensor, stamp.session_id, stamp.sequence, header.number, header.dropped,
                now_ns - header.monotonic_ns, wrong,
            ]  # fmt: skip
            os.write(diary, f"{json.dumps(line)}\n".encode())
            if look.waits_s:
                time.sleep(look.waits_s)
    os.close(diary)


def _emit_event(**event: object) -> None:
    os.write(1, f"{json.dumps(event)}\n".encode())


if __name__ == "__main__":
    main(ReceiverJob(**json.loads(sys.argv[1])))

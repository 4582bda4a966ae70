"""Central node that processes images, its status, and a check of its counts."""

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench.network.processes import JsonLinesProcess, central, survivors, until
from ertis_bench.network.receiver import STEP, Received, read_received
from ertis_bench.network.sent import Sent
from ertis_numba.frames import Measurement
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ClientKeys, KeyPair
from ertis_numba.network.status import Status
from ertis_numba.network.subscriber import Subscriber
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings

__all__ = ["Serve", "accounts", "create_keys", "expected_of", "percentile", "some_words"]

_N_MEASUREMENTS: Final = 5  # number of different measurements

Found = dict[str, Any]
Keys = tuple[str, str]


def create_keys(folder: Path, sensors: Sequence[str]) -> tuple[list[str], Keys, ClientKeys]:
    """Create keys. Return options of a central node, the keys of a sensor or an application, and those of an admin."""
    pairs = {name: KeyPair.new(name) for name in ("central", "node", "boss")}
    secret = {name: pair.save(folder / "keys")[0] for name, pair in pairs.items()}
    allowed = (
        Permission(name="node", public=pairs["node"].public, role="sensor", serials=tuple(sensors)),
        Permission(name="boss", public=pairs["boss"].public, role="admin"),
    )
    AllowList(keys=allowed).save(folder / "allow.toml")
    options = ["--key", str(secret["central"]), "--allow", str(folder / "allow.toml")]
    server = pairs["central"].public
    return options, (str(secret["node"]), server), ClientKeys(pair=pairs["boss"], server=server)


def some_words(settings: Settings, path: Path, *, seed: int) -> Path:
    """Write the words of some measurements of noise into a file."""
    shape = (_N_MEASUREMENTS, settings.recording.n_samples)
    np.save(path, np.random.default_rng(seed).integers(0, 2**32, shape, dtype=np.uint32))
    return path


def expected_of(settings: Settings, words: NDArray[np.uint32], path: Path) -> Path:
    """Compute the image of each measurement in this process, and write a part of its values into a file."""
    pipeline = Pipeline(settings)
    images = [pipeline.process(Measurement(each, settings)).amplitude for each in words]
    n_values = images[0].size // STEP - 1
    values = np.stack([image.reshape(-1)[number % STEP :: STEP][:n_values] for number, image in enumerate(images)])
    np.savez(path, values=values, shape=images[0].shape)
    return path


def percentile(times_ms: Sequence[float], share: float) -> float:
    """Return a percentile, or 0 for an empty sequence."""
    ordered = sorted(times_ms)
    return round(ordered[round(share * (len(ordered) - 1))], 2) if ordered else 0.0


@dataclass(slots=True)
class Serve:
    """``ertis serve`` with its output; use it in a ``with`` statement of `running`."""

    node: JsonLinesProcess
    listen: str
    publish: str
    mark: str
    watcher: "Subscriber[Status]"
    unbalanced: int = 0
    latest: Status | None = None
    pids: set[int] = field(default_factory=set)

    @classmethod
    @contextmanager
    def running(cls, folder: Path, *options: str, keys: ClientKeys | None = None) -> "Iterator[Serve]":
        """Start the node and yield it."""
        mark = f"serve{os.getpid()}{time.monotonic_ns()}"
        with central("serve", folder, "--publish", "tcp://127.0.0.1:*", *options, mark=mark) as node:
            listening = node.wait_for("listening")
            with Subscriber(listening["publish"], products=("status",), keys=keys) as watcher:
                yield cls(node, listening["address"], listening["publish"], mark, watcher)

    def look(self, *, timeout_s: float = 5.0) -> Status | None:
        """Return the next status, or None if none arrives in time."""
        status = self.watcher.receive(timeout_s)
        if status is not None:
            self.latest = status
            self.unbalanced += any(
                each.received != each.published + sum(each.dropped.values()) + each.in_flight
                for each in status.sensors.values()
            )
        return status

    def settle(self, n_sent: int, *, timeout_s: float = 30.0) -> bool:
        """Wait until all sent measurements have been published or dropped. Return False after a timeout."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            status = self.look()
            sensors = [] if status is None else list(status.sensors.values())
            if sum(each.received for each in sensors) >= n_sent and not any(each.in_flight for each in sensors):
                return True
        return False

    def deliver(self, images: Path, *, timeout_s: float = 60.0) -> None:
        """Wait until an application has received all published images, or learned that they were skipped for it.

        After a timeout, the counts of the application show which images are missing.
        """
        published = 0 if self.latest is None else sum(each.published for each in self.latest.sensors.values())

        def is_complete() -> bool:
            received = read_received(images)
            return len(received.numbers) + received.dropped >= published

        until(is_complete, timeout_s=timeout_s)

    def processes(self) -> dict[str, list[int]]:
        """Return the processes of the central node."""
        others = {pid: line for pid, line in survivors(self.mark).items() if pid != self.node.node_pid}
        publisher = [pid for pid, line in others.items() if "publisher_process" in line]
        workers = [pid for pid in others if pid not in publisher]
        return {"central node": [self.node.node_pid], "workers": workers, "publisher": publisher}


def accounts(serve: Serve, sent: Sent, received: Received) -> Found:
    """Summarise the results of all measurements.

    Returns
    -------
    dict
        ``received``, ``published`` and ``dropped``, as the central node counts them; ``images`` that an application
        received, and images that were ``skipped`` for it. All other counts must be 0: ``unbalanced``, see `Serve`;
        ``uncounted``, measurements that the central node did not count; ``untold``, images that neither arrived nor
        were reported as skipped; and images that arrived ``twice``, ``disordered`` or ``wrong``, or whose measurement
        was never sent (``foreign``).
    """
    sensors = [] if serve.latest is None else list(serve.latest.sensors.values())
    dropped: dict[str, int] = {}
    for each in sensors:
        for reason, count in each.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + count
    published, n_received = sum(each.published for each in sensors), sum(each.received for each in sensors)
    return {
        "sent": len(sent.kept),
        "received": n_received,
        "published": published,
        "dropped": dropped,
        "images": len(received.numbers),
        "skipped": received.dropped,
        "unbalanced": serve.unbalanced + (n_received != published + sum(dropped.values())),
        "uncounted": abs(len(sent.kept) - n_received),
        "untold": abs(published - len(received.numbers) - received.dropped) + received.unrecorded,
        "twice": received.twice,
        "disordered": received.disordered,
        "wrong": received.wrong,
        "foreign": len(received.times_ms.keys() - sent.offered.keys()),
    }

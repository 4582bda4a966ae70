"""Application that fuses images, and checks them: ``python -m ertis_bench.network_trials.fused_receiver JOB``."""

import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ertis_bench.network.processes import JsonLinesProcess, until
from ertis_bench.network.receiver import TOLERANCE
from ertis_numba.fusion import Fuser
from ertis_numba.network.fused_subscriber import FusedArrival, FusedSubscriber
from ertis_numba.network.keys import ClientKeys, KeyPair

__all__ = ["SPACINGS", "FusedPulse", "FusedReceiverJob", "checked", "read_fused"]

SPACINGS: Final[Any] = {"spacing_deg": 2.0, "range_step_m": 0.02}
_CHECKED: Final = 10  # Of the fused pulses with points, one in so many is kept, and checked at the end.


class FusedPulse(NamedTuple):
    """Line of the diary."""

    sync_count: int
    n_images: int
    first_ns: int
    ready_ns: int
    located_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FusedReceiverJob:
    """Options of a receiver of fused images.

    Attributes
    ----------
    address, diary : str
    keys : (path of a secret, public key of the central node)
    expected : str
        File of expected images by sensor: (measurement, direction, range) float32. Measurements use them in turn.
    mountings : dict of str to (translation_m, rotation_xyzw)
        Mountings of all sensors, for the check; those of the central node are fused.
    """

    address: str
    diary: str
    keys: tuple[str, str]
    expected: str
    mountings: dict[str, tuple[Sequence[float], Sequence[float]]]

    def start(self) -> JsonLinesProcess:
        """Start the receiver. Its stderr goes to a file beside its diary."""
        command = [sys.executable, "-m", "ertis_bench.network_trials.fused_receiver", json.dumps(asdict(self))]
        return JsonLinesProcess(command, stated=Path(self.diary).with_suffix(".txt"))


def read_fused(path: Path) -> list[FusedPulse]:
    """Return the pulses in a diary, without a truncated last line."""
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    return [FusedPulse(*json.loads(line)) for line in lines if line.endswith(b"\n")]


def main(job: FusedReceiverJob) -> None:
    """Receive until SIGTERM, and check the kept pulses."""
    keys = ClientKeys(pair=KeyPair.load(Path(job.keys[0])), server=job.keys[1])
    diary = os.open(job.diary, os.O_CREAT | os.O_APPEND | os.O_WRONLY, 0o644)
    kept: list[FusedArrival] = []
    n_located = 0
    with FusedSubscriber(job.address, keys=keys, **SPACINGS) as subscriber:
        signal.signal(signal.SIGTERM, lambda *_: subscriber.close())
        if until(lambda: subscriber.connected):
            _emit(event="subscribed")
        for arrival in subscriber:
            n_points = len(arrival.fused.points)
            count = arrival.fused.stamp.sync_count
            line = FusedPulse(count, len(arrival.images), arrival.first_ns, arrival.ready_ns, time.monotonic_ns())
            os.write(diary, f"{json.dumps(line)}\n".encode())
            if n_points:
                if n_located % _CHECKED == 0:
                    kept.append(arrival)
                n_located += 1
        _emit(event="received", skipped=subscriber.n_skipped, dropped=subscriber.counts.dropped, **checked(job, kept))
    os.close(diary)


def checked(job: FusedReceiverJob, kept: list[FusedArrival]) -> dict[str, int]:
    """Return the number of checked pulses, and of those that differ from a fusion here, or whose images are wrong."""
    wrong = 0
    fusers: dict[tuple[str, ...], Fuser] = {}
    # Sums depend in their last bits on the order of all sensors, which only complete pulses show.
    whole = next((each.fused.sensors for each in kept if not each.fused.missing), ())
    with np.load(job.expected) as expected:
        for arrival in kept:
            images = [
                np.abs(image.amplitude - (wanted := expected[name])[image.stamp.sequence % len(wanted)]).max()
                <= TOLERANCE * wanted.max()
                for name, image in arrival.images.items()
            ]
            known = arrival.fused.sensors + arrival.fused.missing
            order = whole if set(whole) == set(known) else known
            if order not in fusers:
                fusers[order] = Fuser({name: job.mountings[name] for name in order}, **SPACINGS)
            again = fusers[order](arrival.images.values()).image.amplitude
            wrong += not (all(images) and np.array_equal(again, arrival.fused.image.amplitude))
    return {"checked": len(kept), "wrong": wrong}


def _emit(**event: Any) -> None:
    os.write(1, f"{json.dumps(event)}\n".encode())


if __name__ == "__main__":
    main(FusedReceiverJob(**json.loads(sys.argv[1])))

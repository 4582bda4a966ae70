"""Live view of acoustic maps, which checks some of them: ``python -m ertis_bench.network_trials.map_viewer JOB``.

There is no browser, but the view draws every frame that a browser would show. It prints its counts after SIGUSR1.
"""

import json
import os
import signal
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ertis_bench.network.processes import JsonLinesProcess, until
from ertis_numba.frames import AcousticMap, Measurement
from ertis_numba.network.keys import ClientKeys, KeyPair
from ertis_numba.passive import AcousticCamera
from ertis_numba.viewer import Live, ReceivedImage, Viewer

__all__ = ["MapViewerJob", "n_wrong"]

_CHECKED: Final = 10  # One map in so many is kept, and checked at the end.
_TOLERANCE: Final = 1e-5  # Relative to the largest power.


@dataclass(frozen=True, slots=True, kw_only=True)
class MapViewerJob:
    """Options of a live view of acoustic maps.

    Attributes
    ----------
    address : str
    keys : (path of a secret, public key of the central node)
    words : str
        File of the words that the sensors send: (measurement, sample). Measurements use them in turn.
    stated : str
        File for the messages of the process.
    """

    address: str
    keys: tuple[str, str]
    words: str
    stated: str

    def start(self) -> JsonLinesProcess:
        """Start the view."""
        command = [sys.executable, "-m", "ertis_bench.network_trials.map_viewer", json.dumps(asdict(self))]
        return JsonLinesProcess(command, stated=Path(self.stated))


class _KeptMaps(Live):
    """Source of a view that keeps some maps."""

    kept: list[AcousticMap]
    n_taken: int

    def take(self) -> list[ReceivedImage[Any]]:
        """Return new maps, and keep some of them."""
        taken = super().take()
        self.kept += [each.image for n, each in enumerate(taken, self.n_taken) if n % _CHECKED == 0]
        self.n_taken += len(taken)
        return taken


def main(job: MapViewerJob) -> None:
    """Show maps until SIGTERM, and check the kept ones."""
    keys = ClientKeys(pair=KeyPair.load(Path(job.keys[0])), server=job.keys[1])
    with _KeptMaps(job.address, keys=keys, acoustic_maps=True) as source, Viewer(source, port=0) as viewer:
        source.kept, source.n_taken = [], 0

        def counts() -> dict[str, int]:
            return {
                "received": source.received,
                "dropped": source.dropped,
                "replaced": source.skipped,
                "frames": viewer.shown,
            }

        signal.signal(signal.SIGTERM, lambda *_: viewer.stop())
        signal.signal(signal.SIGUSR1, lambda *_: _emit(event="counts", **counts()))
        if until(lambda: source.connected):
            _emit(event="subscribed")
        viewer.run()
        _emit(event="shown", **counts(), checked=len(source.kept), wrong=n_wrong(job, source.kept))


def n_wrong(job: MapViewerJob, maps: list[AcousticMap]) -> int:
    """Return the number of maps that differ from a map of the same words that is made here."""
    words, wrong = np.load(job.words), 0
    for found in maps:
        settings = found.settings
        with AcousticCamera(settings, check=False) as camera:
            power = camera.process(Measurement(words[found.stamp.sequence % len(words)], settings, found.stamp)).power
        wrong += not np.abs(found.power - power).max() <= _TOLERANCE * power.max()
    return wrong


def _emit(**event: Any) -> None:
    os.write(1, f"{json.dumps(event)}\n".encode())


if __name__ == "__main__":
    main(MapViewerJob(**json.loads(sys.argv[1])))

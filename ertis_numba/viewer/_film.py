"""Images of a file along its time: recordings are processed while they are shown."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Self

from ertis_numba.errors import DataError
from ertis_numba.frames import Energyscape, Measurement, Stamp
from ertis_numba.pipeline import Pipeline
from ertis_numba.storage import (
    EnergyscapeReader,
    RecordingReader,
    file_kind,
    open_energyscapes,
    open_recording,
    sensor_names,
)
from ertis_numba.viewer._shapes import UNTURNED, Pose, Taken

__all__ = ["Film", "Moment"]

_TOGETHER_NS: Final = 10_000_000  # measurements of several sensors that are shown as one
_UNTIMED_S: Final = 0.1  # between measurements that have no time
_LOOK_S: Final = 1 / 60
_STOP_S: Final = 0.3


@dataclass(frozen=True, slots=True)
class Moment:
    """What is shown at once: one measurement of each sensor at most.

    Attributes
    ----------
    time_s : float
        Since the first.
    measurements : tuple of (sensor, number)
    """

    time_s: float
    measurements: tuple[tuple[str, int], ...]


class Film:
    """A recording or an energyscape file as moments, one of which is shown.

    Parameters
    ----------
    path : str or Path
    sensors : sequence of str, optional
        All by default.
    device : {"auto", "cpu", "cuda", "numpy"}
        What processes recordings.
    loop : bool
        Begin anew at the end.

    Attributes
    ----------
    moments : tuple of Moment
    place, shown : int
        Number of the moment that is due, and of the one that was taken last.
    playing : bool
    received, skipped : int
        How many images were made, and moments for which there was no time.

    Raises
    ------
    DataError
        The file cannot be read or holds nothing.
    ArgumentError
        There is no such sensor.
    """

    is_film: Literal[True] = True
    dropped = 0

    def __init__(
        self,
        path: str | Path,
        *,
        sensors: Sequence[str] | None = None,
        device: Literal["auto", "cpu", "cuda", "numpy"] = "auto",
        loop: bool = False,
    ) -> None:
        self.title = Path(path).name
        self._device, self._loop = device, loop
        self._pipelines: dict[str, Pipeline] = {}
        self._readers: dict[str, RecordingReader | EnergyscapeReader] = {}
        self._stack = ExitStack()
        opened: Callable[..., RecordingReader | EnergyscapeReader] = (
            open_energyscapes if file_kind(path) == "energyscape" else open_recording
        )
        with self._stack:
            for name in sensors or sensor_names(path):
                self._readers[name] = reader = opened(path, sensor=name)
                self._stack.callback(reader.close)
            self.moments = _moments({name: reader.stamps() for name, reader in self._readers.items()})
            if not self.moments:
                raise DataError(f"{path} holds no measurement; give a file with one")
            self._stack = self._stack.pop_all()
        self.playing, self.place, self.shown = True, 0, 0
        self.received = self.skipped = 0
        self._begun: tuple[float, int] | None = None  # when which moment was due
        self._made: int | None = None
        self._ready: list[Taken] = []
        self._turn = threading.Lock()
        self._closed = threading.Event()
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        if self._thread is not None:
            self._thread.join(_STOP_S)
            if self._thread.is_alive():  # kernels are being compiled: who ends does not wait for that
                return
        for pipeline in self._pipelines.values():
            pipeline.close()
        self._stack.close()

    @property
    def state(self) -> str:
        """What to tell of the film."""
        return f"{self.moments[self.shown].time_s:.2f} s of {self.moments[-1].time_s:.2f} s"

    def notes(self) -> list[str]:
        """Return what has happened, which is nothing."""
        return []

    def play(self, *, playing: bool) -> None:
        """Go on, from the beginning where this is at the end; or stay."""
        with self._turn:
            if playing and self.place == len(self.moments) - 1:
                self.place = 0
            self.playing, self._begun = playing, None

    def seek(self, place: int) -> None:
        """Show a moment next, and go on from there."""
        with self._turn:
            self.place = min(max(place, 0), len(self.moments) - 1)
            self._begun = None

    def take(self) -> list[Taken]:
        """Return the images of the moment that was due last, nothing where they were taken.

        At recorded speed: moments for which there was no time are skipped and counted. Images are made in a thread, as
        the first takes long where kernels are to be compiled.

        Raises
        ------
        DataError
            The file cannot be read.
        """
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="ertis-film", daemon=True)
            self._thread.start()
        with self._turn:
            if self._failure is not None:
                raise self._failure
            ready, self._ready = self._ready, []
            if ready and self._made is not None:
                self.shown = self._made
        return ready

    def at(self, place: int) -> list[Taken]:
        """Return the images of a moment."""
        moment = self.moments[place]
        return [self._taken(name, number, moment.time_s) for name, number in moment.measurements]

    def latency_s(self, _: Sequence[Taken]) -> float | None:
        """Return None: what was recorded is as old as it is."""
        return None

    def _run(self) -> None:
        """Make images of the moment that is due, until this is closed."""
        try:
            while not self._closed.is_set():
                with self._turn:
                    if self.playing:
                        self._advance(time.monotonic())
                    place, made = self.place, self._made
                if place == made:
                    self._closed.wait(_LOOK_S)
                    continue
                taken = self.at(place)
                with self._turn:
                    if made is not None and self.playing:
                        self.skipped += max(0, place - made - 1)
                    self._ready, self._made = taken, place
                    self.received += len(taken)
        except Exception as error:  # noqa: BLE001  whoever looks is to know
            self._failure = error

    def _advance(self, now_s: float) -> None:
        """Go to the moment that is due."""
        if self._begun is None:
            if self._made != self.place:  # time begins when it is shown, which may take long where kernels are compiled
                return
            self._begun = now_s, self.place
        begun_s, first = self._begun
        due_s = self.moments[first].time_s + now_s - begun_s
        last = len(self.moments) - 1
        while self.place < last and self.moments[self.place + 1].time_s <= due_s:
            self.place += 1
        if self.place < last or due_s < self.moments[last].time_s + _UNTIMED_S:
            return
        if self._loop:
            self.place, self._begun = 0, (now_s, 0)
            self._made = None if last == 0 else self._made
        else:
            self.playing = False

    def _taken(self, name: str, number: int, time_s: float) -> Taken:
        reader = self._readers[name]
        item = reader[number]
        image = item if isinstance(item, Energyscape) else self._processed(name, item)
        if isinstance(reader, RecordingReader):
            x, y, z = reader.translation_m.tolist()
            i, j, k, w = reader.rotation_xyzw.tolist()
            return Taken(image, Pose((x, y, z), (i, j, k, w)), time_s)
        return Taken(image, UNTURNED, time_s)

    def _processed(self, name: str, measurement: Measurement) -> Energyscape:
        """Return the image of a measurement; other air makes other ranges, and another pipeline."""
        pipeline = self._pipelines.get(name)
        if pipeline is None or pipeline.settings.air != measurement.settings.air:
            if pipeline is not None:
                pipeline.close()
            pipeline = self._pipelines[name] = Pipeline(measurement.settings, device=self._device)
        return pipeline.process(measurement)


def _moments(stamps: dict[str, list[Stamp]]) -> tuple[Moment, ...]:
    """Return the moments of measurements in the order of their times, or of their numbers where they have none."""
    timed = any(len({stamp.timestamp_ns for stamp in each}) > 1 for each in stamps.values())
    rows = sorted(
        (stamp.timestamp_ns if timed else round(number * _UNTIMED_S * 1e9), name, number)
        for name, each in stamps.items()
        for number, stamp in enumerate(each)
    )
    moments: list[Moment] = []
    together: dict[str, int] = {}
    begun_ns = rows[0][0] if rows else 0
    for at_ns, name, number in rows:
        if together and (name in together or at_ns - begun_ns > _TOGETHER_NS):
            moments.append(Moment((begun_ns - rows[0][0]) / 1e9, tuple(together.items())))
            together = {}
        if not together:
            begun_ns = at_ns
        together[name] = number
    if together:
        moments.append(Moment((begun_ns - rows[0][0]) / 1e9, tuple(together.items())))
    return tuple(moments)

"""Playback of a file: recordings are processed while they are shown."""

import atexit
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Literal, Self, TypeAlias

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import AcousticMap, Energyscape, Measurement, Stamp, is_passive
from ertis_numba.passive import AcousticCamera
from ertis_numba.pipeline import Pipeline
from ertis_numba.storage import (
    AcousticMapReader,
    EnergyscapeReader,
    RecordingReader,
    file_kind,
    open_acoustic_maps,
    open_energyscapes,
    open_recording,
    sensor_names,
)
from ertis_numba.storage.recording import Mounting
from ertis_numba.viewer._acoustic_maps import masked_note
from ertis_numba.viewer._result_notes import ResultNotes
from ertis_numba.viewer._shapes import Pose, ReceivedImage
from ertis_numba.viewer._time_steps import UNTIMED_S, SensorTimeline, TimeStep, time_steps_of

__all__ = ["MapSequence", "Playback", "TimeStep"]

_POLL_INTERVAL_S: Final = 1 / 60

Reader: TypeAlias = RecordingReader | EnergyscapeReader | AcousticMapReader

_OPENERS: Final[dict[str, Callable[..., Reader]]] = {
    "recording": open_recording,
    "energyscape": open_energyscapes,
    "acoustic_map": open_acoustic_maps,
}
"""Function that opens a sensor of each kind of file."""
_CONTENTS: Final = {"energyscape": "images", "acoustic_map": "acoustic maps"}


class MapSequence:
    """Acoustic maps of one sensor; call it with the number of a measurement."""

    # Every `passive.averages` measurements form a group, and a map is the mean of its group so far.

    def __init__(self, reader: RecordingReader, *, device: Literal["auto", "cpu", "cuda", "numpy"]) -> None:
        self._reader = reader
        self._camera = AcousticCamera(reader.settings, device, check=False)
        self._next = 0  # Number of the measurement that continues the mean.

    def __call__(self, number: int) -> AcousticMap:
        """Return the map that ends with a measurement."""
        averages = self._camera.settings.passive.averages
        first = number - number % averages
        if not first < self._next <= number:
            self._camera.reset()
            self._next = first
        for each in range(self._next, number + 1):
            measurement = self._reader[each]
            # The air of each measurement may be measured; the delays of a map are those of the recording.
            self._camera.add(Measurement(measurement.data, self._camera.settings, measurement.stamp))
        self._next = number + 1
        return self._camera.map()

    @property
    def band_note(self) -> str | None:
        """Note on sound that the bands do not show, in all measurements so far."""
        return self._camera.band_note

    def close(self) -> None:
        """Free the memory of the device."""
        self._camera.close()


class Playback:
    """A recording, or a file of images or acoustic maps, as time steps, one of which is shown.

    Parameters
    ----------
    path : str or Path
    sensors : str or sequence of str, optional
        All by default.
    device : {"auto", "cpu", "cuda", "numpy"}
        Device that processes recordings.
    loop : bool
        Repeat at the end.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Poses of sensors on their platform, in place of those in the file.
    acoustic_maps : bool, optional
        Show acoustic maps of a recording; by default if none of its measurements is for images. Measurements with a
        call are used without its time.

    Attributes
    ----------
    path : Path
    time_steps : tuple of TimeStep
    place, shown : int
        Number of the time step that is due, and of the last one taken.
    anew : bool
        True if the last images are unrelated to earlier ones, as after `seek`.
    playing : bool
    shows_maps : bool
        True for acoustic maps.
    held : bool
        Time does not start yet, because no browser is connected; the first time step is processed all the same.
    received, skipped : int
        Number of processed images, and of time steps skipped for lack of time.

    Raises
    ------
    DataError
        The file cannot be read or contains nothing.
    ArgumentError
        A sensor does not exist, or acoustic maps are requested of a file of images, or the reverse.
    DeviceError
        The device does not exist.
    """

    is_playback: Literal[True] = True
    dropped = 0

    def __init__(
        self,
        path: str | Path,
        *,
        sensors: Sequence[str] | None = None,
        device: Literal["auto", "cpu", "cuda", "numpy"] = "auto",
        loop: bool = False,
        mounting: Mapping[str, Mounting] | None = None,
        acoustic_maps: bool | None = None,
    ) -> None:
        self._given = {sensor: Pose.of(*place) for sensor, place in (mounting or {}).items()}
        self.path = Path(path)
        self.title = self.path.name
        self._device, self._loop = device, loop
        self._pipelines: dict[str, Pipeline] = {}
        self._map_sequences: dict[str, MapSequence] = {}
        self._readers: dict[str, Reader] = {}
        self._stack = ExitStack()
        kind = file_kind(path)
        with self._stack:
            for name in [sensors] if isinstance(sensors, str) else sensors or sensor_names(path):
                self._readers[name] = reader = _OPENERS[kind](path, sensor=name)
                self._stack.callback(reader.close)
            if device == "cuda" and any(isinstance(each, RecordingReader) for each in self._readers.values()):
                kernels.load(device)  # A missing device is reported before anything is shown.
            stamps = {name: reader.stamps() for name, reader in self._readers.items()}
            self.time_steps, self._notes = time_steps_of(stamps)
            if not self.time_steps:
                raise DataError(f"{path} contains no measurement; choose a file with measurements")
            if kind == "recording":
                self.shows_maps = self._are_maps(stamps) if acoustic_maps is None else acoustic_maps
            else:
                self.shows_maps = kind == "acoustic_map"
                if acoustic_maps is not None and acoustic_maps != self.shows_maps:
                    raise ArgumentError(f"{path} holds {_CONTENTS[kind]} only; choose a recording for others")
            if self.shows_maps:
                self._notes += [
                    masked_note(name) for name, each in stamps.items() if any(one.behaviour == "active" for one in each)
                ]
            self._notes += [reader.points_note for reader in self._readers.values() if reader.points_note is not None]
            self._stack = self._stack.pop_all()
        self._tracks = {name: SensorTimeline.of(name, self.time_steps) for name in self._readers}
        self._result_notes = ResultNotes()
        self.playing, self.place, self.shown, self.anew = True, 0, 0, True
        self.held = False
        self.received = self.skipped = 0
        self._begun: tuple[float, int] | None = None  # Start of the playback: time and time step.
        self._made: int | None = None  # None for images that stand alone.
        self._jumps = self._plays = self._made_in = 0  # Number of seeks, and of starts and stops.
        self._ready: dict[str, ReceivedImage[Any]] = {}
        self._ready_for, self._ready_anew = 0, True
        self._turn = threading.Lock()
        self._closed = threading.Event()
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        for pipeline in self._pipelines.values():
            pipeline.close()
        for sequence in self._map_sequences.values():
            sequence.close()
        self._stack.close()

    def _end(self) -> None:
        """End the thread; this takes some seconds during a compilation."""
        # An interpreter that ends while a thread is in the compiler crashes, because LLVM is destroyed under it.
        self._closed.set()
        if self._thread is not None:
            self._thread.join()
        atexit.unregister(self._end)

    @property
    def state(self) -> str:
        """Position of the playback."""
        return f"{self.time_steps[self.shown].time_s:.2f} s of {self.time_steps[-1].time_s:.2f} s"

    @property
    def clock_s(self) -> float:
        """Time of the shown time step and, during playback, the time elapsed since, up to the next one."""
        with self._turn:
            shown_s, after = self.time_steps[self.shown].time_s, self.shown + 1
            if not self.playing or self._begun is None:
                return shown_s
            next_s = self.time_steps[after].time_s if after < len(self.time_steps) else shown_s + UNTIMED_S
            return min(max(self._due_s(self._begun, time.monotonic()), shown_s), next_s)

    def notes(self) -> list[str]:
        """Return notes on the times in the file, once."""
        return [self._notes.pop(0) for _ in range(len(self._notes))]  # A thread appends others.

    def play(self, *, playing: bool) -> None:
        """Start the playback, from the beginning if it has ended; or stop it."""
        with self._turn:
            if playing and self.place == len(self.time_steps) - 1:
                self._jump(0)
            self.playing, self._begun = playing, None
            self._plays += 1

    def seek(self, place: int) -> None:
        """Show a time step next, and continue from there."""
        with self._turn:
            self._jump(min(max(place, 0), len(self.time_steps) - 1))

    def _jump(self, place: int) -> None:
        self.place, self._begun, self._made = place, None, None
        self._jumps += 1
        self._plays += 1

    def take(self) -> list[ReceivedImage[Any]]:
        """Return the images of the time step that was due last, nothing if they were taken.

        Playback has the recorded speed: time steps without enough time are skipped and counted. The last image of a
        sensor in them is returned; after `seek`, of each sensor the last one at or before the time step. A thread
        processes the images, because the first takes long if kernels are compiled.

        Raises
        ------
        DataError
            The file cannot be read.
        """
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="ertis-film", daemon=True)
            self._thread.start()
            atexit.register(self._end)  # For callers that do not close it.
        with self._turn:
            if self._failure is not None:
                raise self._failure
            ready, self._ready = [*self._ready.values()], {}
            if ready:
                self.shown, self.anew = self._ready_for, self._ready_anew
        return ready

    def at(self, place: int) -> list[ReceivedImage[Any]]:
        """Return the images of a time step."""
        return [self._taken(name, place, number) for name, number in self.time_steps[place].measurements]

    def latency_s(self, _: Sequence[ReceivedImage[Any]]) -> float | None:
        """Return None: the age of a recording is not of interest."""
        return None

    def _run(self) -> None:
        """Process the images of the time step that is due, until closed."""
        try:
            while not self._closed.is_set():
                with self._turn:
                    if self.playing:
                        self._advance(time.monotonic())
                    place, made, jumps, plays = self.place, self._made, self._jumps, self._plays
                if place == made:
                    self._closed.wait(_POLL_INTERVAL_S)
                    continue
                last = {name: track.last(-1 if made is None else made, place) for name, track in self._tracks.items()}
                due = {name: each for name, each in last.items() if each is not None}
                taken = {name: self._taken(name, *each) for name, each in due.items()}
                with self._turn:
                    if made is not None and plays == self._made_in:
                        self.skipped += place - made - len({at for at, _ in due.values()})
                        self.skipped += bool(self._ready.keys() & taken.keys())  # They were not taken in time.
                    self._put(place, taken, anew=made is None)
                    self._made_in = plays
                    if jumps == self._jumps:
                        self._made = place
        except Exception as error:  # noqa: BLE001  whoever looks is to know
            self._failure = error

    def _put(self, place: int, taken: dict[str, ReceivedImage[Any]], *, anew: bool) -> None:
        """Store processed images, with untaken ones of the same playback."""
        self.received += len(taken)
        self._ready_anew = anew or (bool(self._ready) and self._ready_anew)
        self._ready = taken if anew else self._ready | taken
        self._ready_for = place

    def _due_s(self, begun: tuple[float, int], now_s: float) -> float:
        """Return the current time of a playback with a given start."""
        begun_s, first = begun
        return self.time_steps[first].time_s + now_s - begun_s

    def _advance(self, now_s: float) -> None:
        """Advance to the time step that is due."""
        if self._begun is None:
            # Time starts with the first shown image, which may take long if kernels are compiled.
            if self.held or self._made != self.place:
                return
            self._begun = now_s, self.place
        due_s = self._due_s(self._begun, now_s)
        last = len(self.time_steps) - 1
        while self.place < last and self.time_steps[self.place + 1].time_s <= due_s:
            self.place += 1
        if self.place < last or due_s < self.time_steps[last].time_s + UNTIMED_S:
            return
        if self._loop:
            if self._made is not None and self._made_in == self._plays:
                self.skipped += last - self._made
            self.place, self._begun, self._made = 0, (now_s, 0), None
        else:
            self.playing = False

    def _taken(self, name: str, place: int, number: int) -> ReceivedImage[Any]:
        reader = self._readers[name]
        image: Energyscape | AcousticMap
        if self.shows_maps and isinstance(reader, RecordingReader):
            image = self._map(name, reader, number)
        else:
            item = reader[number]
            image = self._processed(name, item) if isinstance(item, Measurement) else item
            if isinstance(item, Measurement):
                self._notes += self._result_notes.of_sound(item)
            elif isinstance(reader, EnergyscapeReader):
                self._notes += self._result_notes.of_file(name, reader)
        self._notes += self._result_notes.of(image, self._band_note(name, reader))
        pose = self._given.get(name) or Pose.of(reader.translation_m, reader.rotation_xyzw)
        if image.settings.processing.level_directions:
            pose = None  # A mounting applies to directions in the frame of the sensor.
        return ReceivedImage(image, pose, self.time_steps[place].time_s, self._tracks[name].interval_s)

    def _band_note(self, name: str, reader: Reader) -> str | None:
        """Return the note on sound that the bands of a sensor's maps do not show."""
        if name in self._map_sequences:
            return self._map_sequences[name].band_note
        return reader.band_note if isinstance(reader, AcousticMapReader) else None

    def _are_maps(self, stamps: Mapping[str, Sequence[Stamp]]) -> bool:
        """Return True for a recording without any measurement for images."""
        return all(
            is_passive(reader.settings, stamp) for name, reader in self._readers.items() for stamp in stamps[name]
        )

    def _map(self, name: str, reader: RecordingReader, number: int) -> AcousticMap:
        """Return the acoustic map that ends with a measurement."""
        if name not in self._map_sequences:
            self._map_sequences[name] = MapSequence(reader, device=self._device)
        return self._map_sequences[name](number)

    def _processed(self, name: str, measurement: Measurement) -> Energyscape:
        """Return the image of a measurement; other air gives other ranges and needs another pipeline."""
        pipeline = self._pipelines.get(name)
        if pipeline is None or pipeline.settings.air != measurement.settings.air:
            if pipeline is not None:
                pipeline.close()
            pipeline = self._pipelines[name] = Pipeline(measurement.settings, device=self._device, predict=False)
        return pipeline.process(measurement)

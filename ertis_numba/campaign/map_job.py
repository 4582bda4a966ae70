"""Processing of one recording to its file of acoustic maps, the same in any process."""

import statistics
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ertis_numba.analysis.health import health
from ertis_numba.analysis.layout_match import LayoutMatch
from ertis_numba.analysis.sample_faults import SampleFaults
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.base.errors import DataError
from ertis_numba.campaign.sensor_processing import describe_faults, require_same_air
from ertis_numba.campaign.tasks import CampaignOptions
from ertis_numba.frames import AcousticMap
from ertis_numba.passive import AcousticCamera
from ertis_numba.passive.bands import shaped_noise_warning
from ertis_numba.passive.components import gathered
from ertis_numba.settings import Settings
from ertis_numba.storage import AcousticMapWriter, RecordingReader, open_recording, sensor_names

__all__ = ["MapJob", "check_maps", "prepare_maps"]

_Warn = Callable[[str], None]


class MapJob:
    """A recording whose acoustic maps are ready to be computed; nothing is written yet."""

    def __init__(
        self,
        recordings: Sequence[RecordingReader],
        cameras: Sequence[AcousticCamera],
        writer: AcousticMapWriter,
        warn: _Warn,
    ) -> None:
        self._writer, self._device = writer, cameras[0].device
        self._runs = [_MapsOfSensor(*pair, warn) for pair in zip(recordings, cameras, strict=True)]
        self.measurements = sum(map(len, recordings))
        """Number of measurements."""

    def run(self) -> Generator[int]:
        """Write the file, and yield the number of processed measurements; closed early, it leaves no file."""
        done = 0
        with self._writer:
            for run in self._runs:
                for _ in run.write(self._writer):
                    done += 1
                    yield done

    def report(self) -> dict[str, Any]:
        """Return the report of ``--json``; entries of a single sensor are repeated at the top level."""
        rows = [run.report() for run in self._runs]
        outside = ("directions", "bands", "loudest") if len(rows) == 1 else ()
        return {
            "kind": "acoustic_map",
            "measurements": self.measurements,
            "maps": sum(row["maps"] for row in rows),
            **{name: rows[0][name] for name in outside},
            "device": self._device,
            "median_ms": round(statistics.median(time_ms for run in self._runs for time_ms in run.times_ms), 3),
            "sensors": rows,
        }


class _MapsOfSensor:
    """Acoustic maps of one sensor, and the mean of their powers."""

    def __init__(self, recording: RecordingReader, camera: AcousticCamera, warn: _Warn) -> None:
        self._recording, self._camera, self._warn = recording, camera, warn
        self.times_ms: list[float] = []
        self._n_maps, self._masked_s = 0, 0.0
        self._sum: Any = 0.0  # Sum of powers, weighted by the measurements of their maps.
        self._last: AcousticMap | None = None

    def write(self, writer: AcousticMapWriter) -> Generator[None]:
        """Process the recording and write its maps, all with its air unless settings replace it; yield after each."""
        recording, camera = self._recording, self._camera
        settings, n_left, elapsed_s = camera.settings, len(recording), 0.0
        as_recorded, faults = settings.air == recording.settings.air, SampleFaults()
        self._compile()
        for measurement in recording:
            if as_recorded:
                require_same_air(measurement, settings)
            start_s = time.perf_counter()
            faults.add(measurement)
            camera.add(replace(measurement, settings=settings))
            n_left -= 1
            is_complete = not n_left or camera.n_measurements == settings.passive.averages
            found = camera.map() if is_complete else None
            elapsed_s += time.perf_counter() - start_s
            if found is not None:
                writer.write(found)
                self._add(found, elapsed_s)
                camera.reset()
                elapsed_s = 0.0
            yield
        lost = faults.note("maps leave out the blocks of samples with them") if recording.truth is None else ""
        notes = list(filter(None, (camera.band_note, lost)))
        if notes:
            writer.note_bands(recording.sensor, "; also, ".join(notes))
        for note in notes:
            if note is not lost or not faults.is_first_only:
                self._warn(f"{recording.path}: sensor {recording.sensor}: {note}")
        if self._masked_s:
            n_emitted = sum(stamp.behaviour == "active" for stamp in recording.stamps())
            self._warn(
                f"{recording.path}: sensor {recording.sensor} emitted its call in {n_emitted} of {len(recording)} "
                f"measurements; maps leave out the first {1e3 * self._masked_s:.1f} ms of each, but contain echoes of "
                "the call"
            )

    def _compile(self) -> None:
        """Load or compile the kernels with one map, so that times of maps do not include this."""
        self._camera.add(replace(self._recording[0], settings=self._camera.settings))
        self._camera.map()
        self._camera.reset()

    def _add(self, found: AcousticMap, elapsed_s: float) -> None:
        """Add a map to the mean, and the time that its measurements took."""
        self._last = found
        self.times_ms += [1000 * elapsed_s / found.n_measurements] * found.n_measurements
        self._n_maps += 1
        self._masked_s = max(self._masked_s, found.masked_s)
        self._sum = self._sum + found.n_measurements * found.power.astype(np.float64)

    def report(self) -> dict[str, Any]:
        """Return the report of ``--json``; ``loudest`` holds the loudest direction of each band of the mean map."""
        assert self._last is not None  # noqa: S101  a recording has at least one measurement
        mean = gathered(self._last.replace(power=np.asarray(self._sum / len(self._recording), np.float32)))
        return {
            "sensor": self._recording.sensor,
            "measurements": len(self._recording),
            "maps": self._n_maps,
            "directions": len(mean.azimuth_rad),
            "bands": len(mean.band_hz),
            "median_ms": round(statistics.median(self.times_ms), 3),
            **({"band_note": note} if (note := self._camera.band_note) else {}),
            "loudest": [each.as_dict() for each in mean.loudest()],
        }


@contextmanager
def prepare_maps(
    path: Path,
    target: Path,
    options: CampaignOptions,
    *,
    sensors: Sequence[str],
    settings: Mapping[str, Settings] | None = None,
    warn: _Warn = lambda _: None,
) -> Generator[MapJob]:
    """Open a recording and check every sensor, so that errors are reported before any processing."""
    # Options of images have no effect. Raises DataError if microphones are faulty and `options.strict` is set.
    with ExitStack() as stack:
        if settings is None:
            options.without.require_known(sensor_names(path))
        recordings = [stack.enter_context(open_recording(path, sensor=name)) for name in sensors]
        mounting = {name: place for name, place in (options.mounting or {}).items() if name in sensors}
        writer = AcousticMapWriter(target, recording=recordings, mounting=mounting, overwrite=options.overwrite)
        cameras = [
            stack.enter_context(
                AcousticCamera(
                    options.settings_of(recording.sensor, recording.settings)
                    if settings is None
                    else settings[recording.sensor],
                    options.device,
                    options.threads,
                    check=False,
                    false_alarm=FALSE_ALARM,
                )
            )
            for recording in recordings
        ]
        for recording, camera in zip(recordings, cameras, strict=True):
            _check_sensor(recording, camera.settings, options, warn, several=len(recordings) > 1)
            if noisy := shaped_noise_warning(camera.settings, camera.band_hz):
                warn(f"{path}: {noisy}")
            searched = camera.finder.warning if camera.finder is not None else None
            for text in filter(None, dict.fromkeys((camera.warning, searched))):
                warn(f"{path}: sensor {recording.sensor}: {text}")
        yield MapJob(recordings, cameras, writer, warn)


def check_maps(
    path: Path, options: CampaignOptions, *, settings: Mapping[str, Settings], warn: _Warn = lambda _: None
) -> None:
    """Check every sensor of a recording as `prepare_maps` does, with the settings of its maps; write nothing."""
    for name, each in settings.items():
        with open_recording(path, sensor=name) as recording:
            _check_sensor(recording, each, options, warn, several=len(settings) > 1)


def _check_sensor(
    recording: RecordingReader, settings: Settings, options: CampaignOptions, warn: _Warn, *, several: bool
) -> None:
    """Report faulty microphones, or refuse them."""
    name = f"{recording.path}: sensor {recording.sensor}"
    report = health(replace(recording[0], settings=settings))
    layout = LayoutMatch.of(report.findings).warning
    faults = describe_faults(name, report, recording.sensor if several else "")
    for text in filter(None, (faults, layout and f"{name}: {layout}")):
        if options.strict:
            raise DataError(text)
        warn(text)

"""Multichannel PCM recordings of microphone arrays: WAV files, and HDF5 files of Acoular."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.air import sound_speed_m_s
from ertis_numba.errors import ArgumentError, DataError
from ertis_numba.frames import Behaviour, Measurement, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.interop.pcm_files import PcmFile, inspect, joined, per_file, require_alike
from ertis_numba.interop.pcm_folder import is_wav_folder, wav_files
from ertis_numba.interop.recorder_times import TimedFile, file_times
from ertis_numba.interop.sample_levels import SampleLevels
from ertis_numba.settings import Processing, Recording, Settings, fit_ranges, record_range_m

__all__ = ["PcmReader", "open_pcm"]

_MAX_DURATION_S: Final = 1e9
_MAX_EXPANSION: Final = 1000.0


class _Cuts(NamedTuple):
    """First samples of the measurements in a file, and the times of their emissions relative to its start."""

    samples: NDArray[np.int64]
    times_s: NDArray[np.float64]


class PcmReader:
    """Reader of the measurements in PCM files, one file at a time.

    Such files contain no SYNC count, so it equals the number of the measurement. 8-bit and 16-bit samples become int16.
    All others become float32, which represents 24-bit and single-precision samples exactly.

    Parameters
    ----------
    paths : sequence of Path
        Files with the same sample rate and number of channels. Each contains one measurement, or several of
        ``length_s``.
    settings, sensor, skip_s, length_s, start_ns, passive, join, time_expansion, whole_range, temperature_c, \
    humidity_percent
        See `open_pcm`.

    Attributes
    ----------
    settings : Settings
        Settings of the measurements, with sample rate, length and encoding of the files.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        settings: Settings | None,
        *,
        sensor: str = "sensor",
        skip_s: float = 0.0,
        length_s: float | None = None,
        start_ns: int | Sequence[int] = (),
        passive: bool = False,
        join: bool = False,
        time_expansion: float | None = None,
        whole_range: bool | None = None,
        temperature_c: float | None = None,
        humidity_percent: float | None = None,
    ) -> None:
        if not paths:
            raise ArgumentError("no PCM file is given; give at least one")
        if time_expansion is not None:
            checks.between("time_expansion", time_expansion, 1 / _MAX_EXPANSION, _MAX_EXPANSION)
        files = [inspect(path, time_expansion) for path in paths]
        first = files[0]
        known = _with_air(_require_settings(settings, first), temperature_c, humidity_percent)
        if join:
            files = [joined(files)]
        require_alike(files)
        _require_channels(files, known)
        self._files = files
        self._rate_hz = files[0].rate_hz
        self._cut(skip_s, length_s)
        self._behaviour: Behaviour = "passive" if passive else "unknown"
        if passive:
            known = known.replace("processing.mode", "passive")
        recording = Recording(sample_rate_hz=self._rate_hz, n_samples=self._n_samples, encoding=files[0].encoding)
        self.settings, ranges = _fitted(known, recording, files[0], whole_range=whole_range)
        self._enabled = microphones(self.settings.array).enabled
        self._sensor = checks.sensor_name(sensor)
        self._firsts_ns, times = self._times(start_ns)
        self._notes = [*times, *per_file([(file.path, note) for file in files for note in file.notes]), *ranges]
        self._levels: dict[Path, SampleLevels] = {}

    def __len__(self) -> int:
        return sum(len(cuts.samples) for cuts in self._cuts)

    def __iter__(self) -> Iterator[Measurement]:
        sequence = 0
        for file, cuts, first_ns in zip(self._files, self._cuts, self._firsts_ns, strict=True):
            samples = file.open()
            levels = self._levels[file.path] = SampleLevels(
                self.settings.recording.full_scale,
                is_bytes=file.kind.itemsize == 1,
                is_float=file.kind.kind == "f",
            )
            after_ns = np.rint(1e9 * (cuts.times_s - cuts.times_s[0])).astype(np.int64).tolist()
            for start, later_ns in zip(cuts.samples.tolist(), after_ns, strict=True):
                stamp = Stamp(
                    sensor=self._sensor,
                    sequence=sequence,
                    sync_count=sequence,
                    timestamp_ns=first_ns + later_ns,
                    behaviour=self._behaviour,
                )
                words = samples.block(slice(start, start + self._n_samples), self._enabled)
                levels.add(words)
                yield Measurement(words, self.settings, stamp)
                sequence += 1

    @property
    def notes(self) -> tuple[str, ...]:
        """Source of the times, assumptions and losses; those about the samples follow once they have been read."""
        levels = [(path, levels.note) for path, levels in self._levels.items() if levels.note]
        return (*self._notes, *self._rest(), *per_file(levels))

    @property
    def rest_s(self) -> float:
        """Total duration of unused samples at the ends of the files, in seconds."""
        ends = [int(cuts.samples[-1]) + self._n_samples for cuts in self._cuts]
        return sum(file.n_samples - end for file, end in zip(self._files, ends, strict=True)) / self._rate_hz

    def _rest(self) -> list[str]:
        """Return the note on samples that no measurement contains."""
        if not self.rest_s:
            return []
        shortest = min(self._files, key=lambda file: file.n_samples)
        text = f"{self.rest_s:.4g} s at the ends of files were left out"
        if self._is_whole and self.rest_s > shortest.duration_s / 2:
            text += (
                f", because {shortest.path.name} lasts only {shortest.duration_s:.4g} s; use --length (length_s) for "
                "several measurements per file"
            )
        return [text]

    def _cut(self, skip_s: float, length_s: float | None) -> None:
        """Set the places of the measurements in the files, and their length."""
        skipped = round(checks.between("skip_s", skip_s, 0.0, _MAX_DURATION_S) * self._rate_hz)
        # An interval between emissions may contain a fraction of a sample, which must not accumulate.
        period = float(min(file.n_samples for file in self._files) - skipped)
        if length_s is not None:
            checks.positive("length_s", length_s)
            period = checks.between("length_s", length_s, 0.0, _MAX_DURATION_S) * self._rate_hz
        self._is_whole = length_s is None
        self._n_samples = math.floor(period * (1 + 1e-12))
        counts = [1 if self._is_whole else self._count(file, skipped, period) for file in self._files]
        for file, count in zip(self._files, counts, strict=True):
            if count < 1 or self._n_samples < 1:
                raise DataError(
                    f"{file.path} lasts {file.duration_s:.4g} s, but {skipped / self._rate_hz:.4g} s to "
                    f"skip and a measurement of {max(self._n_samples, 1) / self._rate_hz:.4g} s are needed; skip less "
                    "(--skip) or give a shorter --length"
                )
        self._cuts = [
            _Cuts(skipped + np.rint(places).astype(np.int64), np.asarray((skipped + places) / self._rate_hz))
            for places in (period * np.arange(count, dtype=np.float64) for count in counts)
        ]

    def _count(self, file: PcmFile, skipped: int, period: float) -> int:
        """Return the number of measurements in a file."""
        if self._n_samples < 1:
            return 0
        count = int((file.n_samples - skipped) / period) + 1
        while count and skipped + round((count - 1) * period) + self._n_samples > file.n_samples:
            count -= 1
        return count

    def _times(self, start_ns: int | Sequence[int]) -> tuple[list[int], list[str]]:
        """Return the times of the first measurements of the files, and notes about them."""
        given = [start_ns] if isinstance(start_ns, int) else list(start_ns)
        starts_ns = [checks.integer("start_ns", each, 0, 2**63 - 1) for each in given]
        return file_times(
            [TimedFile(file.path, file.duration_s, file.metadata.stated_times) for file in self._files],
            starts_ns,
            first_s=[float(cuts.times_s[0]) for cuts in self._cuts],
        )


def open_pcm(
    paths: Sequence[str | Path] | str | Path,
    settings: Settings | None = None,
    *,
    sensor: str = "sensor",
    skip_s: float = 0.0,
    length_s: float | None = None,
    start_ns: int | Sequence[int] = (),
    passive: bool = False,
    join: bool = False,
    time_expansion: float | None = None,
    whole_range: bool | None = None,
    temperature_c: float | None = None,
    humidity_percent: float | None = None,
) -> PcmReader:
    """Open files of multichannel PCM: WAV, or Acoular's HDF5 (``time_data`` and its ``sample_freq``).

    PCM needs no demodulation, so the chain begins after it.

    Parameters
    ----------
    paths : path or sequence of paths
        Files with the same sample rate and number of channels, in the order of their times, or a folder of WAV files.
        Channel m is row m of the layout.
    settings : Settings, optional
        Array, call, air, processing and accuracy. Files that `export` wrote contain them. The files determine
        ``recording``. If ``processing.range_decimation`` leaves fewer than 1.8 ranges per second and hertz of the
        call's bandwidth, as the default may, a suitable value replaces it.
    sensor : str
        Name of the sensor.
    skip_s : float
        Start of the first emission in each file, in seconds.
    length_s : float, optional
        Interval between emissions in seconds, for files with several measurements. By default, each file contains one
        measurement, with the length of the shortest file.
    start_ns : int or sequence of int
        Time of the first emission of the first file or of each file, in nanoseconds since 1970-01-01 UTC. Without it,
        times are those in the metadata of recorders (GUANO, Wildlife Acoustics, AudioMoth, Broadcast Wave), otherwise
        those in the names of the files. With one, the times between files are. Files of unknown times follow each other
        without pauses, from time 0 on by default. `PcmReader.notes` states the source.
    passive : bool
        True if no call was emitted. ``processing.mode`` then becomes ``passive``. The call of the settings has no
        meaning, and the sample rate may be too low for it.
    join : bool
        True if each file contains one microphone or some; the channels of the files follow each other.
    time_expansion : float, optional
        Factor by which files play slower than the sound was recorded; by default that in the metadata, otherwise 1.
        The sample rate is that of the header times the factor, and all times count in the recorded sound.
    whole_range : bool, optional
        True if ``processing.range_m`` becomes what the record contains: ranges whose whole echo begins after the call
        and ends within the record. By default, this replaces only the default ``processing.range_m``.
    temperature_c, humidity_percent : float, optional
        Air, instead of that of the settings.

    Returns
    -------
    PcmReader
        Iterable of measurements with a length.

    Raises
    ------
    DataError
        A file is missing, has another format, is shorter than a measurement, or differs from the first in sample rate,
        encoding or channels. The number of channels differs from that of the array, or the sample rate is too low for
        the call that was emitted. Files are not in the order of their times, or only some of them state one. The
        metadata contradict the sample rate.
    ArgumentError
        No file is given, a value is invalid, or neither the argument nor the file contains settings.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     files = ertis.export("signals.h5", [recording[0]], file_format="acoular", overwrite=True)
    >>> len(ertis.open_pcm("signals.h5"))
    1
    """
    several = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    if len(several) == 1 and is_wav_folder(several[0]):
        several = wav_files(several[0], by_time=not join)
    return PcmReader(
        several,
        settings,
        sensor=sensor,
        skip_s=skip_s,
        length_s=length_s,
        start_ns=start_ns,
        passive=passive,
        join=join,
        time_expansion=time_expansion,
        whole_range=whole_range,
        temperature_c=temperature_c,
        humidity_percent=humidity_percent,
    )


def _require_settings(settings: Settings | None, first: PcmFile) -> Settings:
    known = settings or first.settings
    if known is None:
        raise ArgumentError(f"{first.path} contains no array and call; give settings")
    return known


def _with_air(settings: Settings, temperature_c: float | None, humidity_percent: float | None) -> Settings:
    given = {"temperature_c": temperature_c, "humidity_percent": humidity_percent}
    return settings.replace(
        air=settings.air.replace(**{key: value for key, value in given.items() if value is not None})
    )


def _require_channels(files: Sequence[PcmFile], settings: Settings) -> None:
    first, layout = files[0], microphones(settings.array)
    wanted = len(layout.enabled)
    if first.n_channels == wanted:
        return
    if first.n_samples == wanted:
        raise DataError(f"{first.path} has {first.n_channels} channels of {wanted} samples; transpose it")
    text = f"{first.path} has {first.n_channels} channels, but array {layout.name!r} has {wanted}"
    if len(files) > 1 and sum(file.n_channels for file in files) == wanted:
        raise DataError(
            f"{text}, as all {len(files)} files have together; use --join (join=True) if they are the microphones of "
            "one measurement"
        )
    raise DataError(f"{text}; give a layout with one row for each channel (--layout)")


def _fitted(
    settings: Settings, recording: Recording, first: PcmFile, *, whole_range: bool | None
) -> tuple[Settings, list[str]]:
    """Return settings for another recording, with matching ranges, and notes about them."""
    call = settings.call
    if settings.processing.mode == "passive":
        return settings.replace(recording=recording), []
    if recording.sample_rate_hz <= 2 * call.high_frequency_hz:
        raise DataError(
            f"{first.path} has a sample rate of {recording.sample_rate_hz:g} Hz, too low for a call up to "
            f"{call.high_frequency_hz:g} Hz; give the emitted call, record at more than twice its frequency, use "
            "--time-expansion (time_expansion) if the file plays slower than the sound, or give --passive "
            "(passive=True) if no call was emitted"
        )
    if recording.duration_s <= call.end_s:
        raise DataError(
            f"a measurement of {first.path} has {1e3 * recording.duration_s:.4g} ms, but the call alone lasts "
            f"{1e3 * call.end_s:.4g} ms; give a longer --length, or skip less (--skip)"
        )
    held_m = record_range_m(recording, call, sound_speed_m_s(settings.air))
    stated_m = settings.processing.range_m
    is_whole = stated_m == Processing().range_m if whole_range is None else whole_range
    processing = fit_ranges(settings.processing, recording, call)
    processing = processing.replace(range_m=held_m if is_whole else stated_m)
    holds = f"{held_m[0]:g}–{held_m[1]:g} m"
    if is_whole:
        note = f"range {holds}, all that the record holds"
    else:
        note = f"range {stated_m[0]:g}–{stated_m[1]:g} m as in the settings; the record holds {holds}"
    return settings.replace(recording=recording, processing=processing), [note]

"""Multichannel PCM recordings of microphone arrays: WAV files, and HDF5 files of Acoular."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError, DataError
from ertis_numba.frames import Behaviour, Measurement, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.interop._acoular import read_acoular
from ertis_numba.settings import Recording, Settings, fit_ranges
from ertis_numba.wav import Samples, read_wav

__all__ = ["PcmReader", "open_pcm"]

_ACOULAR = {".h5", ".hdf5", ".hdf"}
_MIDDLE_OF_BYTES = 128
_MAX_DURATION_S = 1e9
_MAX_FLOAT32 = float(np.finfo(np.float32).max)


@dataclass(frozen=True, slots=True)
class _PcmFile:
    """Properties of a PCM file."""

    path: Path
    rate_hz: float
    n_samples: int
    n_channels: int
    encoding: Literal["int16", "float32"]
    settings: Settings | None = None
    notes: tuple[str, ...] = ()


class PcmReader:
    """Reader of the measurements in PCM files, one file at a time.

    Such files contain no SYNC count, so it equals the number of the measurement. 8-bit and 16-bit samples become int16.
    All others become float32, which represents 24-bit and single-precision samples exactly.

    Parameters
    ----------
    paths : sequence of Path
        Files with the same sample rate and number of channels. Each contains one measurement, or several of
        ``length_s``.
    settings, sensor, skip_s, length_s, start_ns, passive
        See `open_pcm`.

    Attributes
    ----------
    settings : Settings
        Settings of the measurements, with sample rate, length and encoding of the files.
    rest_s : float
        Total duration of unused samples at the ends of the files, in seconds.
    notes : tuple of str
        Contradictions in the files, and how they were resolved.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        settings: Settings | None,
        *,
        sensor: str,
        skip_s: float,
        length_s: float | None,
        start_ns: int,
        passive: bool,
    ) -> None:
        if not paths:
            raise ArgumentError("no PCM file is given; give at least one")
        self._files = [_inspect(path) for path in paths]
        self.notes = tuple(note for file in self._files for note in file.notes)
        first = self._files[0]
        self._require_alike()
        known = _require_settings(settings, first)
        _require_channels(first, known)
        self._skipped = round(checks.between("skip_s", skip_s, 0.0, _MAX_DURATION_S) * first.rate_hz)
        shortest = min(file.n_samples for file in self._files) - self._skipped
        # An interval between emissions may contain a fraction of a sample, which must not accumulate.
        self._period = float(shortest)
        if length_s is not None:
            checks.positive("length_s", length_s)
            self._period = checks.between("length_s", length_s, 0.0, _MAX_DURATION_S) * first.rate_hz
        self._n_samples = math.floor(self._period * (1 + 1e-12))
        self._counts = [1 if length_s is None else self._count(file) for file in self._files]
        self._require_measurements(first)
        ends = [self._start(count - 1) + self._n_samples for count in self._counts]
        left = sum(file.n_samples - end for file, end in zip(self._files, ends, strict=True))
        self.rest_s = left / first.rate_hz
        recording = Recording(sample_rate_hz=first.rate_hz, n_samples=self._n_samples, encoding=first.encoding)
        self._behaviour: Behaviour = "passive" if passive else "unknown"
        if passive:
            known = known.replace("processing.mode", "passive")
        self.settings = _fitted(known, recording, first)
        self._enabled = microphones(self.settings.array).enabled
        self._sensor = checks.sensor_name(sensor)
        self._start_ns = checks.integer("start_ns", start_ns, 0, 2**63 - 1)

    def __len__(self) -> int:
        return sum(self._counts)

    def __iter__(self) -> Iterator[Measurement]:
        sequence, period_ns = 0, 1e9 * self._period / self._files[0].rate_hz
        for file, count in zip(self._files, self._counts, strict=True):
            _, samples, _, _ = _read(file.path)
            for number in range(count):
                start = self._start(number)
                stamp = Stamp(
                    sensor=self._sensor,
                    sequence=sequence,
                    sync_count=sequence,
                    timestamp_ns=self._start_ns + round(sequence * period_ns),
                    behaviour=self._behaviour,
                )
                words = _samples(file, samples[start : start + self._n_samples], start, self._enabled)
                yield Measurement(words, self.settings, stamp)
                sequence += 1

    def _start(self, number: int) -> int:
        """Return the first sample of a measurement in its file."""
        return self._skipped + round(number * self._period)

    def _count(self, file: _PcmFile) -> int:
        """Return the number of measurements in a file."""
        if self._n_samples < 1:
            return 0
        count = int((file.n_samples - self._skipped) / self._period) + 1
        while count and self._start(count - 1) + self._n_samples > file.n_samples:
            count -= 1
        return count

    def _require_measurements(self, first: _PcmFile) -> None:
        for file, count in zip(self._files, self._counts, strict=True):
            if count < 1 or self._n_samples < 1:
                rate_hz = first.rate_hz
                raise DataError(
                    f"{file.path} lasts {file.n_samples / rate_hz:.4g} s, but {self._skipped / rate_hz:.4g} s to "
                    f"skip and a measurement of {max(self._n_samples, 1) / rate_hz:.4g} s are needed; skip less "
                    "(--skip) or give a shorter --length"
                )

    def _require_alike(self) -> None:
        first = self._files[0]
        for file in self._files[1:]:
            for name, came, wanted in (
                ("Hz", file.rate_hz, first.rate_hz),
                ("channels", file.n_channels, first.n_channels),
                ("numbers", file.encoding, first.encoding),
            ):
                if came != wanted:
                    raise DataError(
                        f"{file.path} has {_format_value(came)} {name}, but {first.path.name} has "
                        f"{_format_value(wanted)}; import each file separately"
                    )


def open_pcm(
    paths: Sequence[str | Path] | str | Path,
    settings: Settings | None = None,
    *,
    sensor: str = "sensor",
    skip_s: float = 0.0,
    length_s: float | None = None,
    start_ns: int = 0,
    passive: bool = False,
) -> PcmReader:
    """Open files of multichannel PCM: WAV, or Acoular's HDF5 (``time_data`` and its ``sample_freq``).

    PCM needs no demodulation, so the chain begins after it.

    Parameters
    ----------
    paths : path or sequence of paths
        Files with the same sample rate and number of channels. Channel m is row m of the layout.
    settings : Settings, optional
        Array, call, air, processing and accuracy. Files that `export` wrote contain them. The files determine
        ``recording``. If ``processing.range_decimation`` leaves fewer than 1.8 ranges per second and hertz of the
        call's bandwidth, as the default may, a suitable value replaces it. The default ``processing.range_m`` ends at
        the end of the record.
    sensor : str
        Name of the sensor.
    skip_s : float
        Start of the first emission in each file, in seconds.
    length_s : float, optional
        Interval between emissions in seconds, for files with several measurements. By default, each file contains one
        measurement, with the length of the shortest file.
    start_ns : int
        Time of the first emission, in nanoseconds since 1970-01-01 UTC; 0 if unknown. The times of the others follow
        from the length of a measurement.
    passive : bool
        True if no call was emitted. ``processing.mode`` then becomes ``passive``. The call of the settings has no
        meaning, and the sample rate may be too low for it.

    Returns
    -------
    PcmReader
        Iterable of measurements with a length.

    Raises
    ------
    DataError
        A file is missing, has another format, is shorter than a measurement, or differs from the first in sample rate,
        encoding or channels. The number of channels differs from that of the array, or the sample rate is too low for
        the call that was emitted.
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
    several = [paths] if isinstance(paths, str | Path) else paths
    return PcmReader(
        [Path(path) for path in several],
        settings,
        sensor=sensor,
        skip_s=skip_s,
        length_s=length_s,
        start_ns=start_ns,
        passive=passive,
    )


def _require_settings(settings: Settings | None, first: _PcmFile) -> Settings:
    known = settings or first.settings
    if known is None:
        raise ArgumentError(f"{first.path} contains no array and call; give settings")
    return known


def _require_channels(first: _PcmFile, settings: Settings) -> None:
    layout = microphones(settings.array)
    wanted = len(layout.enabled)
    if first.n_channels == wanted:
        return
    if first.n_samples == wanted:
        raise DataError(f"{first.path} has {first.n_channels} channels of {wanted} samples; transpose it")
    raise DataError(
        f"{first.path} has {first.n_channels} channels, but array {layout.name!r} has {wanted}; give a layout with "
        "one row for each channel (--layout)"
    )


def _fitted(settings: Settings, recording: Recording, first: _PcmFile) -> Settings:
    """Return settings for another recording, with matching ranges."""
    call = settings.call
    if settings.processing.mode == "passive":
        return settings.replace(recording=recording)
    if recording.sample_rate_hz <= 2 * call.high_frequency_hz:
        raise DataError(
            f"{first.path} has a sample rate of {recording.sample_rate_hz:g} Hz, too low for a call up to "
            f"{call.high_frequency_hz:g} Hz; give the emitted call, record at more than twice its frequency, or give "
            "--passive (passive=True) if no call was emitted"
        )
    if recording.duration_s <= call.end_s:
        raise DataError(
            f"a measurement of {first.path} has {1e3 * recording.duration_s:.4g} ms, but the call alone lasts "
            f"{1e3 * call.end_s:.4g} ms; give a longer --length, or skip less (--skip)"
        )
    return settings.replace(recording=recording, processing=fit_ranges(settings.processing, recording, call))


def _inspect(path: Path) -> _PcmFile:
    rate_hz, samples, settings, notes = _read(path)
    try:
        Recording(sample_rate_hz=rate_hz)
    except ArgumentError as error:
        raise DataError(f"{path}: {error}") from error
    is_short = samples.dtype.kind in "iu" and samples.dtype.itemsize <= 2
    n_samples, n_channels = samples.shape
    return _PcmFile(path, rate_hz, n_samples, n_channels, "int16" if is_short else "float32", settings, notes)


def _read(path: Path) -> tuple[float, Samples, Settings | None, tuple[str, ...]]:
    """Return sample rate, samples, settings and notes of a file."""
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; give a PCM file") from error
    if path.suffix.lower() in _ACOULAR:
        return *read_acoular(path), ()
    wav = read_wav(path)
    return wav.rate_hz, wav.samples, None, wav.notes


def _samples(file: _PcmFile, numbers: NDArray[Any], start: int, enabled: NDArray[np.bool_]) -> NDArray[Any]:
    """Return samples in the type of a recording; non-finite samples of disabled channels become 0."""
    if numbers.dtype.itemsize == 1:  # 8-bit WAV samples are unsigned.
        middle = _MIDDLE_OF_BYTES if numbers.dtype.kind == "u" else 0
        return ((numbers.astype(np.int16) - middle) * 256).astype("<i2")
    if file.encoding == "int16":
        return numbers.astype("<i2")
    if numbers.dtype.kind == "i":
        return (numbers / 2.0 ** (8 * numbers.dtype.itemsize - 1)).astype("<f4")
    with np.errstate(over="ignore"):  # The check below refuses the result.
        words = numbers.astype("<f4")
    broken = ~np.isfinite(words)
    words[broken & ~enabled] = 0
    if broken[:, enabled].any():
        sample, channel = np.argwhere(broken & enabled)[0].tolist()
        came = numbers[sample, channel]
        raise DataError(
            f"{file.path} contains {came:g} at sample {start + sample} of channel {channel}; "
            + (f"give numbers up to {_MAX_FLOAT32:.4g}" if np.isfinite(came) else "give finite numbers")
        )
    return words


def _format_value(value: object) -> object:
    return f"{value:g}" if isinstance(value, float) else value

"""Single files of PCM, and files of single microphones that are joined: properties and samples."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.base.file_kinds import kind_of, problem_of
from ertis_numba.base.wav import Samples, read_wav
from ertis_numba.interop._acoular import read_acoular
from ertis_numba.interop.recorder_metadata import RecorderMetadata, read_metadata
from ertis_numba.interop.recorder_names import MAX_DIFFERENCE_S, StatedTime, times_in_names
from ertis_numba.settings import Recording, Settings

__all__ = [
    "PcmFile",
    "PcmSamples",
    "first_stated_times",
    "inspect",
    "joined",
    "natural_order",
    "per_file",
    "require_alike",
    "true_rate_hz",
]

_ACOULAR: Final = {".h5", ".hdf5", ".hdf"}
_MIDDLE_OF_BYTES: Final = 128
_MAX_FLOAT32: Final = float(np.finfo(np.float32).max)


_TOLERANCE: Final = 1e-3


@dataclass(frozen=True, slots=True)
class PcmFile:
    """Properties of a PCM file, or of several whose channels are joined."""

    paths: tuple[Path, ...]  # in the order of their channels
    rate_hz: float  # at which the sound was recorded
    n_samples: int
    counts: tuple[int, ...]  # channels of each file
    kind: np.dtype[Any]
    metadata: RecorderMetadata
    is_wide: bool  # integers of 32 or 64 bits use all bits according to the file
    notes: tuple[str, ...] = ()
    settings: Settings | None = None

    @property
    def path(self) -> Path:
        """First file."""
        return self.paths[0]

    @property
    def n_channels(self) -> int:
        """Number of channels of all files."""
        return sum(self.counts)

    @property
    def duration_s(self) -> float:
        """Duration of the sound, in seconds."""
        return self.n_samples / self.rate_hz

    @property
    def encoding(self) -> Literal["int16", "float32"]:
        """Encoding of a recording that holds the samples."""
        return "int16" if self.kind.kind in "iu" and self.kind.itemsize <= 2 else "float32"

    def open(self, *, without: int | None = None) -> "PcmSamples":
        """Return the samples, without one of the channels if desired."""
        return PcmSamples(self, [_read(path).samples for path in self.paths], without)


class PcmSamples:
    """Samples of a PCM file as numbers of a recording; slices are read when they are needed."""

    def __init__(self, file: PcmFile, parts: Sequence[Any], without: int | None = None) -> None:
        self._file = file
        self._parts = parts
        self._without = without

    def block(self, samples: slice, enabled: NDArray[np.bool_] | None = None) -> NDArray[Any]:
        """Return samples (sample, channel), 0 for non-finite ones of disabled channels; others raise DataError."""
        numbers = self._numbers(samples)
        if self._without is not None:
            numbers = np.delete(numbers, self._without, axis=1)
        return _converted(self._file, numbers, samples.start, enabled)

    def channel(self, channel: int, samples: slice) -> NDArray[np.float64]:
        """Return samples of one channel, in units of the file; raise DataError if one is not finite."""
        numbers = self.channel_or_nan(channel, samples)
        if not np.isfinite(numbers).all():
            raise DataError(f"channel {channel} of {self._file.path} contains NaN or infinity; replace these numbers")
        return numbers

    def channel_or_nan(self, channel: int, samples: slice) -> NDArray[np.float64]:
        """Return samples of one channel, in units of the file, as they are."""
        return self._numbers(samples)[:, channel].astype(np.float64)

    def _numbers(self, samples: slice) -> NDArray[Any]:
        several = [part[samples] for part in self._parts]
        return several[0] if len(several) == 1 else np.concatenate(several, axis=1)


def inspect(path: Path, expansion: float | None = None) -> PcmFile:
    """Return the properties of a file."""
    read = _read(path)
    try:
        Recording(sample_rate_hz=read.rate_hz)
    except ArgumentError as error:
        raise DataError(f"{path}: {error}") from error
    metadata = read_metadata(read.chunks, read.rate_hz)
    rate_hz, expanded = true_rate_hz(path, read.rate_hz, metadata, expansion)
    n_samples, n_channels = read.samples.shape
    kind = read.samples.dtype
    return PcmFile(
        paths=(path,),
        rate_hz=rate_hz,
        n_samples=n_samples,
        counts=(n_channels,),
        kind=kind,
        metadata=metadata,
        is_wide=kind.kind == "i" and kind.itemsize >= 4 and (read.valid_bits or 8 * kind.itemsize) == 8 * kind.itemsize,
        notes=(*read.notes, *metadata.notes, *expanded),
        settings=read.settings,
    )


def joined(files: Sequence[PcmFile]) -> PcmFile:
    """Return one file with the channels of all, cut to the shortest."""
    # Raises DataError if they differ in rate, type of numbers or time, or are in alphabetical instead of numeric order.
    require_alike(files, joined=True)
    _require_one_measurement(files)
    first = files[0]
    n_samples = min(file.n_samples for file in files)
    notes = [f"the files were joined as channels, {_channels(files)}"]
    longest = max(file.n_samples for file in files)
    if longest > n_samples:
        notes.append(
            f"the files differ in length; up to {(longest - n_samples) / first.rate_hz:.4g} s at the end were left out"
        )
    return replace(
        first,
        paths=tuple(file.path for file in files),
        n_samples=n_samples,
        counts=tuple(file.n_channels for file in files),
        notes=(*notes, *per_file([(file.path, note) for file in files for note in file.notes])),
    )


def _require_one_measurement(files: Sequence[PcmFile]) -> None:
    """Refuse files of different times, and the order in which shells list names with numbers."""
    first, names = files[0], [file.path.name for file in files]
    if names == sorted(names) != sorted(names, key=natural_order):
        listed = ", ".join(names[:8]) + ", …" * (len(names) > 8)
        raise DataError(
            f"the files are in alphabetical order: {listed}; list them in the order of the channels, or import their "
            "folder, which sorts them by number"
        )
    times_ns = [time and time.since_1970_ns for time in first_stated_times(files)]
    for file, time_ns in zip(files, times_ns, strict=True):
        late_s = 0.0 if time_ns is None or times_ns[0] is None else (time_ns - times_ns[0]) / 1e9
        if abs(late_s) > MAX_DIFFERENCE_S:
            raise DataError(
                f"{file.path} begins {abs(late_s):.6g} s {'after' if late_s > 0 else 'before'} {first.path.name}; join "
                "only files that begin at the same time"
            )


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a key by which ``mic2.wav`` precedes ``mic10.wav``."""
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def first_stated_times(files: Sequence[PcmFile]) -> list[StatedTime | None]:
    """Return the times of files from their metadata, otherwise from their names; clocks that were set come first."""
    named = times_in_names([file.path.name for file in files])
    every = [[*file.metadata.stated_times, *([name] if name else [])] for file, name in zip(files, named, strict=True)]
    return [next((time for time in times if time.was_set), next(iter(times), None)) for times in every]


def require_alike(files: Sequence[PcmFile], *, joined: bool = False) -> None:
    """Refuse files that differ in rate, channels or type of numbers."""
    first = files[0]
    remedy = "join only files of one recorder" if joined else "import each file separately"
    for file in files[1:]:
        for name, came, wanted in (
            ("Hz", file.rate_hz, first.rate_hz),
            ("channels", file.n_channels, file.n_channels if joined else first.n_channels),
            ("numbers", file.encoding, first.encoding),
        ):
            if came != wanted:
                if name == "Hz" and _is_multiple(file.rate_hz, first.rate_hz) and not joined:
                    remedy += ", or use time_expansion if all play slower by one factor"
                raise DataError(
                    f"{file.path} has {_format_value(came)} {name}, but {first.path.name} has "
                    f"{_format_value(wanted)}; {remedy}"
                )


def _is_multiple(one_hz: float, other_hz: float) -> bool:
    ratio = max(one_hz, other_hz) / min(one_hz, other_hz)
    return ratio == round(ratio)


def per_file(notes: Iterable[tuple[Path, str]]) -> list[str]:
    """Return notes with the name of the first file that each applies to, and the number of others."""
    paths: dict[str, list[Path]] = {}
    for path, text in notes:
        paths.setdefault(text, []).append(path)
    return [
        f"{those[0].name}{f' (and {len(those) - 1} more)' if len(those) > 1 else ''}: {text}"
        for text, those in paths.items()
    ]


def _channels(files: Sequence[PcmFile]) -> str:
    """Return the order of the channels in words."""
    names = [file.path.name for file in files]
    if len(names) > 4:
        names = [*names[:2], "…", names[-1]]
    return f"channel 0 first: {', '.join(names)}"


class _Read(NamedTuple):
    """Content of a file; ``valid_bits`` is None if the file does not state how many bits are used."""

    rate_hz: float
    samples: Samples
    settings: Settings | None = None
    valid_bits: int | None = None
    chunks: Mapping[str, bytes] = MappingProxyType({})
    notes: tuple[str, ...] = ()


def _read(path: Path) -> _Read:
    try:
        with path.open("rb"):
            pass
    except PermissionError as error:
        raise DataError(f"{path}: {error.strerror}; ask its owner for permission to read it") from error
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; choose a PCM file") from error
    kind = kind_of(path)
    if kind is None:
        is_acoular = path.suffix.lower() in _ACOULAR
    else:
        is_acoular = kind.is_hdf5
        if not (kind.is_wav or is_acoular):
            raise DataError(f"{path} {problem_of(path)}")
    if is_acoular:
        return _Read(*read_acoular(path))
    wav = read_wav(path)
    return _Read(wav.rate_hz, wav.samples, None, wav.valid_bits, wav.chunks, wav.notes)


def _converted(
    file: PcmFile, numbers: NDArray[Any], first_sample: int, enabled: NDArray[np.bool_] | None
) -> NDArray[Any]:
    """Return numbers of a file in the type of a recording."""
    if numbers.dtype.itemsize == 1:  # 8-bit WAV samples are unsigned.
        middle = _MIDDLE_OF_BYTES if numbers.dtype.kind == "u" else 0
        return ((numbers.astype(np.int16) - middle) * 256).astype("<i2")
    if file.encoding == "int16":
        return numbers.astype("<i2")
    if numbers.dtype.kind == "i":
        return (numbers / 2.0 ** (8 * numbers.dtype.itemsize - 1)).astype("<f4")
    with np.errstate(over="ignore"):  # The check below refuses the result.
        words = numbers.astype("<f4")
    if enabled is None:
        return words
    broken = ~np.isfinite(words)
    words[broken & ~enabled] = 0
    if broken[:, enabled].any():
        sample, channel = np.argwhere(broken & enabled)[0].tolist()
        came = numbers[sample, channel]
        raise DataError(
            f"{file.path} contains {came:g} at sample {first_sample + sample} of channel {channel}; "
            + (
                f"scale the samples to at most {_MAX_FLOAT32:.4g}"
                if np.isfinite(came)
                else "replace such samples in the file, or add the channel to array.disabled in the settings"
            )
        )
    return words


def _format_value(value: object) -> object:
    return f"{value:g}" if isinstance(value, float) else value


def true_rate_hz(
    path: Path, header_hz: float, metadata: RecorderMetadata, expansion: float | None
) -> tuple[float, list[str]]:
    """Return the rate of the recorded sound and notes if it differs; expansion overrides the metadata."""
    stated = metadata.expansion
    ratio = None if metadata.rate_hz is None else metadata.rate_hz / header_hz
    if expansion is not None:
        differs = any(each is not None and not _equal(each, expansion) for each in (stated, ratio))
        text = _expanded(expansion, header_hz, "time_expansion")
        if differs:
            text += f", although the metadata state {_statement(metadata)}"
        return header_hz * expansion, [text] if differs or expansion != 1 else []
    if ratio is None:
        factor = stated or 1.0
        return header_hz * factor, [_expanded(factor, header_hz, "metadata")] if factor != 1 else []
    if stated is not None and _equal(stated, ratio):
        return header_hz * ratio, [_expanded(ratio, header_hz, "metadata")] if not _equal(ratio, 1) else []
    if stated in {None, 1.0} and (_equal(ratio, 1) or (ratio > 1.5 and _equal(ratio, round(ratio)))):
        factor = round(ratio)
        return header_hz * factor, [_expanded(factor, header_hz, "metadata")] if factor > 1 else []
    other = (
        f"time_expansion={ratio:.6g} if the metadata are right"
        if stated in {None, 1.0}
        else f"time_expansion={stated:g} if the file plays slower by this factor"
    )
    raise DataError(
        f"{path}: the header states {header_hz:g} Hz, but the metadata state {_statement(metadata)}; use "
        f"time_expansion=1 if the header is right, or {other}"
    )


def _expanded(factor: float, header_hz: float, source: str) -> str:
    if factor == 1:
        return f"the sample rate is {header_hz:g} Hz, as in the header ({source})"
    return f"time-expanded by {factor:g} ({source}): the sample rate is {header_hz * factor:g} Hz, not {header_hz:g} Hz"


def _statement(metadata: RecorderMetadata) -> str:
    parts = [f"a sample rate of {metadata.rate_hz:g} Hz"] if metadata.rate_hz else []
    parts += [f"a time expansion of {metadata.expansion:g}"] if metadata.expansion else []
    return " and ".join(parts)


def _equal(one: float, other: float) -> bool:
    return abs(one - other) <= _TOLERANCE * other

"""Raw eRTIS files: little-endian PDM words without a header."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.base.file_kinds import problem_of
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.frames.sample_format import SampleFormat, sample_format
from ertis_numba.settings import PRESETS, Settings

__all__ = ["RawReader", "open_raw"]


_END = 2**63  # Limit of sequence numbers.


class RawReader:
    """Reader of the measurements in raw files.

    Such files contain no time and no SYNC count. The time is 0, and the SYNC count is the number of the measurement.

    Parameters
    ----------
    paths : sequence of Path
        Files with one measurement or more each.
    settings : Settings
        Settings that the files lack: array, call and length of a measurement.
    sensor : str
    first : sequence of int, optional
        Sequence number of the first measurement of each file, rising. By default, measurements are counted from 0.
    check_kind : bool
        See `open_raw`.

    Raises
    ------
    ArgumentError
        No file is given.
    DataError
        A file is missing, empty, has another format, contains an incomplete measurement, or has more measurements than
        free numbers.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        settings: Settings,
        *,
        sensor: str = "sensor",
        first: Sequence[int] | None = None,
        check_kind: bool = True,
    ) -> None:
        self.settings = settings
        self._check_kind = check_kind
        self._sensor = sensor
        self._format = sample_format(settings)
        counts = [self._count(path) for path in paths]
        if not counts:
            raise ArgumentError("no raw file is passed; pass at least one")
        ends = np.cumsum(counts).tolist()
        starts = [0, *ends[:-1]] if first is None else list(first)
        for path, count, start, following in zip(paths, counts, starts, starts[1:], strict=False):
            if start + count > following:
                raise DataError(
                    f"{path} contains {count} measurements, but the next file is number {following}; list the files "
                    "themselves in their order"
                )
        if starts[-1] + counts[-1] > _END:
            raise DataError(
                f"{paths[-1]} is number {starts[-1]}, above the limit of recordings; rename it with a smaller number"
            )
        self._files = list(zip(paths, counts, starts, strict=True))
        self._silent: list[int] = []

    def __len__(self) -> int:
        return sum(count for _, count, _ in self._files)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the measurements read so far."""
        if not self._silent:
            return ()
        first = f"measurement {self._silent[0]}" + f" (and {len(self._silent) - 1} more)" * (len(self._silent) > 1)
        problem = f"all words of {first} are equal, so no microphone recorded anything"
        return (f"{problem}; check the power and the clock of the microphones, or the file",)

    def __iter__(self) -> Iterator[Measurement]:
        self._silent = []
        for path, count, start in self._files:
            with path.open("rb") as file:
                for sequence in range(start, start + count):
                    block = file.read(self._format.n_bytes)
                    if len(block) != self._format.n_bytes:
                        raise DataError(f"{path} became shorter while it was read; copy it again")
                    words = self._format.from_bytes(block)
                    if (words == words[:1]).all():
                        self._silent.append(sequence)
                    stamp = Stamp(sensor=self._sensor, sequence=sequence, sync_count=sequence)
                    yield Measurement(words, self.settings, stamp)

    def _count(self, path: Path) -> int:
        """Return the number of measurements in a file; refuse incomplete ones."""
        if path.is_dir():
            raise DataError(f"{path} is a folder; choose a file of raw words")
        try:
            with path.open("rb") as file:  # stat does not show whether the file is readable.
                n_bytes = file.seek(0, 2)
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; choose a file of raw words") from error
        found = problem_of(path) if self._check_kind else ""
        if found:
            raise DataError(f"{path} {found}; if the file contains raw words nevertheless, use check_kind=False")
        count, rest = divmod(n_bytes, self._format.n_bytes)
        if count and not rest:
            return count
        wanted = f"wanted a multiple of {self._format.n_bytes} ({self._words()})"
        if not n_bytes:
            raise DataError(f"{path} is empty, {wanted}; record it again")
        if n_bytes % self._format.dtype.itemsize:
            raise DataError(f"{path} has {n_bytes} bytes, which is not a multiple of a word, {wanted}; copy it again")
        raise DataError(f"{path} has {n_bytes} bytes, {wanted}; {_remedy(n_bytes, self._format)}")

    def _words(self) -> str:
        return f"{self._format.n_bytes // self._format.dtype.itemsize} words of {self._format.dtype.itemsize} bytes"


_LENGTH_REMEDY = (
    "copy it again if it is cut short, or correct the number of words of a measurement (recording.n_samples)"
)


def _remedy(n_bytes: int, words: SampleFormat) -> str:
    """Return the remedy for a file of another length: another preset, if one fits."""
    tick_bytes = words.n_bytes // words.shape[0]
    lengths = {name.partition("_")[0]: Settings.from_preset(name).recording.n_samples for name in PRESETS}
    fitting = [f"{length}_…" for length, n_samples in lengths.items() if n_bytes % (tick_bytes * n_samples) == 0]
    return f"its length fits the presets {', '.join(fitting)}" if fitting else _LENGTH_REMEDY


def open_raw(
    paths: Sequence[str | Path] | str | Path,
    settings: Settings,
    *,
    sensor: str = "sensor",
    check_kind: bool = True,
) -> RawReader:
    """Open raw files of complete measurements.

    Parameters
    ----------
    paths : path or sequence of paths
        Files with one measurement or more each.
    settings : Settings
        Array, call and length of a measurement, such as ``Settings.from_preset("default_25_50")``.
    sensor : str
        Name of the sensor.
    check_kind : bool
        Refuse files whose first bytes are those of another format, such as WAV, FLAC, NumPy or text.

    Returns
    -------
    RawReader
        Iterable of measurements with a length.

    Raises
    ------
    DataError
        A file is missing, empty, has another format, or contains an incomplete measurement.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     recording[0].data.tofile("raw.bin")
    >>> len(ertis.open_raw("raw.bin", recording.settings))
    1
    """
    several = [paths] if isinstance(paths, str | Path) else paths
    return RawReader([Path(path) for path in several], settings, sensor=sensor, check_kind=check_kind)

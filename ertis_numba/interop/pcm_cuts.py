"""Places of the measurements in PCM files: at regular intervals, or at the emissions in a loopback channel."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import DataError
from ertis_numba.base.units import counted
from ertis_numba.interop.pcm_files import PcmFile, per_file
from ertis_numba.interop.sync_channel import find_emissions, louder_and_earlier
from ertis_numba.settings import Call

__all__ = ["Cuts", "cut_at_emissions", "cut_regularly"]

_MAX_DURATION_S: Final = 1e9
_NEARLY: Final = 0.8  # Minimum length of the last measurement of a file, relative to the others.


@dataclass(frozen=True, slots=True)
class Cuts:
    """Measurements of equal length in files."""

    n_samples: int
    samples: list[NDArray[np.int64]]  # (measurement,) first samples, for each file
    times_s: list[NDArray[np.float64]]  # (measurement,) emissions since the start of the file, for each file
    notes: tuple[str, ...]  # assumption about the emission, or where it was found

    def __len__(self) -> int:
        return sum(map(len, self.samples))

    def rest_s(self, files: Sequence[PcmFile]) -> float:
        """Return the total duration after the last measurements of files, in seconds."""
        ends = [int(starts[-1]) + self.n_samples for starts in self.samples]
        return sum((file.n_samples - end) / file.rate_hz for file, end in zip(files, ends, strict=True))


def cut_regularly(files: Sequence[PcmFile], *, skip_s: float, length_s: float | None) -> Cuts:
    """Return one measurement per file, as long as the shortest file, or several of length_s."""
    rate_hz = files[0].rate_hz
    skipped = round(checks.between("skip_s", skip_s, 0.0, _MAX_DURATION_S) * rate_hz)
    # An interval between emissions may contain a fraction of a sample, which must not accumulate.
    period = float(min(file.n_samples for file in files) - skipped)
    if length_s is not None:
        period = _checked_length_s(length_s) * rate_hz
    n_samples = math.floor(period * (1 + 1e-12))
    if length_s is not None and n_samples < 1:
        raise DataError(f"length_s is {length_s:g}, less than a sample at {rate_hz:g} Hz; use a longer length_s")
    counts = [1 if length_s is None else _count(file.n_samples - skipped, period, n_samples) for file in files]
    for file, count in zip(files, counts, strict=True):
        if count < 1 or n_samples < 1:
            raise DataError(
                f"{file.path} lasts {file.duration_s:.4g} s, but {skipped / rate_hz:.4g} s to skip and a measurement "
                f"of {max(n_samples, 1) / rate_hz:.4g} s are needed; use a shorter skip_s"
                + (" or length_s" if length_s is not None else "")
            )
    several = [period * np.arange(count, dtype=np.float64) for count in counts]
    return Cuts(
        n_samples,
        [skipped + np.rint(places).astype(np.int64) for places in several],
        [np.asarray((skipped + places) / rate_hz) for places in several],
        (_assumption(skip_s, length_s),),
    )


def cut_at_emissions(
    files: Sequence[PcmFile], call: Call, *, channel: int, length_s: float | None, sound_speed_m_s: float
) -> Cuts:
    """Return a measurement for each emission, until the next one or for length_s; raise DataError without."""
    rate_hz = files[0].rate_hz
    found = [
        find_emissions(
            functools.partial(file.open().channel, channel),
            file.n_samples,
            call,
            rate_hz=rate_hz,
            path=file.path,
            channel=channel,
        )
        for file in files
    ]
    several = [np.rint(each.times).astype(np.int64) for each in found]
    n_samples = _shortest(files, several)
    if length_s is not None:
        wanted = math.floor(_checked_length_s(length_s) * rate_hz * (1 + 1e-12))
        if wanted > n_samples:
            raise DataError(
                f"{files[0].path}: an emission is followed by the next one or by the end after "
                f"{n_samples / rate_hz:.6g} s, but length_s is {length_s:g}; use a shorter length_s"
            )
        n_samples = wanted
    kept = [starts[starts + n_samples <= file.n_samples] for file, starts in zip(files, several, strict=True)]
    times = [each.times[: len(starts)] for starts, each in zip(kept, found, strict=True)]
    rounding = max(float(np.abs(exact - starts).max()) for exact, starts in zip(times, kept, strict=True))
    cuts = Cuts(n_samples, kept, [exact / rate_hz for exact in times], ())
    summary = (
        f"{counted(len(cuts), 'emission')} found in channel {channel}, which is not imported"
        f"{_intervals(cuts.times_s)}; rounding to samples changes ranges by up to "
        f"{1e3 * rounding / rate_hz * sound_speed_m_s / 2:.2g} mm"
    )
    notes = [(file.path, note) for file, each in zip(files, found, strict=True) for note in each.notes]
    warning = louder_and_earlier(
        files[0].open().channel_or_nan, found[0], call, rate_hz=rate_hz, channel=channel, n_channels=files[0].n_channels
    )
    notes += [(files[0].path, warning)] * bool(warning)
    n_left = sum(map(len, several)) - len(cuts)
    left = [f"emissions left out because their file ends too early: {n_left}"] * bool(n_left)
    return Cuts(cuts.n_samples, cuts.samples, cuts.times_s, (summary, *per_file(notes), *left))


def _checked_length_s(length_s: float) -> float:
    checks.positive("length_s", length_s)
    return checks.between("length_s", length_s, 0.0, _MAX_DURATION_S)


def _count(n_samples: int, period: float, length: int) -> int:
    """Return the number of measurements in a number of samples."""
    if length < 1:
        return 0
    count = int(n_samples / period) + 1
    while count and round((count - 1) * period) + length > n_samples:
        count -= 1
    return count


def _assumption(skip_s: float, length_s: float | None) -> str:
    """Return the note on the assumed times of the emissions."""
    text = f"{skip_s:g} s after the start of each file" if skip_s else "at the first sample of each file"
    if length_s is not None:
        text += f", and then every {length_s:g} s"
    return f"the emission (range 0) is assumed {text}; use skip_s or sync_channel if this is wrong"


def _shortest(files: Sequence[PcmFile], several: Sequence[NDArray[np.int64]]) -> int:
    """Return the smallest number of samples from an emission to the next one, or to the end of its file."""
    intervals = [int(np.diff(starts).min()) for starts in several if len(starts) > 1]
    rests = [(file.n_samples - int(starts[-1]), len(starts)) for file, starts in zip(files, several, strict=True)]
    needed = _NEARLY * min([*intervals, *(rest for rest, count in rests if count == 1)])
    return min([*intervals, *(rest for rest, count in rests if count == 1 or rest >= needed)])


def _intervals(several: Sequence[NDArray[np.float64]]) -> str:
    """Return the intervals between emissions in words."""
    intervals_s = np.concatenate([np.diff(times_s) for times_s in several])
    if not len(intervals_s):
        return ""
    extremes = dict.fromkeys(f"{edge_s:.6g}" for edge_s in (intervals_s.min(), intervals_s.max()))
    return f", {' to '.join(extremes)} s apart"

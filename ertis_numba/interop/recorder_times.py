"""Times at which files of recorders begin: options, metadata or names, and notes about their source."""

import itertools
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.interop.pcm_files import PcmFile, first_stated_times
from ertis_numba.interop.recorder_names import (
    MAX_DIFFERENCE_S,
    NAMES,
    StatedTime,
    day_first,
    has_year_last,
    times_in_names,
)

__all__ = ["file_times"]

_NEGLIGIBLE_S: Final = 1e-3
_UNKNOWN: Final = "set start_ns for the first file, or for each file"


def file_times(
    files: Sequence[PcmFile], starts_ns: Sequence[int], *, first_s: Sequence[float]
) -> tuple[list[int], list[str]]:
    """Return the time of each file's first measurement in ns since 1970, and notes; files are in order of time."""
    # `starts_ns` are given by the user: none, the first, or one per file.
    if len(starts_ns) not in {0, 1, len(files)}:
        raise ArgumentError(
            f"start_ns has {len(starts_ns)} times for {len(files)} files; set the time of the first file, or that of "
            "each file"
        )
    if len(starts_ns) == len(files) and files:
        _require_order(files, starts_ns)
        return _without_overlaps(files, list(starts_ns), 0.0)
    best = first_stated_times(files)
    known = [time for time in best if time is not None]
    firsts_ns = [round(1e9 * each) for each in first_s]
    if not known:
        begins_ns = _back_to_back_ns(files, starts_ns[0] - firsts_ns[0] if starts_ns else 0)
        late_ns = firsts_ns if starts_ns else [each - firsts_ns[0] for each in firsts_ns]
        return [sum(pair) for pair in zip(begins_ns, late_ns, strict=True)], _unknown(files, starts_ns)
    if len(known) < len(best):
        without = files[best.index(None)].path
        with_time = next(file.path for file, time in zip(files, best, strict=True) if time)
        raise DataError(
            f"{without} contains no time in its metadata or name, but {with_time.name} does; set start_ns for each "
            "file, or import the files without times separately"
        )
    times_ns = [time.since_1970_ns for time in known]
    if min(times_ns) < 0:
        earliest = times_ns.index(min(times_ns))
        raise DataError(f"{files[earliest].path} states a time before 1970 ({_stated(known[earliest])}); {_UNKNOWN}")
    _require_order(files, times_ns)
    notes = [
        *_contradictions(files),
        *_unset(files, known),
        *_ambiguous(files, known),
        _source(known, is_relative=bool(starts_ns)),
    ]
    times_ns, overlaps = _without_overlaps(files, times_ns, max(time.resolution_s for time in known))
    shift_ns = starts_ns[0] - firsts_ns[0] - times_ns[0] if starts_ns else 0
    return [sum(pair) + shift_ns for pair in zip(times_ns, firsts_ns, strict=True)], notes + overlaps


def _back_to_back_ns(files: Sequence[PcmFile], start_ns: int) -> list[int]:
    ends_s = np.cumsum([file.duration_s for file in files])
    return [start_ns, *(start_ns + np.rint(1e9 * ends_s[:-1]).astype(np.int64)).tolist()]


def _unknown(files: Sequence[PcmFile], starts_ns: Sequence[int]) -> list[str]:
    """Return the note on files without any time."""
    unread = next((f" in a known order ({file.path.name})" for file in files if has_year_last(file.path.name)), "")
    if len(files) == 1:
        first = f"{files[0].path.name} contains no time{unread and ' in a known order'}, so its time is unknown"
        return [f"{first}; {_UNKNOWN.partition(',')[0]}"]
    relative = ", beginning at start_ns" if starts_ns else ""
    remedy = "set start_ns for each file" if starts_ns else _UNKNOWN
    missing = f"neither metadata nor names contain times{unread}"
    assumption = f"{missing}, so the files are assumed to follow each other without pauses"
    return [f"{assumption}{relative}; {remedy}"]


def _require_order(files: Sequence[PcmFile], times_ns: Sequence[int]) -> None:
    for number, (before_ns, after_ns) in enumerate(itertools.pairwise(times_ns)):
        if after_ns < before_ns:
            raise DataError(
                f"{files[number + 1].path} begins at {_text(after_ns)}, before {files[number].path.name} at "
                f"{_text(before_ns)}; list the files in the order of their times, import their folder, or set "
                "start_ns for each file if a clock was set back"
            )


def _without_overlaps(
    files: Sequence[PcmFile], times_ns: list[int], resolution_s: float
) -> tuple[list[int], list[str]]:
    """Return times without overlaps, and notes; times of a whole second may be up to 1 s too early."""
    found, overlaps, moved_s = list(times_ns), [], [0.0]
    for number in range(1, len(files)):
        end_ns = found[number - 1] + round(1e9 * files[number - 1].duration_s)
        overlap_s = (end_ns - found[number]) / 1e9
        if 0 < overlap_s <= resolution_s:
            found[number] = end_ns
            moved_s.append(overlap_s)
        elif overlap_s > resolution_s:
            overlaps.append((number, overlap_s))
    return found, [*_moved(moved_s, resolution_s, times_ns), *_overlapping(files, overlaps)]


def _moved(moved_s: Sequence[float], resolution_s: float, times_ns: Sequence[int]) -> list[str]:
    """Return the note on files that were stamped at the end of the previous one."""
    if max(moved_s) < _NEGLIGIBLE_S:
        return []
    same = "; use join=True if files with the same time are the microphones of one measurement"
    note = (
        f"times in whole steps of {resolution_s:g} s overlap the previous file by up to {max(moved_s):.3g} s; such "
        f"files begin at the end of the previous one{same if len(set(times_ns)) < len(times_ns) else ''}"
    )
    return [note]


def _overlapping(files: Sequence[PcmFile], overlaps: Sequence[tuple[int, float]]) -> list[str]:
    if not overlaps:
        return []
    number, overlap_s = overlaps[0]
    more = f" (and {len(overlaps) - 1} more)" if len(overlaps) > 1 else ""
    note = (
        f"{files[number].path.name} begins {overlap_s:.3g} s before the end of {files[number - 1].path.name}{more}; "
        "check the times, or import each recorder separately"
    )
    return [note]


def _contradictions(files: Sequence[PcmFile]) -> list[str]:
    """Return a note on the first file whose sources contradict each other."""
    found = []
    for file, name in zip(files, times_in_names([file.path.name for file in files]), strict=True):
        times = [*file.metadata.stated_times, *([name] if name else [])]
        other = next((each for each in times[1:] if not _agree(times[0], each)), None)
        if other is not None:
            found.append((file, other))
    if not found:
        return []
    file, other = found[0]
    first, used = file.metadata.stated_times[0], next(time for time in first_stated_times([file]) if time)
    why = "" if used == first else f", because a clock of {first.clock.year} was not set"
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    note = (
        f"{file.path.name}{more}: {first.source} ({_stated(first)}) and {other.source} ({_stated(other)}) differ; "
        f"that of {used.source} is used{why}"
    )
    return [note]


def _ambiguous(files: Sequence[PcmFile], known: Sequence[StatedTime]) -> list[str]:
    """Return a note on the first name whose six digits are a date in two orders, before the file was written."""
    for file, time in zip(files, known, strict=True):
        other = day_first(file.path.name) if time.source == NAMES else None
        written = datetime.fromtimestamp(file.path.stat().st_mtime, UTC).replace(tzinfo=None) + timedelta(days=1)
        if other is not None and other.date() != time.clock.date() and other < written:
            dates = f"{time.clock:%Y-%m-%d} (year first, as assumed) or {other:%Y-%m-%d} (day first)"
            return [f"{file.path.name}: the date may be {dates}; use start_ns if the day comes first"]
    return []


def _unset(files: Sequence[PcmFile], known: Sequence[StatedTime]) -> list[str]:
    """Return a note on times of a clock that was not set."""
    unset = [(file, time) for file, time in zip(files, known, strict=True) if not time.was_set]
    if not unset:
        return []
    file, time = unset[0]
    problem = f"{file.path.name} begins at {_stated(time)} by {time.source}"
    return [f"{problem}, so the clock of the recorder was probably not set; use start_ns"]


def _agree(one: StatedTime, other: StatedTime) -> bool:
    """Return True if two sources agree; a source without an offset may have the clock of the other, or UTC."""
    if one.offset is not None and other.offset is not None:
        return abs(one.since_1970_ns - other.since_1970_ns) < MAX_DIFFERENCE_S * 1e9
    readings = [{each.clock, each.clock - (each.offset or timedelta())} for each in (one, other)]
    return any(abs((a - b).total_seconds()) < MAX_DIFFERENCE_S for a in readings[0] for b in readings[1])


def _source(known: Sequence[StatedTime], *, is_relative: bool) -> str:
    """Return the note on the source and the zone of the times."""
    sources = " and ".join(dict.fromkeys(time.source for time in known))
    if is_relative:
        return f"the first file begins at start_ns; the times between files are from {sources}"
    span = _text(known[0].since_1970_ns)
    if len(known) > 1:
        span += f" to {_text(known[-1].since_1970_ns)}"
    if all(time.offset is None for time in known):
        return f"times are from {sources} ({span}); they state no offset, so UTC is assumed; otherwise use start_ns"
    offsets = dict.fromkeys("UTC" if time.offset is None else _zone(time.offset) for time in known)
    return f"times are from {sources} ({span}), with the offset {' and '.join(offsets)}"


def _stated(time: StatedTime) -> str:
    return time.clock.isoformat(" ") + ("" if time.offset is None else f" {_zone(time.offset)}")


def _zone(offset: timedelta) -> str:
    if not offset:
        return "UTC"
    minutes = round(offset.total_seconds() / 60)
    return f"UTC{'-' if minutes < 0 else '+'}{abs(minutes) // 60:02}:{abs(minutes) % 60:02}"


def _text(since_1970_ns: int) -> str:
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=since_1970_ns // 1000)
    return f"{time:%Y-%m-%d %H:%M:%S}{f'.{time.microsecond // 1000:03}' if time.microsecond else ''} UTC"

"""Time and time expansion in the metadata of recorders: chunks of WAV files.

References: GUANO 1.0 (https://github.com/riggsd/guano-spec), EBU Tech 3285 (bext), the firmware of AudioMoth (comment),
and the fields of Wildlife Acoustics' wamd.
"""

import math
import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Final

from ertis_numba.interop.recorder_names import MAX_DIFFERENCE_S, StatedTime, times_in_names

__all__ = ["RecorderMetadata", "read_metadata"]

_AUDIOMOTH: Final = re.compile(
    r"(?P<time>\d\d?:\d\d:\d\d(?:\.\d{1,6})?) (?P<day>\d\d)/(?P<month>\d\d)/(?P<year>\d{4}) "
    r"\(UTC(?P<sign>[+-]?)(?P<hours>\d\d?)?(?::?(?P<minutes>\d\d))?\)"
)
_WAMD_TIME, _WAMD_EXPANSION = 0x05, 0x0F
_BEXT_DATE: Final = slice(320, 338)


@dataclass(slots=True)
class RecorderMetadata:
    """Statements of a recorder about a file."""

    stated_times: list[StatedTime] = field(default_factory=list)  # of the first sample, most reliable first
    expansion: float | None = None  # factor by which the header's rate is too low
    rate_hz: float | None = None  # true sample rate
    notes: list[str] = field(default_factory=list)  # statements that cannot be read


def read_metadata(chunks: Mapping[str, bytes], rate_hz: float) -> RecorderMetadata:
    """Return time and time expansion in the chunks of a `ertis_numba.base.wav.WavFile` with a stated rate."""
    found = RecorderMetadata()
    _read_guano(chunks.get("guan", b""), found)
    _read_wamd(chunks.get("wamd", b""), found)
    info = dict(_info(chunks.get("INFO", b"")))
    found.stated_times += _audiomoth(info.get(b"ICMT", ""))
    found.stated_times += _bext(chunks.get("bext", b""), rate_hz)
    found.stated_times += _creation(info.get(b"ICRD", ""))
    return found


def _read_guano(content: bytes, found: RecorderMetadata) -> None:
    lines = content.decode("utf-8", "replace").replace("\0", "\n").splitlines()
    fields = {key.strip(): value.strip() for key, colon, value in (line.partition(":") for line in lines) if colon}
    if time := fields.get("Timestamp"):
        try:
            found.stated_times.append(_stated_time(time, "GUANO"))
        except ValueError:
            found.notes.append(f"GUANO Timestamp {time!r} was ignored, because it is no time")
    elif name := fields.get("Original Filename"):
        found.stated_times += [
            time._replace(source="GUANO's Original Filename") for time in times_in_names([name]) if time
        ]
    found.expansion = _positive("TE", fields, found)
    found.rate_hz = _positive("Samplerate", fields, found)


def _positive(name: str, fields: dict[str, str], found: RecorderMetadata) -> float | None:
    text = fields.get(name)
    if not text:
        return None
    with suppress(ValueError):
        number = float(text)
        if 0 < number < math.inf:
            return number
    found.notes.append(f"GUANO {name} {text!r} was ignored, because it is no positive number")
    return None


def _read_wamd(content: bytes, found: RecorderMetadata) -> None:
    for kind, value in _wamd_fields(content):
        if kind == _WAMD_TIME:
            with suppress(ValueError):
                text = value.decode("ascii", "replace").strip("\0 ")
                found.stated_times.append(_stated_time(text, "Wildlife Acoustics metadata"))
        if kind == _WAMD_EXPANSION and len(value) == 2 and found.expansion is None:
            found.expansion = float(struct.unpack("<H", value)[0]) or None


def _wamd_fields(content: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + 6 <= len(content):
        kind, size = struct.unpack_from("<HI", content, place)
        yield kind, content[place + 6 : place + 6 + size]
        place += 6 + size


def _info(content: bytes) -> Iterator[tuple[bytes, str]]:
    """Yield the texts of a list of information."""
    place = 0
    while place + 8 <= len(content):
        name, size = struct.unpack_from("<4sI", content, place)
        yield name, content[place + 8 : place + 8 + size].split(b"\0")[0].decode("utf-8", "replace")
        place += 8 + size + size % 2


def _audiomoth(comment: str) -> Iterator[StatedTime]:
    match = _AUDIOMOTH.search(comment)
    if match is None:
        return
    with suppress(ValueError):
        clock = datetime.fromisoformat(f"{match['year']}-{match['month']}-{match['day']}T{match['time']:0>8}")
        offset = timedelta(hours=int(match["hours"] or 0), minutes=int(match["minutes"] or 0))
        time = StatedTime.of(clock, "the recorder's comment")
        yield time._replace(offset=-offset if match["sign"] == "-" else offset)


def _bext(content: bytes, rate_hz: float) -> Iterator[StatedTime]:
    """Yield the time of a broadcast extension; a time reference that agrees adds the fraction of a second."""
    text = content[_BEXT_DATE].decode("ascii", "replace")
    parts = re.fullmatch(r"(\d{4})\D(\d\d)\D(\d\d)(\d\d)\D(\d\d)\D(\d\d)", text)
    if parts is None:
        return
    with suppress(ValueError):
        clock = datetime(*map(int, parts.groups()))  # type: ignore[arg-type]  # noqa: DTZ001  six whole numbers
        time = StatedTime.of(clock, "bext metadata")
        if len(content) >= 346:
            midnight = clock.replace(hour=0, minute=0, second=0)
            with suppress(OverflowError):
                exact = midnight + timedelta(seconds=struct.unpack_from("<Q", content, 338)[0] / rate_hz)
                if abs((exact - clock).total_seconds()) < MAX_DIFFERENCE_S:
                    time = time._replace(clock=exact, resolution_s=1e-3)
        yield time


def _creation(text: str) -> Iterator[StatedTime]:
    """Yield the date of creation if it contains a time."""
    with suppress(ValueError):
        yield _stated_time(text, "the date of creation (ICRD)")


def _stated_time(text: str, source: str) -> StatedTime:
    """Return the time that a text states; a date alone is none."""
    if len(text.strip()) <= len("2024-05-18"):
        raise ValueError(text)
    return StatedTime.of(datetime.fromisoformat(text.strip()), source)

"""Faults of microphones as sentences with remedies."""

import re
from collections.abc import Sequence
from typing import Final

from ertis_numba.analysis.health import Finding, Health
from ertis_numba.analysis.health.kinds import DISABLE, kind_of
from ertis_numba.sensor_check.result import CheckFault

__all__ = ["MICROPHONES", "SAMPLES", "channels_in_words", "microphone_faults", "record_faults"]

MICROPHONES: Final = "microphones"
SAMPLES: Final = "samples"

_PREDICATES: Final = {
    "dead": "dead",
    "saturated": "saturated",
    "noisy": "noisy",
    "late": "late",
    "offset": "with an offset",
    "low-frequency hum": "with low-frequency hum",
    "idle tone": "with an idle tone",
    "gain": "of another gain",
    "white bits": "without a microphone (white bits)",
    "flipped bits": "with flipped bits",
    "inverted polarity": "inverted",
    "swapped": "swapped",
    "duplicate": "identical",
}
"""Predicates of faults after ``is`` or ``are``; the names of all other faults are predicates themselves."""

_IN_PAIRS: Final = ("swapped", "duplicate")
_RECORDS: Final = {
    "order of channels": "channels are not in the order of the layout",
    "order of bytes": "the bytes of each sample are swapped",
    "repeated blocks": "blocks of samples are repeated",
    "shifted record": "the record does not begin with the emission",
}
_EVERY_REMEDY: Final = "check the cable and the supply of the array, and record again"
_SATURATED_REMEDY: Final = "emit less, or move the array away from near objects, and record again"


def channels_in_words(channels: Sequence[int]) -> str:
    """Return a text with the channels, such as ``channels 3, 7 and 12``."""
    *first, last = (str(channel) for channel in channels)
    return f"channels {', '.join(first)} and {last}" if first else f"channel {last}"


def microphone_faults(report: Health) -> tuple[CheckFault, ...]:
    """Return the faults of single microphones; microphones with the same faults are one fault."""
    faults = [
        CheckFault(check=MICROPHONES, text=f"{channels_in_words(pair)} are {_PREDICATES[name]}", remedy=remedy)
        for name in _IN_PAIRS
        for pair, remedy in _groups(report.findings, name).items()
    ]
    alike: dict[tuple[str, ...], list[int]] = {}
    for channel in report.channels:
        names = tuple(name for name in channel.faults if name not in _IN_PAIRS)
        if names:
            alike.setdefault(names, []).append(channel.channel)
    for names, channels in alike.items():
        predicate = " and ".join(_PREDICATES.get(name, name) for name in names)
        every = len(channels) == len(report.channels) > 1
        who = "every channel is" if every else f"{channels_in_words(channels)} {'is' if len(channels) == 1 else 'are'}"
        faults.append(
            CheckFault(check=MICROPHONES, text=f"{who} {predicate}", remedy=_remedy(names[0], channels, every=every))
        )
    return tuple(sorted(faults, key=lambda fault: [int(number) for number in re.findall(r"\d+", fault.text)]))


def _groups(findings: Sequence[Finding], name: str) -> dict[tuple[int, ...], str]:
    """Return groups of swapped or identical channels with their remedy; details name the other channels."""
    groups: dict[tuple[int, ...], str] = {}
    for finding in findings:
        if finding.fault == name:
            others = map(int, re.findall(r"\d+", finding.detail))
            groups[tuple(sorted({*finding.channels, *others}))] = finding.remedy
    return groups


def _remedy(name: str, channels: Sequence[int], *, every: bool) -> str:
    if every:
        return _SATURATED_REMEDY if name == "saturated" else _EVERY_REMEDY
    remedy = kind_of(name).remedy
    if remedy == DISABLE:
        return f"exclude {channels_in_words(channels)} (--without {','.join(map(str, channels))})"
    return remedy


def record_faults(report: Health) -> tuple[CheckFault, ...]:
    """Return the faults of the whole record."""
    return tuple(
        CheckFault(
            check=SAMPLES,
            text=f"{_RECORDS.get(finding.fault, finding.fault)}{f' ({finding.detail})' if finding.detail else ''}",
            remedy=finding.remedy,
        )
        for finding in report.record_faults
    )

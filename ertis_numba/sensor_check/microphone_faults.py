"""Faults of microphones as sentences with remedies."""

import re
from collections.abc import Sequence
from typing import Final

from ertis_numba.analysis.health import Finding, Health
from ertis_numba.analysis.health.kinds import DISABLE, kind_of
from ertis_numba.base.units import runs
from ertis_numba.sensor_check.result import CheckFault

__all__ = ["MICROPHONES", "SAMPLES", "channels_in_words", "microphone_faults", "record_faults"]

MICROPHONES: Final = "microphones"
SAMPLES: Final = "samples"

_POSSESSED: Final = {
    "offset": "an offset",
    "low-frequency hum": "low-frequency hum",
    "idle tone": "an idle tone",
    "gain": "a deviating gain",
    "white bits": "white bits, as without a microphone",
    "flipped bits": "flipped bits",
}
"""Faults that a channel has; the names of all other faults are adjectives."""

_ADJECTIVES: Final = {"inverted polarity": "inverted", "duplicate": "identical"}
_IN_PAIRS: Final = ("swapped", "duplicate")
_RECORDS: Final = {
    "misfit of the array": "the order, the positions or the delays of channels are wrong",
    "opposite signs": "channels have opposite signs",
    "order of channels": "channels are not in the order of the layout",
    "size of the array": "the positions of the microphones have another unit",
    "half late": "the channels of two converters are out of step",
    "order of bytes": "the bytes of each sample are swapped",
    "dropout": "the record has dropouts",
    "repeated blocks": "blocks of samples are repeated",
}
_FULL_DBFS: Final = -0.1
_EVERY_REMEDY: Final = "check the cable and the supply of the array, and record again"
_SATURATED_REMEDY: Final = "emit less, or move the array away from near objects, and record again"


def channels_in_words(channels: Sequence[int]) -> str:
    """Return a text with rising channels, such as ``channels 0 to 4, 7 and 12``."""
    parts = [
        [f"{begin} to {end}"] if end > begin + 1 else list(map(str, range(begin, end + 1)))
        for begin, end in runs(channels)
    ]
    *first, last = (each for part in parts for each in part)
    text = f"{', '.join(first)} and {last}" if first else last
    return f"channel{'s' * (len(channels) > 1)} {text}"


def microphone_faults(report: Health) -> tuple[CheckFault, ...]:
    """Return the faults of single microphones; microphones with the same faults are one fault."""
    faults = [
        CheckFault(
            check=MICROPHONES, text=f"{channels_in_words(pair)} are {_ADJECTIVES.get(name, name)}", remedy=remedy
        )
        for name in _IN_PAIRS
        for pair, remedy in _groups(report.findings, name).items()
    ]
    alike: dict[tuple[str, ...], list[int]] = {}
    for channel in report.channels:
        names = tuple(name for name in channel.faults if name not in _IN_PAIRS)
        if names:
            alike.setdefault(names, []).append(channel.channel)
    excluded = sorted({each for names, group in alike.items() if kind_of(names[0]).remedy == DISABLE for each in group})
    for names, channels in alike.items():
        every = len(channels) == len(report.channels) > 1
        who = "every channel" if every else channels_in_words(channels)
        text = f"{who} {_predicate(names, is_one=every or len(channels) == 1)}{_clip_level(report, channels)}"
        faults.append(CheckFault(check=MICROPHONES, text=text, remedy=_remedy(names[0], excluded, every=every)))
    return tuple(sorted(faults, key=lambda fault: [int(number) for number in re.findall(r"\d+", fault.text)]))


def _clip_level(report: Health, channels: Sequence[int]) -> str:
    """Return the lowest level at which some channels are clipped, unless it is full scale."""
    levels = [each.clip_dbfs for each in report.channels if each.channel in channels and each.clip_dbfs is not None]
    lowest_dbfs = min(levels, default=0.0)
    return f" from {lowest_dbfs:.1f} dBFS on" if lowest_dbfs < _FULL_DBFS else ""


def _predicate(names: Sequence[str], *, is_one: bool) -> str:
    """Return a predicate for some faults, such as ``is dead and has an idle tone``."""
    adjectives = [_ADJECTIVES.get(name, name) for name in names if name not in _POSSESSED]
    possessed = [_POSSESSED[name] for name in names if name in _POSSESSED]
    parts = [f"{'is' if is_one else 'are'} {' and '.join(adjectives)}"] if adjectives else []
    parts += [f"{'has' if is_one else 'have'} {' and '.join(possessed)}"] if possessed else []
    return " and ".join(parts)


def _groups(findings: Sequence[Finding], name: str) -> dict[tuple[int, ...], str]:
    """Return groups of swapped or identical channels with their remedy; details name the other channels."""
    groups: dict[tuple[int, ...], str] = {}
    for finding in findings:
        if finding.fault == name:
            others = map(int, re.findall(r"\d+", finding.detail))
            groups[tuple(sorted({*finding.channels, *others}))] = finding.remedy
    return groups


def _remedy(name: str, excluded: Sequence[int], *, every: bool) -> str:
    """Return the remedy of a fault; channels to exclude are those of all faults, for a single option."""
    if every:
        return _SATURATED_REMEDY if name == "saturated" else _EVERY_REMEDY
    remedy = kind_of(name).remedy
    if remedy == DISABLE:
        return f"exclude {channels_in_words(excluded)} (--without {','.join(map(str, excluded))})"
    return remedy


def record_faults(report: Health) -> tuple[CheckFault, ...]:
    """Return the faults of the whole record, except for its shift."""
    return tuple(
        CheckFault(
            check=SAMPLES,
            text=f"{_RECORDS.get(finding.fault, finding.fault)}{f' ({finding.detail})' if finding.detail else ''}",
            remedy=finding.remedy,
        )
        for finding in report.record_faults
        if finding.fault != "shifted record"
    )

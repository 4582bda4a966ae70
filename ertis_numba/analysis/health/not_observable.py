"""Faults that a recording cannot show, so that their absence from a report means nothing."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

__all__ = [
    "KNOWN_PLACE",
    "OF_ARRIVAL",
    "ORDER",
    "SCALE",
    "SEVERAL_ECHOES",
    "SINGLE_ECHO",
    "TURNED",
    "NotObservable",
    "in_all",
    "not_observable_text",
]

ORDER: Final = "order of channels"
SCALE: Final = "scale of the positions"
TURNED: Final = "mirrored or turned positions"
OF_ARRIVAL: Final = ("polarity of channels", ORDER, "delay of channels", SCALE, TURNED, "shift of the record")
"""Faults that only a clear arrival of the call reveals."""
SINGLE_ECHO: Final = "record the single sharp echo of a small reflector 0.5 to 2 m in front of the array"
SEVERAL_ECHOES: Final = "record a small reflector that moves around the array, or compare the settings with the wiring"
KNOWN_PLACE: Final = (
    "place a small reflector at a known position beside the axis, and compare its range and direction with the output "
    "of 'ertis peaks'"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class NotObservable:
    """Names of faults, such as ``order of channels``, that a recording cannot show, a reason, and a remedy."""

    faults: tuple[str, ...]
    reason: str
    remedy: str
    cases: tuple[str, ...] = ()

    def __str__(self) -> str:
        count = f" ({len(self.cases)}, such as {min(self.cases)})" if self.cases else ""
        return f"{', '.join(self.faults)}: {self.reason}{count}; {self.remedy}"


def in_all(reports: Sequence[Sequence[NotObservable]]) -> tuple[NotObservable, ...]:
    """Return the faults that several recordings together cannot show, with the first reason for each."""
    if not reports:
        return ()
    left: dict[str, tuple[str, ...] | None] = {}
    for fault in (fault for item in reports[0] for fault in item.faults):
        found = [next((item for item in items if fault in item.faults), None) for items in reports]
        cases = [item.cases for item in found if item is not None and item.cases]
        common = tuple(case for case in cases[0] if all(case in each for each in cases)) if cases else None
        if None not in found and common != ():
            left[fault] = common
    kept = (replace(item, faults=tuple(fault for fault in item.faults if fault in left)) for item in reports[0])
    return tuple(replace(item, cases=left[item.faults[0]] or item.cases) for item in kept if item.faults)


def not_observable_text(items: Iterable[NotObservable]) -> str:
    """Return a clause that names faults and remedies, for a verdict; empty without faults."""
    items = list(items)
    if not items:
        return ""
    faults = dict.fromkeys(fault for item in items for fault in item.faults)
    remedies = dict.fromkeys(item.remedy for item in items)
    return f"not observable: {', '.join(faults)} ({'; '.join(remedies)})"

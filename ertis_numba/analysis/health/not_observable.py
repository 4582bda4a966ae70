"""Faults that a recording cannot show, so that their absence from a report means nothing."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

__all__ = [
    "KNOWN_PLACE",
    "OF_ARRIVAL",
    "ORDER",
    "SCALE",
    "SINGLE_ECHO",
    "NotObservable",
    "in_all",
    "not_observable_text",
]

ORDER: Final = "order of channels"
SCALE: Final = "scale of the positions"
OF_ARRIVAL: Final = ("polarity of channels", ORDER, "delay of channels", SCALE, "shift of the record")
"""Faults that only a clear arrival of the call reveals."""
SINGLE_ECHO: Final = "record the single sharp echo of a small reflector 0.5 to 2 m in front of the array"
KNOWN_PLACE: Final = (
    "compare the range and direction of a small reflector at a known place beside the axis with 'ertis peaks'"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class NotObservable:
    """Faults that a recording cannot show, for one reason.

    Attributes
    ----------
    faults : tuple of str
        Names of the faults, such as ``order of channels``.
    reason : str
        Clause with the reason.
    remedy : str
        Imperative clause; it names a way to observe the faults.
    """

    faults: tuple[str, ...]
    reason: str
    remedy: str

    def __str__(self) -> str:
        return f"{', '.join(self.faults)}: {self.reason}; {self.remedy}"


def in_all(reports: Sequence[Sequence[NotObservable]]) -> tuple[NotObservable, ...]:
    """Return the faults that none of several recordings can show, with the first reason for each."""
    names = [{fault for item in items for fault in item.faults} for items in reports]
    common = set.intersection(*names) if names else set()
    kept = (
        replace(item, faults=tuple(fault for fault in item.faults if fault in common))
        for items in reports[:1]
        for item in items
    )
    return tuple(item for item in kept if item.faults)


def not_observable_text(items: Iterable[NotObservable]) -> str:
    """Return a clause that names faults and remedies, for a verdict; empty without faults."""
    items = list(items)
    if not items:
        return ""
    faults = dict.fromkeys(fault for item in items for fault in item.faults)
    remedies = dict.fromkeys(item.remedy for item in items)
    return f"not observable: {', '.join(faults)} ({'; '.join(remedies)})"

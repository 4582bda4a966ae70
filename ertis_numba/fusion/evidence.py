"""Evidence of recent pulses that emitters work, computed for one emitter and pulse at a time."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

__all__ = ["PulseEvidence", "best_evidence"]


@dataclass(frozen=True, slots=True, eq=False)
class PulseEvidence:
    """Evidence of one pulse for each of the ``emitters`` that should have sent a call.

    ``proof`` returns how much better the emission of one of them explains the echoes than its silence, if this is
    obvious, and None otherwise. ``comparison`` computes it from an explanation without that emitter, as the reflectors
    of a pulse once more, which takes as long as the points.
    """

    emitters: Collection[int]
    proof: Callable[[int], float | None]
    comparison: Callable[[int], float]
    _compared: dict[int, float] = field(default_factory=dict)

    def known(self, number: int) -> float | None:
        """Return the evidence for an emitter if it is obvious or was computed before, or None."""
        return self._compared.get(number) if (found := self.proof(number)) is None else found

    def better(self, number: int) -> float:
        """Return the evidence for an emitter."""
        found = self.known(number)
        if found is None:
            found = self._compared[number] = self.comparison(number)
        return found


def best_evidence(recent: Sequence[PulseEvidence]) -> dict[int, float]:
    """Return evidence of recent pulses for each emitter of the last one, the highest of all unless it is positive.

    Any positive evidence shows that an emitter works. No more is then computed, and the last pulse is compared first.
    """
    found = {}
    for number in sorted(recent[-1].emitters):
        pulses = [each for each in reversed(recent) if number in each.emitters]
        known = [better for each in pulses if (better := each.known(number)) is not None]
        best = max(known, default=0.0)
        if not best > 0:
            best = pulses[0].better(number)
            for each in pulses[1:]:
                if best > 0:
                    break
                best = max(best, each.better(number))
        found[number] = best
    return found

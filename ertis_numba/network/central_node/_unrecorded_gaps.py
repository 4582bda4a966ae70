"""Gaps not yet written to a recording."""

from collections.abc import Iterable

from ertis_numba.journal import Journal, JournalGap

__all__ = ["UnrecordedGaps"]


class UnrecordedGaps:
    """Gaps of sensors without a measurement in their journal, so that its recording cannot contain them.

    The next recording with a measurement of the sensor contains them. Until then the ledger keeps them, so that the
    reasons for missing numbers are never lost. A gap that is recorded twice, after a crash, is harmless.

    Parameters
    ----------
    gaps : iterable of JournalGap
    """

    def __init__(self, gaps: Iterable[JournalGap]) -> None:
        self._gaps = dict.fromkeys(gaps)

    @property
    def gaps(self) -> list[JournalGap]:
        """All gaps, in order of arrival."""
        return list(self._gaps)

    def learn(self, journal: Journal) -> None:
        """Add the gaps of a journal to seal."""
        gaps = journal.gaps
        if gaps:
            measured = {key.sensor for key in journal.index()}
            self.reported(gap for gap in gaps if gap.sensor in measured)
            self._gaps |= dict.fromkeys(gap for gap in gaps if gap.sensor not in measured)

    def of(self, sensors: Iterable[str]) -> list[JournalGap]:
        """Return the gaps of given sensors."""
        wanted = set(sensors) if self._gaps else set()
        return [gap for gap in self._gaps if gap.sensor in wanted]

    def reported(self, gaps: Iterable[JournalGap]) -> None:
        """Remove gaps that a journal with measurements of their sensor now contains durably."""
        for gap in gaps:
            self._gaps.pop(gap, None)

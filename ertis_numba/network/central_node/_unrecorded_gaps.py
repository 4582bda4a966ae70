"""What is missing, and no recording says so yet."""

from collections.abc import Iterable

from ertis_numba.journal import Journal, JournalGap

__all__ = ["UnrecordedGaps"]


class UnrecordedGaps:
    """Gaps of sensors of which a journal holds no measurement: the recording that is made of it cannot tell of them.

    The next one with a measurement of the sensor does. Until then the ledger has them, so that the reason why
    acknowledged numbers are missing is never lost; one that is told twice, after a crash, does no harm.

    Parameters
    ----------
    gaps : iterable of Gap
    """

    def __init__(self, gaps: Iterable[JournalGap]) -> None:
        self._gaps = dict.fromkeys(gaps)

    @property
    def gaps(self) -> list[JournalGap]:
        """All of them, in the order in which they came."""
        return list(self._gaps)

    def learn(self, journal: Journal) -> None:
        """Take those of a journal that is to be sealed."""
        gaps = journal.gaps
        if gaps:
            measured = {key.sensor for key in journal.index()}
            self.reported(gap for gap in gaps if gap.sensor in measured)
            self._gaps |= dict.fromkeys(gap for gap in gaps if gap.sensor not in measured)

    def of(self, sensors: Iterable[str]) -> list[JournalGap]:
        """Return those of some sensors."""
        wanted = set(sensors) if self._gaps else set()
        return [gap for gap in self._gaps if gap.sensor in wanted]

    def reported(self, gaps: Iterable[JournalGap]) -> None:
        """Forget those that a journal with measurements of their sensor has durably now."""
        for gap in gaps:
            self._gaps.pop(gap, None)

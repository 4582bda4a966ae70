"""Missing sequence numbers."""

from dataclasses import dataclass

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["SequenceGap"]

_MAX_NUMBER = 2**63 - 1
_MAX_REASON_BYTES = 64


@dataclass(frozen=True, slots=True)
class SequenceGap:
    """Missing sequence numbers of a sensor's session, with the reason.

    Attributes
    ----------
    sensor : str
    first, last : int
        First and last missing number.
    reason : str
        Line of at most 64 bytes in UTF-8.
    session_id : int

    Raises
    ------
    ArgumentError
        A number is negative or exceeds 63 bits, ``last`` comes before ``first``, or the reason is not such a line.

    Examples
    --------
    >>> from ertis_numba.frames import SequenceGap
    >>> SequenceGap("front", 10, 12, "the sensor was unplugged", session_id=0).n_missing
    3
    """

    sensor: str
    first: int
    last: int
    reason: str
    session_id: int

    def __post_init__(self) -> None:
        first = checks.integer("first missing sequence number", self.first, 0)
        last = checks.integer("last missing sequence number", self.last, first, _MAX_NUMBER)
        if not self.reason or not self.reason.isprintable() or len(self.reason.encode()) > _MAX_REASON_BYTES:
            raise ArgumentError(f"reason of a gap is {self.reason!r}; use a line of 1 to {_MAX_REASON_BYTES} bytes")
        session_id = checks.integer("session_id", self.session_id, 0, _MAX_NUMBER)
        for name, value in (("first", first), ("last", last), ("session_id", session_id)):
            object.__setattr__(self, name, value)  # NumPy integers become int, which files and messages accept.

    @property
    def n_missing(self) -> int:
        """Number of missing sequence numbers."""
        return self.last - self.first + 1

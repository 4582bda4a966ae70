"""Delays of your own that settings list."""

from typing import Final

from ertis_numba.base.errors import ArgumentError

__all__ = ["MAX_LISTED_DELAYS", "check_delays"]

MAX_LISTED_DELAYS: Final = 20_000
"""Limit on the numbers of a delay matrix in settings."""


def check_delays(given: tuple[tuple[float, ...], ...]) -> None:
    """Refuse lists that are no matrix, and those with too many numbers for settings."""
    lengths = {len(row) for row in given}
    if len(lengths) > 1:
        raise ArgumentError(
            f"processing.delay_matrix has rows of {min(lengths)} to {max(lengths)} numbers; write one number for each "
            "channel in each row"
        )
    if sum(map(len, given)) > MAX_LISTED_DELAYS:
        raise ArgumentError(
            f"processing.delay_matrix lists {len(given)} × {len(given[0])} numbers; the limit is {MAX_LISTED_DELAYS}, "
            "so pass the name of a CSV or NPY file"
        )

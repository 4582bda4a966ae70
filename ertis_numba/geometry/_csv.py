"""Tables of numbers that people write."""

from ertis_numba.errors import ArgumentError

__all__ = ["csv_rows"]


def csv_rows(source: str, text: str) -> list[list[float]]:
    """Return rows of numbers parted by commas; ``source`` names them in errors.

    Raises
    ------
    ArgumentError
        Something is no number.
    """
    rows = (line.split("#", 1)[0].strip() for line in text.splitlines())
    try:
        return [[float(cell) for cell in row.split(",")] for row in rows if row]
    except ValueError as error:
        raise ArgumentError(
            f"{source}: {error}; give rows of numbers parted by commas, and comments after #"
        ) from error

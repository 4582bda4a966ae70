"""Tables of numbers in CSV files."""

from ertis_numba.errors import ArgumentError

__all__ = ["csv_rows"]


def csv_rows(source: str, text: str) -> list[list[float]]:
    """Return rows of comma-separated numbers; ``source`` is their name in errors.

    A row may be empty, and a comment follows #.

    Raises
    ------
    ArgumentError
        A cell is not a number.
    """
    rows = (line.split("#", 1)[0].strip() for line in text.splitlines())
    try:
        return [[float(cell) for cell in row.split(",")] for row in rows if row]
    except ValueError as error:
        raise ArgumentError(
            f"{source}: {error}; give rows of numbers separated by commas, and comments after #"
        ) from error

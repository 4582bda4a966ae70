"""How much a journal may take of a disk, so that it can be sealed there."""

import shutil
from pathlib import Path
from typing import Final

from ertis_numba.errors import DataError
from ertis_numba.journal._database import LOG_BYTES, PAGE_BYTES

__all__ = ["left", "require"]

# What sealing wants to keep free while it writes, its tables, and what others write meanwhile.
_SPARE_BYTES: Final = 12_000_000


def require(path: Path, target: Path, *, held_bytes: int, sizes_bytes: list[int]) -> None:
    """Refuse measurements after which a journal could no longer be sealed.

    A recording needs as much as the words in the journal. So the disk of ``target`` has to have room for all
    words, and a fixed amount to spare; that of the journal for the new ones, first in the log and then in the
    main file, and for what the log may still hold.

    Parameters
    ----------
    path, target : Path
        The journal and the recording to be made of it.
    held_bytes : int
        Words in the journal.
    sizes_bytes : list of int
        Words that are to be added, of each measurement.

    Raises
    ------
    DataError
        There is too little room.
    """
    grows_bytes = sum((size // PAGE_BYTES + 2) * PAGE_BYTES for size in sizes_bytes)
    seals_bytes = held_bytes + sum(sizes_bytes) + _SPARE_BYTES
    for folder, wanted_bytes in _wanted(path, target, 2 * grows_bytes + LOG_BYTES, seals_bytes).items():
        free_bytes = _free(folder)
        if free_bytes < wanted_bytes:
            raise DataError(
                f"{folder} has {free_bytes / 1e6:.1f} MB free, wanted {wanted_bytes / 1e6:.1f} MB so that {path.name}, "
                f"which holds {held_bytes / 1e6:.1f} MB, can be sealed; free some space or capture elsewhere"
            )


def left(path: Path, target: Path, *, held_bytes: int) -> int:
    """Return how many more bytes of words a journal can take, in pieces that are small beside it."""
    wanted = _wanted(path, target, LOG_BYTES, held_bytes + _SPARE_BYTES)
    rooms = [_free(folder) - wanted_bytes for folder, wanted_bytes in wanted.items()]
    return max(0, min(rooms) // (3 - len(rooms)))


def _wanted(path: Path, target: Path, journal_bytes: int, target_bytes: int) -> dict[Path, int]:
    """Return what is wanted in each folder, or in one of them for both if they are on the same disk."""
    folders = path.absolute().parent, target.absolute().parent
    try:
        same = folders[0].stat().st_dev == folders[1].stat().st_dev
    except OSError as error:
        raise DataError(f"{error.filename}: {error.strerror}; make the folder of the recording") from error
    if same:
        return {folders[0]: journal_bytes + target_bytes}
    return dict(zip(folders, (journal_bytes, target_bytes), strict=True))


def _free(folder: Path) -> int:
    return shutil.disk_usage(folder).free

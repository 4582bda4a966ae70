"""How much a journal may take of a disk, so that it can be sealed there."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ertis_numba.atomic_files import RESERVED_BYTES
from ertis_numba.errors import DataError, DiskFullError
from ertis_numba.journal._database import LOG_BYTES, PAGE_BYTES

__all__ = ["left", "recording_bytes", "require"]

_SPARE_BYTES: Final = RESERVED_BYTES + 1_000_000  # what sealing wants to keep free while it writes, and a little more
_SENSOR_BYTES: Final = 150_000  # a recording's tables: 90 kB were measured, and the settings may be longer
_ROW_BYTES: Final = 150  # in these tables
_KEPT_PAGES: Final = 6  # that a commit changes, beside one for each of its measurements


def recording_bytes(words_bytes: int, *, n_rows: int, n_sensors: int) -> int:
    """Return about how long a recording will be."""
    return words_bytes + n_rows * _ROW_BYTES + n_sensors * _SENSOR_BYTES


def require(path: Path, target: Path, *, sizes_bytes: Sequence[int], seals_bytes: int) -> None:
    """Refuse measurements after which a journal could no longer be sealed.

    The disk of ``target`` has to have room for the recording of all that is in the journal, and some to spare;
    that of the journal for what is in the log now, which moves to the main file, and for the new measurements,
    first in the log and then in the main file; or, without a log, for these and the pages that change.

    Parameters
    ----------
    path, target : Path
        The journal and the recording to be made of it.
    sizes_bytes : sequence of int
        Words of each measurement that is to be added.
    seals_bytes : int
        Length of the recording with them.

    Raises
    ------
    NoRoomError
        There is too little room.
    """
    log = path.with_name(f"{path.name}-wal")
    grows_bytes = sum((size // PAGE_BYTES + 2) * PAGE_BYTES for size in sizes_bytes)
    if log.exists():
        journal_bytes = log.stat().st_size + 2 * grows_bytes
    else:
        journal_bytes = grows_bytes + (_KEPT_PAGES + len(sizes_bytes)) * PAGE_BYTES
    for folder, wanted_bytes in _wanted(path, target, journal_bytes, seals_bytes).items():
        free_bytes = shutil.disk_usage(folder).free
        if free_bytes < wanted_bytes:
            raise DiskFullError(
                f"{folder} has {free_bytes / 1e6:.1f} MB free, wanted {wanted_bytes / 1e6:.1f} MB so that {path.name} "
                "can be sealed with more in it; what it holds is safe: end the capture, or free some space"
            )


def left(path: Path, target: Path, *, seals_bytes: int) -> int:
    """Return how many more bytes of words a journal can take, whose recording would be ``seals_bytes`` long by now."""
    wanted = _wanted(path, target, LOG_BYTES, seals_bytes)
    rooms = [shutil.disk_usage(folder).free - wanted_bytes for folder, wanted_bytes in wanted.items()]
    return max(0, min(rooms) // (3 - len(rooms)))  # on one disk, each byte needs room twice


def _wanted(path: Path, target: Path, journal_bytes: int, seals_bytes: int) -> dict[Path, int]:
    """Return what is wanted in each folder, or in one of them for both if they are on the same disk."""
    folders = path.absolute().parent, target.absolute().parent
    target_bytes = seals_bytes + _SPARE_BYTES
    try:
        same = folders[0].stat().st_dev == folders[1].stat().st_dev
    except OSError as error:
        raise DataError(f"{error.filename}: {error.strerror}; make the folder of the recording") from error
    if same:
        return {folders[0]: journal_bytes + target_bytes}
    return dict(zip(folders, (journal_bytes, target_bytes), strict=True))

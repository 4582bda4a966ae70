"""Disk space that a journal may use so that it can still be sealed."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ertis_numba.base.atomic_files import RESERVED_BYTES
from ertis_numba.base.errors import DataError, DiskFullError
from ertis_numba.journal._database import LOG_BYTES, PAGE_BYTES

__all__ = ["appendable_bytes", "recording_bytes", "require_free_space"]

_SPARE_BYTES: Final = RESERVED_BYTES + 1_000_000  # Slightly more than sealing keeps free while it writes.
_SENSOR_BYTES: Final = 150_000  # Tables of a recording: 90 kB were measured, and settings may be longer.
_ROW_BYTES: Final = 150  # Bytes per row in these tables.
_POSE_BYTES: Final = 344  # Position, quaternion and covariance of a row.
_COMMIT_PAGES: Final = 6  # Pages that a commit changes, in addition to one for each measurement.


def recording_bytes(words_bytes: int, *, n_rows: int, n_sensors: int, has_poses: bool) -> int:
    """Return the approximate size of a recording in bytes."""
    row_bytes = _ROW_BYTES + _POSE_BYTES if has_poses else _ROW_BYTES
    return words_bytes + n_rows * row_bytes + n_sensors * _SENSOR_BYTES


def require_free_space(path: Path, target: Path, *, sizes_bytes: Sequence[int], seals_bytes: int) -> None:
    """Refuse measurements or poses of given sizes after which a journal could not be sealed any more."""
    # The disk of `target` needs `seals_bytes` and a reserve, that of the journal the new content and changed pages.
    log = path.with_name(f"{path.name}-wal")
    grows_bytes = sum((size // PAGE_BYTES + 2) * PAGE_BYTES for size in sizes_bytes)
    if log.exists():
        journal_bytes = log.stat().st_size + 2 * grows_bytes
    else:
        journal_bytes = grows_bytes + (_COMMIT_PAGES + len(sizes_bytes)) * PAGE_BYTES
    for folder, wanted_bytes in _required_bytes(path, target, journal_bytes, seals_bytes).items():
        free_bytes = shutil.disk_usage(folder).free
        if free_bytes < wanted_bytes:
            raise DiskFullError(
                f"{folder} has {free_bytes / 1e6:.1f} MB free, but {wanted_bytes / 1e6:.1f} MB are needed to "
                f"seal {path.name} with more in it; its content is safe: end the capture, or free some space"
            )


def appendable_bytes(path: Path, target: Path, *, seals_bytes: int) -> int:
    """Return the remaining capacity of a journal in bytes, given the current size of its recording."""
    wanted = _required_bytes(path, target, LOG_BYTES, seals_bytes)
    rooms = [shutil.disk_usage(folder).free - wanted_bytes for folder, wanted_bytes in wanted.items()]
    return max(0, min(rooms) // (3 - len(rooms)))  # On one disk, each byte needs space twice.


def _required_bytes(path: Path, target: Path, journal_bytes: int, seals_bytes: int) -> dict[Path, int]:
    """Return the space needed in each folder, or in one of them for both if they are on the same disk."""
    folders = path.absolute().parent, target.absolute().parent
    target_bytes = seals_bytes + _SPARE_BYTES
    try:
        same = folders[0].stat().st_dev == folders[1].stat().st_dev
    except OSError as error:
        raise DataError(f"{error.filename}: {error.strerror}; create the folder of the recording") from error
    if same:
        return {folders[0]: journal_bytes + target_bytes}
    return dict(zip(folders, (journal_bytes, target_bytes), strict=True))

"""Limit of a journal that has failed: the numbers up to which its measurements were acknowledged.

After a failed sync, the system may show rows that never reach the disk. The central node stores them again in another
journal. The limit, a small file beside the failed journal, excludes them from it, so that none is stored twice.
"""

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from ertis_numba.base.atomic_files import atomic_write
from ertis_numba.base.errors import DamagedError, DataError

__all__ = ["LIMIT", "read_limit", "write_limit"]

LIMIT: Final = "-limit"
"""Suffix of the file, after the name of the journal."""


def write_limit(path: Path, acked: Mapping[tuple[str, int], int]) -> None:
    """Write durably the highest acknowledged number by (sensor, session_id); other sessions have none."""
    runs: list[list[str | int]] = [[sensor, session_id, last] for (sensor, session_id), last in acked.items()]
    text = json.dumps({"runs": runs, "crc32": _check(runs)})
    with atomic_write(_limit_path(path), overwrite=True, token="new") as part:  # noqa: S106  the folder has one writer
        part.write_text(text, "utf-8")


def read_limit(path: Path) -> dict[tuple[str, int], int] | None:
    """Return the limit of a journal; None if it has none."""
    place = _limit_path(path)
    try:
        content = json.loads(place.read_bytes())
        runs = content["runs"]
        limit = {(sensor, session_id): last for sensor, session_id, last in runs}
        is_sound = content["crc32"] == _check(runs)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DataError(f"{place}: {error.strerror}; make it readable") from error
    except (ValueError, KeyError, TypeError):
        is_sound = False
    if not is_sound:
        raise DamagedError(
            f"{place} is damaged; remove it to seal all rows in {path.name}, although another recording may "
            "contain some of them"
        )
    return limit


def _check(runs: list[list[str | int]]) -> int:
    return zlib.crc32(json.dumps(runs).encode())


def _limit_path(path: Path) -> Path:
    return path.with_name(f"{path.name}{LIMIT}")

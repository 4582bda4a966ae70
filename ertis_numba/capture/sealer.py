"""Sealing in a process of its own: HDF5 that meets a full disk takes its process with it."""

import subprocess
import sys
from pathlib import Path

from ertis_numba.errors import DataError

__all__ = ["seal_apart"]


def seal_apart(journal: Path, *, overwrite: bool) -> Path:
    """Make the recording of a journal and return its path; see `ertis_numba.storage.sealing`.

    Ctrl-C does not reach the process that does it.

    Raises
    ------
    DataError
        It failed; the journal is still there.
    """
    command = [sys.executable, "-m", "ertis_numba.storage.sealing", str(journal), *(["--force"] if overwrite else [])]
    done = subprocess.run(  # noqa: S603  this very package
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, start_new_session=True
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        reason = lines[-1] if lines else f"the process that seals it ended with {done.returncode}"
        raise DataError(f"{reason}; the measurements are safe in {journal}, seal them by 'ertis recover {journal}'")
    return Path(done.stdout.strip())

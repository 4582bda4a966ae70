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
    # -P: a file in the current folder that is named like one of Python's must not be taken for it.
    command = [sys.executable, "-P", "-m", "ertis_numba.storage.sealing", str(journal)]
    done = subprocess.run(  # noqa: S603  this very package
        [*command, *(["--force"] if overwrite else [])],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        reason = lines[-1] if lines else f"the process that seals it ended with {done.returncode}"
        if not journal.exists():  # there was nothing in it
            raise DataError(reason)
        raise DataError(f"{reason}; the measurements are safe in {journal}, seal them by 'ertis recover {journal}'")
    return Path(done.stdout.strip())

"""Print the sessions of all sensors in recordings, with their highest numbers, as JSON.

It runs as a separate process for programs that must not load HDF5.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from ertis_numba.errors import DataError
from ertis_numba.storage._reader import file_kind, sensor_names
from ertis_numba.storage.recording import open_recording

__all__ = ["main", "sessions_of"]


def sessions_of(path: Path) -> list[tuple[str, int, int]]:
    """Return the sessions in a recording: sensor, session_id, and the highest stored or missing number."""
    found: list[tuple[str, int, int]] = []
    for sensor in sensor_names(path):
        with open_recording(path, sensor=sensor) as reader:
            numbers = [(gap.session_id, gap.last) for gap in reader.gaps]
            numbers += [(stamp.session_id, stamp.sequence) for stamp in reader.stamps()]
        last: dict[int, int] = {}
        for session_id, number in numbers:
            last[session_id] = max(number, last.get(session_id, -1))
        found += [(sensor, session_id, number) for session_id, number in last.items()]
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print ``[[sensor, session_id, last], …]`` of all recordings given, and return an exit code.

    Files that are not recordings are skipped; an unreadable recording is an error, printed in one line on stderr.
    """
    parser = argparse.ArgumentParser("python -m ertis_numba.storage.sessions_process", description=__doc__)
    parser.add_argument("recordings", type=Path, nargs="*")
    try:
        found = [
            run
            for path in parser.parse_args(arguments).recordings
            if file_kind(path) == "recording"
            for run in sessions_of(path)
        ]
    except (DataError, OSError) as error:
        sys.stderr.write(f"{' '.join(str(error).split())}\n")
        return 1
    sys.stdout.write(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())

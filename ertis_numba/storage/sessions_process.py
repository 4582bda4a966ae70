"""Process that reads the sessions in recordings, for programs that must not load HDF5."""

from pathlib import Path

from ertis_numba.base.errors import DataError
from ertis_numba.journal.storage_processes import FoundSessions, ReadSessions, StorageFailed
from ertis_numba.processes import connect
from ertis_numba.storage._reader import file_kind, sensor_names
from ertis_numba.storage.recording import open_recording

__all__ = ["sessions_of"]


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


def _main() -> None:
    """Reply to the parent, skipping files that are not recordings."""
    pipe = connect(ReadSessions)
    for request in pipe.messages():
        try:
            found = [run for path in request.recordings if file_kind(path) == "recording" for run in sessions_of(path)]
        except (DataError, OSError) as error:
            pipe.send(StorageFailed(" ".join(str(error).split())))
        else:
            pipe.send(FoundSessions(found))


if __name__ == "__main__":
    _main()

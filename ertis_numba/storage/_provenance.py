"""Content that results of processing repeat from their recording."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import mounting
from ertis_numba.storage.recording_reader import RecordingReader

__all__ = ["provenance", "recorded_mountings"]


def provenance(readers: Sequence[RecordingReader]) -> dict[str, str]:
    """Return the attributes of a file that describe its recording."""
    if not readers:
        return {"source": "", "history": ""}
    first = readers[0]
    for reader in readers:
        if reader.uuid != first.uuid:
            raise ArgumentError(f"{reader.path} is not the same recording as {first.path}; write one file for each")
    return {
        "source": first.path.name,
        "history": f"processed from recording {first.uuid}",
        "recording_uuid": first.uuid,
        "recording_sha256": first.sha256(),
    }


def recorded_mountings(readers: Sequence[RecordingReader]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return the known mountings by name of the sensor, in the form of `ertis_numba.geometry.mounting`."""
    return {
        reader.sensor: mounting(reader.sensor, reader.translation_m.tolist(), reader.rotation_xyzw.tolist())
        for reader in readers
        if reader.translation_m is not None and reader.rotation_xyzw is not None
    }

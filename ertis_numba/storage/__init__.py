"""Files: recordings and energyscapes. The only door to h5py."""

from ertis_numba.atomic import check_target, replacing
from ertis_numba.storage._reader import file_kind, sensor_names
from ertis_numba.storage.energyscape import (
    EnergyscapeReader,
    EnergyscapeWriter,
    open_energyscapes,
    write_energyscapes,
)
from ertis_numba.storage.recording import (
    Gap,
    RecordingReader,
    RecordingWriter,
    open_recording,
    write_recording,
)
from ertis_numba.storage.truth import Truth, TruthLog

__all__ = [
    "EnergyscapeReader",
    "EnergyscapeWriter",
    "Gap",
    "RecordingReader",
    "RecordingWriter",
    "Truth",
    "TruthLog",
    "check_target",
    "file_kind",
    "open_energyscapes",
    "open_recording",
    "replacing",
    "sensor_names",
    "write_energyscapes",
    "write_recording",
]

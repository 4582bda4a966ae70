"""Files of recordings, energyscapes, acoustic and occupancy maps; the only package that imports h5py."""

from ertis_numba.base.atomic_files import atomic_write, check_target
from ertis_numba.storage._reader import file_kind, sensor_names
from ertis_numba.storage.acoustic_maps import (
    AcousticMapReader,
    AcousticMapWriter,
    open_acoustic_maps,
    write_acoustic_maps,
)
from ertis_numba.storage.energyscape import (
    EnergyscapeReader,
    EnergyscapeWriter,
    open_energyscapes,
    write_energyscapes,
)
from ertis_numba.storage.maps import is_map, read_map, read_map_truth, write_map_file
from ertis_numba.storage.poses import add_poses, platform_trajectory, recorded_trajectory, require_fitting_poses
from ertis_numba.storage.recording import RecordingReader, RecordingWriter, open_recording, write_recording
from ertis_numba.storage.truth import GroundTruth, GroundTruthLog

__all__ = [
    "AcousticMapReader",
    "AcousticMapWriter",
    "EnergyscapeReader",
    "EnergyscapeWriter",
    "GroundTruth",
    "GroundTruthLog",
    "RecordingReader",
    "RecordingWriter",
    "add_poses",
    "atomic_write",
    "check_target",
    "file_kind",
    "is_map",
    "open_acoustic_maps",
    "open_energyscapes",
    "open_recording",
    "platform_trajectory",
    "read_map",
    "read_map_truth",
    "recorded_trajectory",
    "require_fitting_poses",
    "sensor_names",
    "write_acoustic_maps",
    "write_energyscapes",
    "write_map_file",
    "write_recording",
]

"""Data that flow through the system, such as measurements, signals, beams, energyscapes and point clouds."""

from ertis_numba.frames._acoustic_map import AcousticMap, SoundDirection
from ertis_numba.frames._beams import Beams
from ertis_numba.frames._bearings import Bearing, doubt_notes
from ertis_numba.frames._energyscape import Energyscape
from ertis_numba.frames._gap import SequenceGap
from ertis_numba.frames._level_reference import (
    LEVEL_UNITS,
    LevelReference,
    LevelUnit,
    known_levels,
    level_offset_db,
)
from ertis_numba.frames._measurement import Measurement, MicrophoneSignals
from ertis_numba.frames._occupancy_map import FREE_BELOW, MAX_CELLS, OCCUPIED_ABOVE, OccupancyMap
from ertis_numba.frames._point_cloud import PointCloud
from ertis_numba.frames._reflectors import Peak, Reflector
from ertis_numba.frames._sound_event import SoundEvent, TrueSource
from ertis_numba.frames._stamp import BEHAVIOURS, Behaviour, Stamp, is_passive
from ertis_numba.frames._surfaces import Surfaces
from ertis_numba.frames._trajectory import PoseAxes, Trajectory

__all__ = [
    "BEHAVIOURS",
    "FREE_BELOW",
    "LEVEL_UNITS",
    "MAX_CELLS",
    "OCCUPIED_ABOVE",
    "AcousticMap",
    "Beams",
    "Bearing",
    "Behaviour",
    "Energyscape",
    "LevelReference",
    "LevelUnit",
    "Measurement",
    "MicrophoneSignals",
    "OccupancyMap",
    "Peak",
    "PointCloud",
    "PoseAxes",
    "Reflector",
    "SequenceGap",
    "SoundDirection",
    "SoundEvent",
    "Stamp",
    "Surfaces",
    "Trajectory",
    "TrueSource",
    "doubt_notes",
    "is_passive",
    "known_levels",
    "level_offset_db",
]

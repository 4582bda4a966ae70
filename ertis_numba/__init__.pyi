# Public names, declared once: __init__.py imports each of them at its first use.

from .analysis.cfar import cfar_peaks as cfar_peaks
from .analysis.compare import compare as compare
from .analysis.detect import find_peaks as find_peaks
from .analysis.health import health as health
from .analysis.points import PointExtractor as PointExtractor
from .base.errors import (
    ArgumentError as ArgumentError,
    CallMismatchWarning as CallMismatchWarning,
    CoarseGridWarning as CoarseGridWarning,
    DamagedError as DamagedError,
    DataError as DataError,
    DeviceError as DeviceError,
    DiskFullError as DiskFullError,
    ErrorBudgetWarning as ErrorBudgetWarning,
    ErtisError as ErtisError,
    ForeignDataError as ForeignDataError,
    FormatVersionError as FormatVersionError,
    JournalInUseError as JournalInUseError,
    LayoutMismatchWarning as LayoutMismatchWarning,
    LayoutUnitWarning as LayoutUnitWarning,
    NetworkError as NetworkError,
    OutsideBandsWarning as OutsideBandsWarning,
    PoseWarning as PoseWarning,
    RefusedError as RefusedError,
    SettingsError as SettingsError,
    SonarDisconnectedError as SonarDisconnectedError,
    SonarError as SonarError,
    StartMismatchWarning as StartMismatchWarning,
)
from .calibration import Calibration as Calibration, calibrate as calibrate
from .devices.driver import SonarDriver as SonarDriver
from .devices.emulator import Emulator as Emulator
from .devices.setup import Setup as Setup
from .figures import plot as plot
from .frames import (
    AcousticMap as AcousticMap,
    Beams as Beams,
    Bearing as Bearing,
    Energyscape as Energyscape,
    Measurement as Measurement,
    MicrophoneSignals as MicrophoneSignals,
    OccupancyMap as OccupancyMap,
    Peak as Peak,
    PointCloud as PointCloud,
    Reflector as Reflector,
    SoundEvent as SoundEvent,
    Stamp as Stamp,
    Trajectory as Trajectory,
)
from .fusion import Fused as Fused, Fuser as Fuser, fuse as fuse
from .geometry import layout_names as layout_names, load_layout as load_layout
from .interop import (
    Drive as Drive,
    export as export,
    open_pcm as open_pcm,
    open_raw as open_raw,
    open_rtis_folder as open_rtis_folder,
    read_trajectory as read_trajectory,
    write_map as write_map,
    write_tum as write_tum,
)
from .journal import JournalEntry as JournalEntry
from .mapping import Mapper as Mapper
from .motion import (
    EgoVelocity as EgoVelocity,
    Odometry as Odometry,
    PlanarPose as PlanarPose,
    compensate_motion as compensate_motion,
    ego_velocity as ego_velocity,
)
from .network.allow_list import AllowList as AllowList, Permission as Permission
from .network.central_client import CentralClient as CentralClient
from .network.keys import ClientKeys as ClientKeys, KeyPair as KeyPair, ServerKeys as ServerKeys
from .network.sensor_node import SensorNode as SensorNode
from .network.subscriber import Subscriber as Subscriber
from .passive import (
    AcousticCamera as AcousticCamera,
    BeamSound as BeamSound,
    BearingFinder as BearingFinder,
    BearingTracker as BearingTracker,
    find_bearings as find_bearings,
    find_sound_sources as find_sound_sources,
    heterodyned as heterodyned,
    listen_to as listen_to,
    time_differences as time_differences,
    time_expanded as time_expanded,
)
from .pipeline import Pipeline as Pipeline
from .pipeline.arrays import beamform as beamform, demodulate as demodulate, matched_filter as matched_filter
from .settings import Call as Call, Settings as Settings, presets as presets
from .simulation.render import Simulator as Simulator, render as render
from .simulation.scene import Scene as Scene, load_scene as load_scene
from .storage import (
    add_poses as add_poses,
    open_acoustic_maps as open_acoustic_maps,
    open_energyscapes as open_energyscapes,
    open_recording as open_recording,
    read_map as read_map,
    write_acoustic_maps as write_acoustic_maps,
    write_energyscapes as write_energyscapes,
    write_recording as write_recording,
)
from .viewer import view as view

__version__: str

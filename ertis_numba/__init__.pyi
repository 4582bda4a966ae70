# Public names, declared once: __init__.py imports each of them at its first use.

from .analysis.cfar import cfar_peaks as cfar_peaks
from .analysis.compare import compare as compare
from .analysis.detect import find_peaks as find_peaks
from .analysis.health import health as health
from .analysis.points import PointExtractor as PointExtractor
from .arrays import beamform as beamform
from .arrays import demodulate as demodulate
from .arrays import matched_filter as matched_filter
from .devices.emulator import Emulator as Emulator
from .devices.setup import Setup as Setup
from .devices.sonar import SonarDriver as SonarDriver
from .errors import (
    ArgumentError as ArgumentError,
)
from .errors import (
    CallMismatchWarning as CallMismatchWarning,
)
from .errors import (
    DamagedError as DamagedError,
)
from .errors import (
    DataError as DataError,
)
from .errors import (
    DeviceError as DeviceError,
)
from .errors import (
    DiskFullError as DiskFullError,
)
from .errors import (
    ErrorBudgetWarning as ErrorBudgetWarning,
)
from .errors import (
    ErtisError as ErtisError,
)
from .errors import (
    ForeignDataError as ForeignDataError,
)
from .errors import (
    FormatVersionError as FormatVersionError,
)
from .errors import (
    JournalInUseError as JournalInUseError,
)
from .errors import (
    NetworkError as NetworkError,
)
from .errors import (
    RefusedError as RefusedError,
)
from .errors import (
    SettingsError as SettingsError,
)
from .errors import (
    SonarDisconnectedError as SonarDisconnectedError,
)
from .errors import (
    SonarError as SonarError,
)
from .figures import plot as plot
from .figures import plot_page as plot_page
from .frames import (
    Energyscape as Energyscape,
)
from .frames import (
    Measurement as Measurement,
)
from .frames import (
    MicrophoneSignals as MicrophoneSignals,
)
from .frames import (
    Peak as Peak,
)
from .frames import (
    PointCloud as PointCloud,
)
from .frames import (
    Reflector as Reflector,
)
from .frames import (
    Stamp as Stamp,
)
from .geometry import load_layout as load_layout
from .interop import export as export
from .interop import open_pcm as open_pcm
from .interop import open_raw as open_raw
from .interop import open_rtis_folder as open_rtis_folder
from .journal import JournalEntry as JournalEntry
from .network.allow_list import AllowList as AllowList
from .network.allow_list import Permission as Permission
from .network.keys import ClientKeys as ClientKeys
from .network.keys import KeyPair as KeyPair
from .network.keys import ServerKeys as ServerKeys
from .network.sensor_node import SensorNode as SensorNode
from .network.subscriber import Subscriber as Subscriber
from .pipeline import Pipeline as Pipeline
from .settings import Settings as Settings
from .simulation.render import Simulator as Simulator
from .simulation.render import render as render
from .simulation.scene import Scene as Scene
from .simulation.scene import load_scene as load_scene
from .storage import (
    open_energyscapes as open_energyscapes,
)
from .storage import (
    open_recording as open_recording,
)
from .storage import (
    write_energyscapes as write_energyscapes,
)
from .storage import (
    write_recording as write_recording,
)

__version__: str

"""Imaging sonar in air: from one-bit microphone data to energyscapes and reflectors.

These examples use the files that ``ertis example reflectors corridor`` copies::

    import ertis_numba as ertis

    recording = ertis.open_recording("reflectors.h5")
    pipeline = ertis.Pipeline(recording.settings)
    image = pipeline.process(recording[0])
    peaks = ertis.find_peaks(image, top=5)
    ertis.plot(image, peaks=peaks).savefig("image.png")

Simulate a scene and compare the image with its ground truth::

    simulator = ertis.Simulator(ertis.load_scene("corridor.toml"))
    image = ertis.Pipeline(simulator.sensor.settings()).process(simulator.render(0))
    comparison = ertis.compare(image, simulator.reflectors(0))

Names are imported when they are first used: ``import ertis_numba`` loads neither NumPy, Numba nor SciPy.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ertis_numba.analysis.cfar import cfar_peaks
    from ertis_numba.analysis.compare import compare
    from ertis_numba.analysis.detect import find_peaks
    from ertis_numba.analysis.health import health
    from ertis_numba.analysis.points import PointExtractor
    from ertis_numba.arrays import beamform, demodulate, matched_filter
    from ertis_numba.devices.emulator import Emulator
    from ertis_numba.devices.setup import Setup
    from ertis_numba.devices.sonar import SonarDriver
    from ertis_numba.errors import (
        ArgumentError,
        CallMismatchWarning,
        DamagedError,
        DataError,
        DeviceError,
        DiskFullError,
        ErrorBudgetWarning,
        ErtisError,
        ForeignDataError,
        FormatVersionError,
        JournalInUseError,
        NetworkError,
        RefusedError,
        SettingsError,
        SonarDisconnectedError,
        SonarError,
    )
    from ertis_numba.figures import plot
    from ertis_numba.frames import Energyscape, Measurement, MicrophoneSignals, Peak, PointCloud, Reflector, Stamp
    from ertis_numba.geometry import load_layout
    from ertis_numba.interop import export, open_pcm, open_raw, open_rtis_folder
    from ertis_numba.journal import JournalEntry
    from ertis_numba.network.allow_list import AllowList, Permission
    from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
    from ertis_numba.network.sensor_node import SensorNode
    from ertis_numba.network.subscriber import Subscriber
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import Settings
    from ertis_numba.simulation.render import Simulator, render
    from ertis_numba.simulation.scene import Scene, load_scene
    from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording

    __version__: str

__all__ = [
    "AllowList",
    "ArgumentError",
    "CallMismatchWarning",
    "ClientKeys",
    "DamagedError",
    "DataError",
    "DeviceError",
    "DiskFullError",
    "Emulator",
    "Energyscape",
    "ErrorBudgetWarning",
    "ErtisError",
    "ForeignDataError",
    "FormatVersionError",
    "JournalEntry",
    "JournalInUseError",
    "KeyPair",
    "Measurement",
    "MicrophoneSignals",
    "NetworkError",
    "Peak",
    "Permission",
    "Pipeline",
    "PointCloud",
    "PointExtractor",
    "Reflector",
    "RefusedError",
    "Scene",
    "SensorNode",
    "ServerKeys",
    "Settings",
    "SettingsError",
    "Setup",
    "Simulator",
    "SonarDisconnectedError",
    "SonarDriver",
    "SonarError",
    "Stamp",
    "Subscriber",
    "beamform",
    "cfar_peaks",
    "compare",
    "demodulate",
    "export",
    "find_peaks",
    "health",
    "load_layout",
    "load_scene",
    "matched_filter",
    "open_energyscapes",
    "open_pcm",
    "open_raw",
    "open_recording",
    "open_rtis_folder",
    "plot",
    "render",
    "write_energyscapes",
    "write_recording",
]

_HOMES = {
    "arrays": ("beamform", "demodulate", "matched_filter"),
    "devices.emulator": ("Emulator",),
    "devices.setup": ("Setup",),
    "devices.sonar": ("SonarDriver",),
    "errors": (
        "ArgumentError",
        "CallMismatchWarning",
        "DamagedError",
        "DataError",
        "DeviceError",
        "ErrorBudgetWarning",
        "ErtisError",
        "ForeignDataError",
        "FormatVersionError",
        "JournalInUseError",
        "NetworkError",
        "DiskFullError",
        "RefusedError",
        "SettingsError",
        "SonarError",
        "SonarDisconnectedError",
    ),
    "figures": ("plot",),
    "frames": ("Energyscape", "Measurement", "MicrophoneSignals", "Peak", "PointCloud", "Reflector", "Stamp"),
    "geometry": ("load_layout",),
    "interop": ("export", "open_pcm", "open_raw", "open_rtis_folder"),
    "journal": ("JournalEntry",),
    "network.allow_list": ("AllowList", "Permission"),
    "network.keys": ("ClientKeys", "KeyPair", "ServerKeys"),
    "network.sensor_node": ("SensorNode",),
    "network.subscriber": ("Subscriber",),
    "pipeline": ("Pipeline",),
    "settings": ("Settings",),
    "simulation.render": ("Simulator", "render"),
    "simulation.scene": ("Scene", "load_scene"),
    "analysis.cfar": ("cfar_peaks",),
    "analysis.compare": ("compare",),
    "analysis.detect": ("find_peaks",),
    "analysis.health": ("health",),
    "analysis.points": ("PointExtractor",),
    "storage": ("open_energyscapes", "open_recording", "write_energyscapes", "write_recording"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        value: Any = _version()
    elif name in _HOME_OF:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})


def _version() -> str:
    from importlib import metadata  # noqa: PLC0415  takes longer to import than the rest of this file

    try:
        return metadata.version("ertis-numba")
    except metadata.PackageNotFoundError:  # the package runs from its source without being installed
        return "unknown"

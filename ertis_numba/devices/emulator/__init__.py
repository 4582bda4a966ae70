"""Emulated sensors on pseudo terminals, with a SYNC line and with faults, for tests and ``ertis sensors emulate``."""

from ertis_numba.devices.emulator.device import Emulator
from ertis_numba.devices.emulator.mainboard import Quirks
from ertis_numba.devices.emulator.registers import DeviceConfig
from ertis_numba.devices.emulator.sync_chain import SyncChain

__all__ = ["DeviceConfig", "Emulator", "Quirks", "SyncChain"]

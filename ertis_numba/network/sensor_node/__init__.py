"""Sensor node: keeps measurements until the central node has acknowledged them."""

from ertis_numba.network.sensor_node._link import Central
from ertis_numba.network.sensor_node._memory_spool import SensorCounts
from ertis_numba.network.sensor_node._node import SensorNode
from ertis_numba.network.sensor_node._settings_requests import SettingsRequest
from ertis_numba.network.sensor_node._wire import Acknowledged

__all__ = ["Acknowledged", "Central", "SensorCounts", "SensorNode", "SettingsRequest"]

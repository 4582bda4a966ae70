"""Sensors: the wire protocol, the driver, and devices that are emulated. The only door to pyserial."""

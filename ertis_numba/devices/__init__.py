"""Sensors: wire protocol, driver, and emulated devices; the only package that imports pyserial."""

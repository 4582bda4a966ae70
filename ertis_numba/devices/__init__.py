"""Sensors: wire protocol, driver, and emulated devices; the only package that imports pyserial.

Importing this package loads none of its modules.
"""

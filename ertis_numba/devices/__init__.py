"""Sensors: the wire protocol, the driver, and devices that are emulated. The only door to pyserial.

=========== ===================================================================================
module      what it has
=========== ===================================================================================
sonar       `Sonar`, the driver
setup       `Setup`, what a sensor is told; `call_codes` and `call_hash` of its call
ports       `find_ports`, `resolve`, `Port`
survey      `survey`, which asks all ports at once
bits        `BitCheck`, whether words can be what microphones sent
commands    `Command` and its answers
blocks      `Block`, `Instant`, `encode_block`
protocol    `Receiver`, blocks out of bytes
emulator    `Emulator`, `Quirks`, `SyncChain`; `emulator.faults` has `Faults`
=========== ===================================================================================

Importing this package loads none of them.
"""

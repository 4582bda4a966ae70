"""Sensors: wire protocol, driver, and emulated devices; the only package that imports pyserial.

=========== =================================================================================== module      contents
=========== =================================================================================== sonar
`SonarDriver`, the driver setup       `Setup`, the configuration of a sensor; `call_codes` and `call_hash` of its call
ports       `find_ports`, `resolve`, `Port` survey      `survey`, which probes all ports at once bits        `BitCheck`,
which detects samples that microphones cannot have sent commands    `Command` and its answers blocks      `Block`,
`Instant`, `encode_block` protocol    `BlockReceiver`, which extracts blocks from bytes emulator    `Emulator`,
`Quirks`, `SyncChain`; `emulator.faults` has `Faults` ===========
===================================================================================

Importing this package loads none of them.
"""

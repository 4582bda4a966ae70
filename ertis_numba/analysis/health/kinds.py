"""Table of the faults that a recording can show, with the unit of the measured value and the remedy."""

from dataclasses import dataclass

__all__ = ["DISABLE", "KINDS", "FaultKind", "kind_of"]

DISABLE = "exclude them with 'ertis process --without', or with array.disabled in a settings file"
"""Remedy for faults of single channels."""

_LAYOUT = "set array.layout to the layout of this array, with its channels in the order of the bits"


@dataclass(frozen=True, slots=True)
class FaultKind:
    """Description of a fault; ``unit`` is empty for a share or a count, ``of_record`` marks faults of all channels."""

    unit: str = ""
    remedy: str = DISABLE
    of_record: bool = False


KINDS = {
    "stuck at": FaultKind(),
    "stuck in a pattern": FaultKind(),
    "stuck at times": FaultKind(
        unit="samples", remedy="check the contact of their cable, or disable them in a layout file"
    ),
    "saturated": FaultKind(),
    "offset": FaultKind(),
    "low-frequency hum": FaultKind(remedy="check their supply and ground, or disable them in a layout file"),
    "idle tone": FaultKind(unit="dB"),
    "dead": FaultKind(unit="dB"),
    "gain": FaultKind(unit="dB", remedy="set their sensitivity (array.gain), or disable them in a layout file"),
    "noisy": FaultKind(unit="dB"),
    "white bits": FaultKind(unit="dB", remedy="check that a microphone is connected, or disable them in a layout file"),
    "flipped bits": FaultKind(unit="dB", remedy="check the clock and the cable, or disable them in a layout file"),
    "duplicate": FaultKind(
        remedy="check the select pins of the microphones that share a line, or disable one of each pair"
    ),
    "inverted polarity": FaultKind(remedy="swap their wires, or disable them in a layout file"),
    "swapped": FaultKind(unit="µs", remedy=_LAYOUT),
    "late": FaultKind(unit="µs", remedy="set their delay (array.delay_s), or disable them in a layout file"),
    "order of channels": FaultKind(unit="µs", remedy=_LAYOUT, of_record=True),
    "misfit of the array": FaultKind(
        unit="µs",
        remedy="compare the order, the positions and the delays of the channels with the wiring",
        of_record=True,
    ),
    "opposite signs": FaultKind(
        remedy="swap the wires of these channels or of all others, or invert their samples before importing",
        of_record=True,
    ),
    "size of the array": FaultKind(
        remedy="correct the unit of the positions, in the layout file or as array.positions_m", of_record=True
    ),
    "half late": FaultKind(
        unit="µs", remedy="synchronise the converters, or set their delays as array.delay_s", of_record=True
    ),
    "order of bytes": FaultKind(unit="dB", remedy="swap the bytes of every number when importing", of_record=True),
    "dropout": FaultKind(unit="samples", remedy="record again, and check the link to the sensor", of_record=True),
    "repeated blocks": FaultKind(
        unit="samples", remedy="record again, and check the link to the sensor", of_record=True
    ),
    "shifted record": FaultKind(
        unit="µs", remedy="start the record with the emission, or correct its first sample", of_record=True
    ),
}
"""Every fault by its name; ``stuck at`` is followed by the value."""


def kind_of(fault: str) -> FaultKind:
    """Return the kind of a fault, given its name in a report."""
    return KINDS.get(fault) or KINDS[next(name for name in KINDS if fault.startswith(name))]

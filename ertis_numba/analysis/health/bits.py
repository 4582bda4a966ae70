"""Checks on the bits of single PDM channels: stuck, saturated, offset."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis import _bits
from ertis_numba.analysis.health.limits import MAX_OFFSET, MAX_SATURATED, MIN_CHANGES, OFFSET_DEVIATIONS
from ertis_numba.analysis.health.report import ChannelHealth

__all__ = ["by_bits"]

_CHANCE_RUN = 20  # Samples in the longest run that white bits have by chance, which matters in short records.


def by_bits(octets: NDArray[np.uint8], enabled: NDArray[np.int64]) -> list[ChannelHealth]:
    """Return the statistics and faults of each channel that need no spectrum."""
    shares = {octet: _bits.bit_shares(np.ascontiguousarray(octets[:, octet])) for octet in np.unique(enabled // 8)}
    # A loud echo may clip occasionally. In a short record, runs and offsets also occur by chance.
    max_runs = MAX_SATURATED + _CHANCE_RUN / len(octets)
    max_offset = MAX_OFFSET + OFFSET_DEVIATIONS / math.sqrt(len(octets))
    reported = []
    for channel in enabled:
        ones, changes, runs, repeats = (values[channel % 8] for values in shares[channel // 8])
        offset = 2 * float(ones) - 1
        if changes < MIN_CHANGES:
            faults: tuple[str, ...] = (f"stuck at {int(offset > 0)}",)
        elif repeats:
            faults = ("stuck in a pattern",)
        else:
            faults = ("saturated",) * bool(runs > max_runs) + ("offset",) * (abs(offset) > max_offset)
        reported.append(
            ChannelHealth(
                channel=int(channel), faults=faults, offset=offset, changes=float(changes), overload=float(runs)
            )
        )
    return reported

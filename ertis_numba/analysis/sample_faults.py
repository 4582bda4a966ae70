"""Faults of samples: dropouts, in which no channel changes, and measurements that repeat the one before."""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

__all__ = [
    "LINK",
    "MIN_DROPOUT_NUMBERS",
    "MIN_DROPOUT_WORDS",
    "Parts",
    "SampleFaults",
    "are_copies",
    "constant_parts",
    "describe_dropouts",
    "dropouts",
]

Parts = list[tuple[int, int]]

MIN_DROPOUT_NUMBERS: Final = 32
MIN_DROPOUT_WORDS: Final = 1024
"""Length for PDM; a call of 1 kHz that overloads all modulators changes their bits more often."""
_CHANCE: Final = 1e-6  # Probability that a record without dropouts has as long a stretch.
_NEAR: Final = 8  # Samples on either side that are compared with the rest of the record.
_LEAST_POWER: Final = 0.1  # Power of the changes there, relative to the quiet tenth of the record.
_AT_ONCE: Final = 0.75  # Share of the channels that must change there.
LINK: Final = "check the link to the sensor, and record again"
"""Remedy."""
_AT_A_TIME: Final = 2**16  # Rows.
_FEW: Final = 64  # Samples that are compared first.


def dropouts(measurement: Measurement, settings: Settings | None = None) -> Parts:
    """Return the parts (first, stop) of a measurement that are dropouts, without zeros at either end."""
    settings = settings or measurement.settings
    rows = sample_format(settings).validated(measurement.data, any_length=True)
    enabled = np.flatnonzero(microphones(settings.array).enabled)
    parts = constant_parts(rows, enabled, is_pdm=settings.recording.is_pdm)
    columns = slice(None) if settings.recording.is_pdm else enabled
    return [
        (first, stop)
        for first, stop in parts
        if (first > 0 and stop < len(rows)) or settings.recording.is_pdm or rows[first, columns].any()
    ]


def constant_parts(rows: NDArray[Any], enabled: NDArray[np.intp], *, is_pdm: bool) -> Parts:
    """Return the parts (first, stop) of a record, (sample, word), in which no enabled channel changes."""
    # A part begins and ends within noise or sound, because records without noise are constant between echoes.
    shortest = MIN_DROPOUT_WORDS if is_pdm else MIN_DROPOUT_NUMBERS
    stride = shortest // 2
    kept = _enabled_bits(rows, enabled) if is_pdm else rows
    columns = slice(None) if is_pdm or len(enabled) == rows.shape[1] else enabled
    few = kept[::stride, columns]
    if not (few[1:] == few[:-1]).all(axis=1).any():  # Every long part contains two of these samples.
        return []
    kept = kept[:, columns]
    parts, n_changes = _still_parts(kept, shortest)
    if not n_changes:
        return []
    n_outside = len(kept) - sum(stop - first for first, stop in parts)
    still = max(n_outside - n_changes, 1) / (n_outside + 1)
    lone = [(first, stop) for first, stop in parts if (stop - first) * math.log(still) < math.log(_CHANCE / len(kept))]
    return lone if is_pdm else _abrupt(kept, lone, parts)


def _still_parts(rows: NDArray[Any], shortest: int) -> tuple[Parts, int]:
    """Return the long parts in which no channel changes, and the number of changes, with little memory."""
    parts, n_changes, begun = [], 0, 0
    for start in range(0, len(rows) - 1, _AT_A_TIME):
        piece = rows[start : start + _AT_A_TIME + 1]
        ends = start + 1 + np.flatnonzero((piece[1:] != piece[:-1]).any(axis=1))
        n_changes += len(ends)
        edges = np.concatenate(([begun], ends))
        long = np.flatnonzero(np.diff(edges) >= shortest)
        parts += [(int(edges[place]), int(edges[place + 1])) for place in long]
        begun = int(edges[-1])
    if len(rows) - begun >= shortest:
        parts.append((begun, len(rows)))
    return parts, n_changes


def _enabled_bits(rows: NDArray[Any], enabled: NDArray[np.intp]) -> NDArray[Any]:
    """Return words with the bits of disabled channels set to 0."""
    octets = np.zeros(rows.shape[1] * rows.itemsize, np.uint8)
    np.bitwise_or.at(octets, enabled // 8, np.left_shift(1, enabled % 8).astype(np.uint8))
    return np.asarray(rows & octets.view(rows.dtype))


def _abrupt(rows: NDArray[Any], parts: Parts, others: Parts) -> Parts:
    """Return the parts of a record that begin and end within noise or sound, with most channels at once."""
    if not parts:
        return []
    steps = np.diff(rows.astype(np.float32), axis=0)
    moves = np.zeros(len(steps), bool)
    for first, stop in others:
        moves[max(first - 1, 0) : stop] = True
    outside = np.flatnonzero(~moves)
    power = np.square(steps, out=np.empty_like(steps)).sum(axis=1, dtype=np.float64)
    blocks = power[outside[: len(outside) // _NEAR * _NEAR]].reshape(-1, _NEAR).mean(axis=1)
    if not len(blocks):
        return []
    quiet, lowest, highest = float(np.quantile(blocks, 0.1)), rows.min(axis=0), rows.max(axis=0)
    found = []
    for first, stop in parts:
        beside = [slice(max(first - _NEAR, 0), first), slice(stop - 1, stop - 1 + _NEAR)]
        beside = [each for each in beside if len(power[each])]
        value = rows[first]
        is_saturated = np.mean((value == lowest) | (value == highest)) > 1 - _AT_ONCE
        if not is_saturated and all(
            power[each].mean() >= _LEAST_POWER * quiet > 0 and (steps[each] != 0).any(axis=0).mean() >= _AT_ONCE
            for each in beside
        ):
            found.append((first, stop))
    return found


def describe_dropouts(parts: Sequence[tuple[int, int]]) -> str:
    """Return a clause on the longest of some dropouts."""
    first, stop = max(parts, key=lambda part: part[1] - part[0])
    more = f", and {len(parts) - 1} shorter part{'s' * (len(parts) > 2)}" if len(parts) > 1 else ""
    return f"samples {first}-{stop - 1}{more} have one value in every channel"


class SampleFaults:
    """Count of the faults of samples over the measurements of one sensor; ``copies`` are not counted if False."""

    def __init__(self, *, copies: bool = True) -> None:
        self._copies = copies
        self._n_measurements = self._n_dropouts = self._n_copies = 0
        self._first: tuple[int, Parts] = 0, []
        self._last: NDArray[Any] | None = None

    def add(self, measurement: Measurement) -> None:
        """Examine the next measurement."""
        parts = dropouts(measurement)
        if parts and not self._n_dropouts:
            self._first = self._n_measurements, parts
        self._n_dropouts += bool(parts)
        self._n_copies += self._last is not None and are_copies(self._last, measurement.data)
        self._n_measurements += 1
        self._last = measurement.data if self._copies else None

    @property
    def is_first_only(self) -> bool:
        """True if only the first measurement has a fault, which its health report names."""
        return self._n_dropouts == 1 and self._first[0] == self._n_copies == 0

    def note(self, consequence: str = "echoes may be missing or too wide") -> str:
        """Return a line on the faults; empty if there are none."""
        found = []
        if self._n_dropouts:
            index, parts = self._first
            found.append(
                f"{self._n_dropouts} of {self._n_measurements} measurements "
                f"{'has' if self._n_dropouts == 1 else 'have'} dropouts (measurement {index}: "
                f"{describe_dropouts(parts)}), so {consequence}"
            )
        if self._n_copies:
            found.append(
                f"{self._n_copies} of {self._n_measurements} measurements "
                f"{'is a copy' if self._n_copies == 1 else 'are copies'} of the one before in every sample, which "
                "recorded sound never is"
            )
        return f"{'; '.join(found)}; {LINK}" if found else ""


def are_copies(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Return True if two measurements are equal in every sample, and not silent."""
    if first.shape != second.shape or not np.array_equal(first[:_FEW], second[:_FEW]):
        return False
    return np.array_equal(first, second) and bool((second != second[:1]).any())

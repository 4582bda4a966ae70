"""Contract of the kernel of echoes that overlap with those of other reflectors or calls."""

from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["DISTURBING", "OverlapEchoes"]

DISTURBING: Final = 1e-4
"""Power relative to that of an echo, from which another one disturbs it."""
GRAZING: Final = 0.1
"""Least cosine of the angle to the axis of the array."""
SHIFT: Final = 0.28
"""Error of a path or a direction relative to the distance of an equally strong echo."""
SIDE_LOBES: Final = 10 ** (-21.0 / 10)
"""Mean power of side lobes of sparse arrays, relative to the main lobe, …"""
SPREAD: Final = 0.33
"""… over a path relative to the pulse and to the change of direction in widths of the beam, …"""
TILT: Final = 0.5
"""… and the error of a direction by their slopes, relative to the width and to their amplitude."""

Doubles = NDArray[np.float64]


class OverlapEchoes(Protocol):
    """Compute how much the echoes of reflectors disturb others: ``out`` (3, echo, reflector).

    Outputs are the relative power, and the variances of path and direction. Two echoes within the width of the
    compressed pulse and of the beam have one maximum, or several at other places, depending on their phases. The error
    grows with the ratio of the amplitudes, and with the distance up to the width. Pulses with side lobes fall off as
    ``(1 + x²)^-1.75`` over a path of x widths: they are 26 dB down at six widths, and 40 dB at fourteen. Predictions
    ``path_m`` and ``power`` (reflector, receiver, emitter) and ``direction`` (reflector, receiver, axis) are compared
    with echoes at a ``receiver`` (echo,), ``heard_m`` (echo, emitter), NaN for silent emitters, ``toward`` (echo, axis)
    and ``loudness`` (echo,), except where ``is_other`` (echo, reflector, emitter) is False: the prediction of the echo
    itself. ``ahead`` (sensor, axis) are the axes of arrays, ``pulse_m`` (sensor,) is a path, and ``beam`` (sensor,) a
    difference of unit vectors.
    """

    def __call__(
        self,
        path_m: Doubles,
        power: Doubles,
        direction: Doubles,
        receiver: NDArray[np.int64],
        heard_m: Doubles,
        toward: Doubles,
        loudness: Doubles,
        is_other: NDArray[np.bool_],
        ahead: Doubles,
        pulse_m: Doubles,
        beam: Doubles,
        out: Doubles,
    ) -> None: ...

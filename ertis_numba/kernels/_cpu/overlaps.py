# mypy: ignore-errors
"""Echoes that overlap with those of other reflectors or calls."""

import math

from numba import njit

from ertis_numba.kernels._contract.overlaps import DISTURBING, GRAZING, SHIFT, SIDE_LOBES, SPREAD, TILT

__all__ = ["overlap_echoes"]


@njit(nogil=True, cache=True, error_model="numpy")
def overlap_echoes(path_m, power, direction, receiver, heard_m, toward, loudness, is_other, ahead, pulse_m, beam, out):
    """Compute how much the echoes of reflectors disturb others."""
    for echo in range(len(receiver)):
        here, along = receiver[echo], 0.0
        width_m, width = pulse_m[here], beam[here]
        for axis in range(3):
            along += toward[echo, axis] * ahead[here, axis]
        facing = max(along, GRAZING)
        for reflector in range(len(path_m)):
            # A flat array observes directions in its plane, so its beam is wider to the side.
            along = square = 0.0
            for axis in range(3):
                turned = toward[echo, axis] - direction[reflector, here, axis]
                along += turned * ahead[here, axis]
                square += turned * turned
            across = math.sqrt(max(0.0, square - along * along))
            lobe, shift_m = math.exp(-((across / width) ** 2)), SPREAD * width_m * (across / width)
            total = sides = path_m2 = 0.0
            for emitter in range(path_m.shape[2]):
                late_m = abs(heard_m[echo, emitter] - path_m[reflector, here, emitter])
                if not (is_other[echo, reflector, emitter] and late_m >= 0.0):  # False for NaN.
                    continue
                strength = power[reflector, here, emitter] / loudness[echo]
                near, aside = strength * lobe * _pulse(late_m / width_m), 0.0
                if across > width:
                    aside = strength * SIDE_LOBES * _pulse(max(0.0, late_m - shift_m) / width_m)
                near = min(near, 1.0) if near > DISTURBING else 0.0
                aside = min(aside, 1.0) if aside > DISTURBING else 0.0
                if near + aside > 0.0:
                    total += near
                    sides += aside
                    path_m2 += (near + aside) * min(SHIFT * late_m, width_m) ** 2
            angle_rad2 = total * (SHIFT * min(across, width)) ** 2 + sides * (TILT * width) ** 2
            out[0, echo, reflector], out[1, echo, reflector] = total, path_m2
            out[2, echo, reflector] = angle_rad2 / (facing * facing)


@njit(nogil=True, cache=True, error_model="numpy")
def _pulse(widths):
    """Return the power of a compressed pulse with side lobes."""
    square = 1.0 + widths * widths
    root = math.sqrt(square)
    return 1.0 / (square * root * math.sqrt(root))

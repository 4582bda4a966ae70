"""Echoes that overlap with those of other reflectors or calls, in plain NumPy."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.overlaps import DISTURBING, GRAZING, SHIFT, SIDE_LOBES, SPREAD, TILT, Doubles

__all__ = ["overlap_echoes"]

_DECAY = -1.75


def overlap_echoes(
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
) -> None:
    """Compute how much the echoes of reflectors disturb others."""
    facing, width_m, width = ahead[receiver], pulse_m[receiver, None, None], beam[receiver, None]
    late_m = np.abs(heard_m[:, None] - path_m.swapaxes(0, 1)[receiver])
    turned = toward[:, None] - direction.swapaxes(0, 1)[receiver]
    # A flat array observes directions in its plane, so its beam is wider to the side.
    along = np.einsum("eri,ei->er", turned, facing)
    across = np.sqrt(np.maximum(0.0, np.einsum("eri,eri->er", turned, turned) - along**2))
    near = (1 + (late_m / width_m) ** 2) ** _DECAY * np.exp(-((across / width) ** 2))[..., None]
    apart_m = np.maximum(0.0, late_m - SPREAD * width_m * (across / width)[..., None])
    aside = SIDE_LOBES * (1 + (apart_m / width_m) ** 2) ** _DECAY * (across > width)[..., None]
    strength = power.swapaxes(0, 1)[receiver] / loudness[:, None, None]
    ratio, side = (
        np.where(is_other & (each * strength > DISTURBING), np.minimum(each * strength, 1.0), 0.0)  # False for NaN.
        for each in (near, aside)
    )
    out[0], is_any = ratio.sum(axis=2), ratio + side > 0
    out[1] = np.where(is_any, (ratio + side) * np.minimum(SHIFT * late_m, width_m) ** 2, 0.0).sum(axis=2)
    facing_to = np.maximum(np.einsum("ei,ei->e", toward, facing), GRAZING)[:, None]
    angle_rad2 = out[0] * (SHIFT * np.minimum(across, width)) ** 2 + side.sum(axis=2) * (TILT * width) ** 2
    out[2] = angle_rad2 / facing_to**2

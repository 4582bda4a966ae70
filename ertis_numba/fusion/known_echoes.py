"""Fused images that follow the located reflectors: their echoes are no ghosts elsewhere, and have their level."""

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.attribution import Shares
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import CoarseImage, Receiver

__all__ = ["KnownEchoes", "explained_shares", "levelled"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_MARGIN: Final = np.float32(4.0)  # Power up to which sure reflectors explain a pixel, relative to their echoes.
_LOBE: Final = -1.0  # Logarithm of the amplitude at the width of the main lobe: the beamformer falls off faster.
_PULSE: Final = -0.875  # Compressed pulses are 26 dB down at six widths, and 40 dB at fourteen.
_TINY: Final = np.float32(1e-30)
_TOP_RAD: Final = np.radians((6.0, 16.0))  # Distance from a reflector within which levels are its own, and up to …
_TOP_M: Final = 0.05, 0.12  # … which they fade to those of the image.
_PEAK_M: Final = 0.06, 0.04  # Distances across and along the range, within which the image shows the reflector itself.
_PEAK_CELLS: Final = 0.75  # Least distance across, in cells.
_MOST: Final = 10 ** (22.0 / 10)  # Largest correction. Reflectors that the image shows less are no points.


class KnownEchoes(NamedTuple):
    """Echoes (echo,) of located reflectors in the image of one receiver.

    ``direction`` (echo, axis) is in the frame of the platform. A flat array shows sound from behind in front, not
    ``is_ahead``.
    """

    reflector: Numbers
    emitter: Numbers
    path_m: Floats
    direction: Floats
    power: Floats
    is_ahead: Flags

    def amplitudes(self, receiver: Receiver, late_m: Mapping[int, float]) -> tuple[Singles, Singles]:
        """Return factors of the amplitude of each echo in each pixel: (echo, direction) and (echo, step)."""
        turned = self.direction[:, None] @ receiver.mounting.rotation - receiver.directions
        lobe = np.exp(_LOBE * (turned[..., 1] ** 2 + turned[..., 2] ** 2) / receiver.width**2)
        path_m = self.path_m + np.array([late_m[each] for each in self.emitter.tolist()])
        middle_m = (2 * np.arange(receiver.n_steps) + 1) * receiver.step_m
        beside_m = np.maximum(np.abs(middle_m - path_m[:, None]) - receiver.step_m, 0.0)  # A step shows its highest.
        pulse = np.sqrt(self.power)[:, None] * (1 + (beside_m / receiver.pulse_m) ** 2) ** _PULSE
        return lobe.astype(np.float32), pulse.astype(np.float32)


def explained_shares(
    shares: Shares,
    number: int,
    image: CoarseImage,
    echoes: KnownEchoes,
    factors: tuple[Singles, Singles],
    is_sure: Flags,
) -> Shares:
    """Return the shares of a receiver's pixels, which belong to located reflectors where these explain them.

    Sure reflectors explain a pixel if the sum of their echoes in phase may have its power. Their phases are
    unknown. All located reflectors share such a pixel by the powers of their echoes there. Echoes that arrive from
    behind, and reflectors of other calls, are thus no ghosts in front. Other pixels keep the shares of the attribution.
    """
    lobe, pulse = factors
    sure = is_sure[echoes.reflector]
    explained = _MARGIN * _sums(lobe[sure], pulse[sure], image.power.shape) ** 2 / (image.power + _TINY)
    np.minimum(explained, 1, out=explained)
    lobe, pulse = lobe**2, pulse**2
    part = explained / (_sums(lobe, pulse, image.power.shape) + _TINY)
    rest = 1 - explained
    found: dict[tuple[int, int], Singles] = {}
    for (emitter, receiver), share in shares.items():
        if receiver == number:
            own = (echoes.emitter == emitter) & echoes.is_ahead
            known = _sums(lobe[own], pulse[own], part.shape) * part
            found[emitter, receiver] = (known + rest * share.reshape(known.shape)).reshape(-1)
    return found


def _sums(lobe: Singles, pulse: Singles, shape: tuple[int, ...]) -> Singles:
    """Return the sums of the products of lobes and pulses over echoes: (direction, step) float32."""
    found = np.zeros(shape, np.float32)
    kernels.load_fusion().add_lobes(lobe, pulse, found)
    return found


def levelled(reflectivity: Singles, grid: PolarGrid, place_m: Floats, power: Floats) -> Singles:
    """Return the reflectivity (cell,), scaled around reflectors so that the highest one is theirs, power at 1 m."""
    cells = reflectivity.reshape(grid.n_directions, grid.n_ranges)
    weight, factor = np.zeros_like(cells), np.ones_like(cells)
    offset_m = (place_m - grid.centre_m) * (1, 1, not grid.is_planar)
    reach_m = np.maximum(np.linalg.norm(offset_m, axis=1), _PEAK_M[0])
    turned_rad = np.arccos((offset_m / reach_m[:, None] @ grid.directions.T).clip(-1, 1))
    for number in np.argsort(-power, kind="stable"):
        each, turn_rad, off_m = float(power[number]), turned_rad[number], np.abs(grid.range_m - reach_m[number])
        peak_rad = max(_PEAK_M[0] / float(reach_m[number]), _PEAK_CELLS * 2 * math.pi / grid.n_azimuths)
        peak = cells[turn_rad < peak_rad][:, off_m < max(_PEAK_M[1], grid.step_m)].max(initial=0.0)
        if not each < _MOST * peak:
            continue
        near, along = np.flatnonzero(turn_rad < _TOP_RAD[1]), np.flatnonzero(off_m < _TOP_M[1])
        here = np.ix_(near, along)
        nearness = (_faded(turn_rad[near], _TOP_RAD)[:, None] * _faded(off_m[along], _TOP_M)).astype(np.float32)
        is_nearest = nearness > weight[here]
        weight[here] = np.where(is_nearest, nearness, weight[here])
        factor[here] = np.where(is_nearest, np.float32(each / peak) ** nearness, factor[here])
    return (cells * factor).reshape(-1)


def _faded(distance: Floats, limits: Floats | tuple[float, float]) -> Floats:
    """Return 1 up to the first limit, and 0 from the second one."""
    return np.asarray(((limits[1] - distance) / (limits[1] - limits[0])).clip(0, 1))

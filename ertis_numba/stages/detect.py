"""From energyscapes to reflectors."""

import math

import numpy as np
import scipy.spatial
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.air import sound_speed_m_s
from ertis_numba.frames import Energyscape, Peak
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.settings import Settings
from ertis_numba.waveform import matched_filter

__all__ = ["ONE_SIDED", "PULSE_M", "SIDE_LOBE_DB", "find_peaks", "neighbours_of"]

_NEIGHBOURS = 8  # directions around one in the plane of a dense grid
_MARGIN_DB = 3.0  # by which a reflector must rise above the side lobes of stronger ones
PULSE_M = 0.04
"""How far off a compressed pulse of 25 kHz bandwidth is 26 dB down, and 40 dB at 2.5 times as far."""
SIDE_LOBE_DB = 10.0
"""Below the strongest of the same range, from which on side lobes are expected.

Those of eRTIS_v3D1 at 25–50 kHz reach -12.3 dB, and -28 dB at ranges that differ by `PULSE_M`.
"""
ONE_SIDED = 0.25
"""Mean offset of neighbours, by their reach, that tells the edge of a grid."""


def find_peaks(
    image: Energyscape,
    *,
    top: int | None = 10,
    min_level_db: float = -30.0,
    where: NDArray[np.bool_] | None = None,
) -> list[Peak]:
    """Return the reflectors of an image, strongest first.

    A reflector is a local maximum over directions and ranges that rises above what the side lobes of
    all stronger reflectors add up to there, as predicted from array and call. So each gives one
    entry, not one per bin of its main lobe nor one per side lobe. Direction, range and level are
    interpolated by parabolas through the logarithm of the energy.

    Parameters
    ----------
    image : Energyscape
    top : int, optional
        At most so many; None for all.
    min_level_db : float
        Level below the strongest reflector at which to stop.
    where : (direction, range) bool, optional
        Bins that may be the maximum of a reflector; all by default.

    Raises
    ------
    ArgumentError
        ``top`` is below 1, ``min_level_db`` is above 0, or ``where`` has another shape than the image.
    """
    top = image.energy.size if top is None else checks.whole("top", top, 1)
    checks.between("min_level_db", min_level_db, -1000.0, 0.0)
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    neighbours = neighbours_of(directions)
    floor = float(np.max(image.energy, initial=0.0)) * 10 ** (min_level_db / 20)
    if where is not None:
        checks.shape("where", where.shape, image.energy.shape)
    places = _local_maxima(image.energy, neighbours, floor, where)
    levels = image.energy[places[:, 0], places[:, 1]].astype(np.float64)
    spread = _PointSpread(image.settings)
    found: list[tuple[NDArray[np.float64], float, float]] = []
    for k in np.argsort(-levels, kind="stable"):
        if len(found) == top:
            break
        direction, range_m = directions[places[k, 0]], image.range_m[places[k, 1]]
        # Only what comes next in order is compared with what was found, which is few of many candidates, and
        # with where that really lies: a side lobe is several decibels off when its reflector is half a bin off.
        near = [entry for entry in found if abs(range_m - entry[1]) < spread.reach_m]
        if near:
            sources, ranges_m, amplitudes = (np.array(column) for column in zip(*near, strict=True))
            masked = float(amplitudes @ spread(direction - sources, range_m - ranges_m))
            if levels[k] <= masked * 10 ** (_MARGIN_DB / 20):
                continue
        found.append(_interpolate(image, directions, neighbours, *places[k]))
    found.sort(key=lambda entry: -entry[2])
    return [
        Peak(
            azimuth_deg=math.degrees(math.atan2(direction[1], direction[0])),
            elevation_deg=math.degrees(math.asin(max(-1.0, min(1.0, direction[2])))),
            range_m=range_m,
            level_db=20 * math.log10(level / found[0][2]),
        )
        for direction, range_m, level in found
    ]


def neighbours_of(directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return for each direction itself and the nearest others.

    In a plane these are the ones next to it; elsewhere the eight around it.

    Parameters
    ----------
    directions : (direction, axis) float64
        Unit vectors.

    Returns
    -------
    (direction, neighbour) int64
        Fewer neighbours where there are too few directions.
    """
    count = 2 if np.ptp(directions[:, 2]) == 0 else _NEIGHBOURS
    _, nearest = scipy.spatial.KDTree(directions).query(directions, k=min(count + 1, len(directions)))
    return np.asarray(nearest, dtype=np.int64).reshape(len(directions), -1)


def _local_maxima(
    energy: NDArray[np.float32], neighbours: NDArray[np.int64], floor: float, where: NDArray[np.bool_] | None
) -> NDArray[np.int64]:
    """Return (peak, [direction, range]) of what is above ``floor`` and not below any neighbour.

    The first and the last range are no maxima: what rises towards them lies outside of the image.
    """
    inner = slice(1, -1) if energy.shape[1] > 2 else slice(None)
    start = inner.start or 0
    here = energy[:, inner]
    is_peak = (here >= floor) & (here > 0)
    if where is not None:
        is_peak &= where[:, inner]
    if start:
        is_peak &= (here >= energy[:, :-2]) & (here > energy[:, 2:])
    # Only what is left is compared over directions; that is few.
    directions, ranges = np.nonzero(is_peak)
    ranges += start
    around = energy[neighbours[directions], ranges[:, None]]
    highest = around.max(axis=1, initial=0.0) <= energy[directions, ranges]
    # Of two equal neighbours the first counts.
    equal = (around == energy[directions, ranges][:, None]) & (neighbours[directions] < directions[:, None])
    keep = highest & ~equal.any(axis=1)
    return np.stack([directions[keep], ranges[keep]], axis=1)


class _PointSpread:
    """How much of a reflector's amplitude shows up elsewhere in the image.

    Attributes
    ----------
    reach_m : float
        Range beyond which nothing does: a side lobe moves by half of the difference of two paths, so
        by the aperture's radius at most, and is as long as the pulse.
    """

    def __init__(self, settings: Settings) -> None:
        speed_m_s, rate_hz = sound_speed_m_s(settings.air), settings.signal_rate_hz
        self._positions_m = microphones(settings.array).enabled_positions_m
        self.reach_m = float(np.max(np.linalg.norm(self._positions_m, axis=1))) + PULSE_M
        # The sum over bins repeats itself after speed / spacing; paths differ by four reaches at most.
        spacing_hz = speed_m_s / (6 * self.reach_m)
        n_fft = math.ceil(max(settings.call.duration_s * rate_hz + 1, rate_hz / spacing_hz))
        matched = matched_filter(settings, n_fft=n_fft)
        thinned = slice(None, None, max(1, math.floor(spacing_hz * n_fft / rate_hz)))
        bins = (matched.first_bin + np.arange(len(matched.values)))[thinned]
        self._wave_1_m = 2 * math.pi * bins * rate_hz / n_fft / speed_m_s
        self._power = np.abs(matched.values[thinned]) ** 2
        self._power /= self._power.sum()

    def __call__(
        self, direction_offset: NDArray[np.float64], range_offset_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the amplitude, 1 at no offset: (place,) float64.

        ``|Σ_f P(f) Σ_mic exp(j k(f) (2 Δr − p·Δu))| / n_mics``, P being the power of the call.

        Parameters
        ----------
        direction_offset : (place, axis) float64
            Difference of the unit vectors.
        range_offset_m : (place,) float64
        """
        path_m = 2 * range_offset_m[:, None] - direction_offset @ self._positions_m.T
        waves = np.exp(1j * self._wave_1_m[:, None, None] * path_m)  # (bin, place, mic)
        return np.asarray(np.abs(np.tensordot(self._power, waves.mean(axis=2), axes=1)))


def _interpolate(
    image: Energyscape,
    directions: NDArray[np.float64],
    neighbours: NDArray[np.int64],
    direction: int,
    range_index: int,
) -> tuple[NDArray[np.float64], float, float]:
    """Return unit vector, range and amplitude of the maximum near one bin."""
    tiny = np.finfo(np.float32).tiny
    logs = np.log(np.maximum(image.energy[:, range_index].astype(np.float64), tiny))
    level = logs[direction]
    range_m = float(image.range_m[range_index])
    if 0 < range_index < len(image.range_m) - 1:
        row = np.log(np.maximum(image.energy[direction, range_index - 1 : range_index + 2].astype(np.float64), tiny))
        bend = row[0] - 2 * row[1] + row[2]
        shift = 0.5 * (row[0] - row[2]) / bend if bend < 0 else 0.0
        range_m += float(shift) * float(image.range_m[1] - image.range_m[0])
        level += 0.25 * (row[2] - row[0]) * shift
    around = neighbours[direction]
    offset, rise = _quadric_top(directions[around] - directions[direction], logs[around] - logs[direction])
    top = directions[direction] + offset
    return top / np.linalg.norm(top), range_m, math.exp(level + rise)


def _quadric_top(offsets: NDArray[np.float64], rises: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return where a quadric through samples around 0 is highest, and by how much it rises there.

    The quadric is fitted over the plane, or the line, in which the offsets mainly lie. The place itself
    is kept where there is no maximum within the samples, and at the edge of a grid, whose samples lie
    to one side.
    """
    none = np.zeros(3), 0.0
    reach = np.max(np.linalg.norm(offsets, axis=1))
    if len(offsets) < 3 or np.linalg.norm(offsets.mean(axis=0)) > ONE_SIDED * reach:
        return none
    _, sizes, axes = np.linalg.svd(offsets, full_matrices=False)
    n_axes = 2 if sizes[1] > 0.2 * sizes[0] else 1
    x = offsets @ axes[:n_axes].T
    columns = [x[:, i] for i in range(n_axes)] + [x[:, i] * x[:, j] for i in range(n_axes) for j in range(i, n_axes)]
    matrix = np.stack(columns, axis=1)
    if len(matrix) <= matrix.shape[1]:
        return none
    fit = np.linalg.lstsq(matrix, rises, rcond=None)[0]
    slope = fit[:n_axes]
    curve = np.zeros((n_axes, n_axes))
    curve[np.triu_indices(n_axes)] = fit[n_axes:]
    curve = curve + curve.T
    if np.max(np.linalg.eigvalsh(curve)) >= 0:
        return none
    top = np.linalg.solve(curve, -slope)
    if np.linalg.norm(top) > reach:
        return none
    return top @ axes[:n_axes], float(0.5 * slope @ top)

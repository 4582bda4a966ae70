"""Detection of reflectors in images."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.directional_noise import pulse_steps, stands_out
from ertis_numba.analysis.noise import noise_of, threshold_of
from ertis_numba.analysis.outside_echo import has_outside, outside_of
from ertis_numba.analysis.peak_interpolation import PeakInterpolator, Tops, centred, listed
from ertis_numba.analysis.point_spread import spread_of
from ertis_numba.analysis.side_lobes import EdgeFloor, SideLobes
from ertis_numba.analysis.uncertainty import PositionUncertainty
from ertis_numba.base import checks
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape, Peak, PointCloud
from ertis_numba.geometry import ObservableAngles, observable_angles, unit_vectors

__all__ = ["find_peaks", "left_out_at_edges", "left_out_in_noise", "neighbours_of", "observed", "peaks_of_grid"]

_SAME_DIGITS = 9  # Decimals in which the unit vectors of equal directions agree.
_BESIDE = 8  # Number of further maxima that are examined as disturbances.
_COUNTED = 400  # Number of maxima that are examined as possible noise.
_EXPLAINING = 50  # Number of listed reflectors whose side lobes may be among them.
_NEIGHBOURS = 8  # Number of directions around each direction of a dense grid.


def find_peaks(
    image: Energyscape,
    *,
    top: int | None = 10,
    min_level_db: float = -30.0,
    where: NDArray[np.bool_] | None = None,
    false_alarm: float | None = FALSE_ALARM,
) -> list[Peak]:
    """Return the reflectors of an image, strongest first.

    A reflector is a local maximum over directions and ranges that exceeds the side lobes of all stronger reflectors
    there: see `ertis_numba.analysis.side_lobes.SideLobes`. Each reflector therefore yields one entry, not one per bin
    of its main lobe or per side lobe. Direction, range and level are interpolated: see
    `ertis_numba.analysis.peak_interpolation.PeakInterpolator`. Near the first and the last range, a reflector must also
    exceed the side lobes of a possible echo beyond: see `ertis_numba.analysis.side_lobes.EdgeFloor`.

    Angles that the array cannot observe are NaN: both for one microphone, and the elevation for a horizontal line of
    microphones. See `ertis_numba.geometry.observable_angles`.

    An image with `Energyscape.points` yields these points: fusion has located the reflectors from the images of all
    sensors, and maxima of the fused image may be ghosts. ``false_alarm`` then has no effect.

    Parameters
    ----------
    image : Energyscape
    top : int, optional
        Maximum number of reflectors; 10 by default, None for all.
    min_level_db : float
        Minimum level relative to the strongest reflector; -30 dB by default.
    where : (direction, range) bool, optional
        True for bins that may be the maximum of a reflector; all bins by default.
    false_alarm : float, optional
        Probability that noise alone yields a reflector anywhere in the image; 0.001 by default. Weaker maxima are
        discarded: see `ertis_numba.analysis.noise.threshold_of`. So are those that a hiss, a tone or a click from their
        direction explains, see `ertis_numba.analysis.directional_noise.stands_out`, and side lobes that noise may have
        raised. Cleaned images keep all maxima. None also lists the maxima that noise alone may cause.

    Raises
    ------
    ArgumentError
        ``top`` is below 1, ``min_level_db`` is above 0, ``where`` has another shape than the image, or is passed with
        an image that has points, or ``false_alarm`` is not between 0 and 1.

    Examples
    --------
    Print the three strongest reflectors of a recording's first measurement::

        with ertis.open_recording("data/synthetic/reflectors.h5") as recording:
            measurement = recording[0]
        image = ertis.Pipeline(measurement.settings).process(measurement)
        for peak in ertis.find_peaks(image, top=3):
            print(f"{peak.range_m:.2f} m at {peak.azimuth_deg:.0f}°, {peak.level_db:.1f} dB")
    """
    peaks = peaks_of_grid(image, top=top, min_level_db=min_level_db, where=where, false_alarm=false_alarm)
    return observed(image, peaks)


def observed(image: Energyscape, peaks: list[Peak]) -> list[Peak]:
    """Return the peaks of an image without the angles that the array cannot observe."""
    seen = observable_angles(image.settings.array)
    return [_observed(peak, seen, is_planar=image.is_planar) for peak in peaks]


def _observed(peak: Peak, seen: ObservableAngles, *, is_planar: bool) -> Peak:
    """Return a peak without the angles that the array cannot observe."""
    if seen.azimuth and seen.elevation:
        return peak
    angles_rad = seen.observed_rad(peak.azimuth_rad, peak.elevation_rad, is_planar=is_planar)
    azimuth_deg, elevation_deg = map(math.degrees, angles_rad)
    error_deg = math.nan if math.isnan(azimuth_deg) and math.isnan(elevation_deg) else peak.grid_error_deg
    sd_deg = math.nan if math.isnan(error_deg) else peak.angle_sd_deg
    return replace(
        peak, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, grid_error_deg=error_deg, angle_sd_deg=sd_deg
    )


def peaks_of_grid(
    image: Energyscape,
    *,
    top: int | None = 10,
    min_level_db: float = -30.0,
    where: NDArray[np.bool_] | None = None,
    false_alarm: float | None = FALSE_ALARM,
) -> list[Peak]:
    """Return the result of `find_peaks` with directions of the grid instead of angles that the array cannot observe."""
    checks.instance("image", image, Energyscape, "Pipeline.process returns")
    top = image.amplitude.size if top is None else checks.integer("top", top, 1)
    checks.between("min_level_db", min_level_db, -1000.0, 0.0)
    if image.points is not None:
        if where is not None:
            raise ArgumentError(
                "where selects bins, but the image has the points of a fusion; leave out where, or pass "
                "image.replace(points=None) to search the image itself"
            )
        return _fused_peaks(image.points.strongest(top, min_level_db), is_planar=image.is_planar)
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    neighbours = neighbours_of(directions)
    floor = _floor(image, min_level_db, false_alarm)
    if where is not None:
        where = np.asarray(where)
        checks.shape("where", where.shape, image.amplitude.shape)
        if where.dtype != np.bool_:
            raise ArgumentError(f"where has dtype {where.dtype}; use bool, such as image.amplitude > 0.01")
    edges = EdgeFloor(directions, spread_of(image.settings))(image)
    places = _local_maxima(image.amplitude, neighbours, np.maximum(floor, edges), where)
    places = np.stack(centred(image, neighbours, places[:, 0], places[:, 1]), axis=1)
    if false_alarm is not None:
        places = places[stands_out(image, places[:, 0], places[:, 1], false_alarm, pulse_steps(image))]
    levels = image.amplitude[places[:, 0], places[:, 1]].astype(np.float64)
    order = np.argsort(-levels, kind="stable")
    side_lobes = SideLobes(image, directions, places[order], noise=threshold_of(image, false_alarm))
    interpolate = PeakInterpolator(image.settings, directions, neighbours, only=places[:, 0])
    found: list[tuple[NDArray[np.float64], float, float]] = []
    errors_rad: list[float] = []
    each_top: list[Tops] = []
    is_limited, noise = has_outside(image.settings, directions), noise_of(image)
    for k in order:
        # Each candidate is compared only with the few reflectors found before it, at their interpolated positions. The
        # prediction of a side lobe is several decibels off if its reflector is half a bin off.
        is_beside = [abs(image.range_m[places[k, 1]] - each[1]) < side_lobes.reach_m for each in found[:top]]
        is_left_out = len(found) >= top and (len(found) >= top + _BESIDE or not any(is_beside))
        if is_left_out or side_lobes.explain(directions[places[k, 0]], int(places[k, 1]), levels[k]):
            continue
        tops = interpolate(image, places[k : k + 1, 0], places[k : k + 1, 1], noise=noise)
        found.append((tops.direction[0], float(tops.range_m[0]), float(tops.amplitude[0])))
        outside = outside_of(image, directions, found[-1][1]) if is_limited else None
        is_beside_open = is_limited and any(
            math.isinf(error_rad) and abs(found[-1][1] - other[1]) < side_lobes.reach_m
            for other, error_rad in zip(found[:-1], errors_rad, strict=True)
        )
        is_open = outside is not None or is_beside_open  # Side lobes of reflectors beyond the grid are not predicted.
        errors_rad.append(math.inf if is_open else float(tops.width_rad[0]) / math.sqrt(12))
        each_top.append(tops._replace(width_rad=np.array([math.inf])) if is_open else tops)
        if outside is not None:  # Its side lobes are in the image.
            side_lobes.add(outside.direction, found[-1][1], max(math.sqrt(outside.power), found[-1][2]))
        else:
            side_lobes.add(*found[-1])
    return _peaks(image, each_top, errors_rad[:top], noise)


def _peaks(image: Energyscape, each_top: list[Tops], errors_rad: list[float], noise: float) -> list[Peak]:
    """Return the first interpolated maxima as peaks, strongest first; further ones disturb them."""
    if not each_top:
        return []
    tops = Tops(*(np.concatenate(column) for column in zip(*each_top, strict=True)))
    levels = listed(tops.amplitude, image)
    uncertainty = PositionUncertainty(image.settings, is_planar=image.is_planar)(image, tops, noise=noise)
    level_sd = np.hypot(uncertainty.level, np.log(tops.amplitude / levels))
    return [
        Peak(
            azimuth_deg=math.degrees(math.atan2(tops.direction[k, 1], tops.direction[k, 0])),
            elevation_deg=math.degrees(math.asin(max(-1.0, min(1.0, tops.direction[k, 2])))),
            range_m=float(tops.range_m[k]),
            level_db=20 * math.log10(levels[k] / levels.max()),
            level_dbfs=20 * math.log10(levels[k]),
            grid_error_deg=math.degrees(errors_rad[k]),
            angle_sd_deg=math.degrees(uncertainty.across_rad[k]),
            range_sd_m=float(uncertainty.range_m[k]),
            level_sd_db=20 / math.log(10) * float(level_sd[k]),
        )
        for k in np.argsort(-levels[: len(errors_rad)], kind="stable").tolist()
    ]


def left_out_at_edges(
    image: Energyscape, peaks: Sequence[Peak], *, min_level_db: float = -30.0, false_alarm: float | None = None
) -> int:
    """Return the number of maxima that `find_peaks` left out because an echo beyond an edge may have caused them."""
    if image.points is not None:
        return 0
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    edges = EdgeFloor(directions, spread_of(image.settings))(image)
    floor = _floor(image, min_level_db, false_alarm)
    places = _local_maxima(image.amplitude, neighbours_of(directions), np.full(len(edges), floor), edges[None] > 0)
    levels = image.amplitude[places[:, 0], places[:, 1]].astype(np.float64)
    is_left = levels < edges[places[:, 1]]
    side_lobes = SideLobes(image, directions, places[is_left], noise=threshold_of(image, false_alarm))
    _add(side_lobes, peaks)
    doubtful = zip(places[is_left], levels[is_left], strict=True)
    return sum(not side_lobes.explain(directions[place[0]], int(place[1]), level) for place, level in doubtful)


def left_out_in_noise(image: Energyscape, *, min_level_db: float = -30.0, false_alarm: float) -> int:
    """Return the number of maxima that `find_peaks` left out as possible noise from their direction."""
    if image.points is not None:
        return 0
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    floor = np.maximum(
        _floor(image, min_level_db, false_alarm), EdgeFloor(directions, spread_of(image.settings))(image)
    )
    places = _local_maxima(image.amplitude, neighbours_of(directions), floor, None)
    places = places[~stands_out(image, places[:, 0], places[:, 1], false_alarm, pulse_steps(image))]
    levels = image.amplitude[places[:, 0], places[:, 1]].astype(np.float64)
    order = np.argsort(-levels, kind="stable")[:_COUNTED]
    places, levels = places[order], levels[order]
    if not len(places):
        return 0
    side_lobes, count = SideLobes(image, directions, places, noise=threshold_of(image, false_alarm)), 0
    _add(side_lobes, peaks_of_grid(image, top=_EXPLAINING, min_level_db=min_level_db, false_alarm=false_alarm))
    for place, level in zip(places, levels, strict=True):
        direction = directions[place[0]]
        if not side_lobes.explain(direction, int(place[1]), level):
            side_lobes.add(direction, float(image.range_m[place[1]]), float(level))
            count += 1
    return count


def _add(side_lobes: SideLobes, peaks: Iterable[Peak]) -> None:
    """Add listed reflectors to those whose side lobes are predicted."""
    for peak in peaks:
        azimuth_rad, elevation_rad = np.nan_to_num(np.radians([[peak.azimuth_deg], [peak.elevation_deg]]))
        side_lobes.add(unit_vectors(azimuth_rad, elevation_rad)[0], peak.range_m, 10 ** (peak.level_dbfs / 20))


def _floor(image: Energyscape, min_level_db: float, false_alarm: float | None) -> float:
    """Return the amplitude that reflectors must have."""
    highest = checks.finite("the maximum of the image", float(np.max(image.amplitude, initial=0.0)))
    floor = highest * 10 ** (min_level_db / 20)
    return max(floor, threshold_of(image, false_alarm))


def _fused_peaks(cloud: PointCloud, *, is_planar: bool) -> list[Peak]:
    """Return the points of a fusion as peaks of the image around the platform."""
    with np.errstate(divide="ignore"):
        level_dbfs = 20 * np.log10(cloud.amplitude.astype(np.float64))
    across_m = np.hypot(cloud.position_m[:, 0], cloud.position_m[:, 1])
    range_m = (across_m if is_planar else cloud.range_m).tolist()
    elevation_deg = [0.0] * len(cloud) if is_planar else cloud.elevation_deg.tolist()
    unknown_m = np.full((len(cloud), 2), np.nan)
    sd_m = (unknown_m if cloud.uncertainty_m is None else cloud.uncertainty_m.astype(np.float64)).tolist()
    rows = zip(cloud.azimuth_deg.tolist(), elevation_deg, range_m, level_dbfs.tolist(), sd_m, strict=True)
    return [
        Peak(
            azimuth_deg=azimuth_deg,
            elevation_deg=up_deg,
            range_m=away_m,
            level_db=level - level_dbfs[0],
            level_dbfs=level,
            grid_error_deg=0.0,
            angle_sd_deg=math.degrees(across_sd_m / away_m) if away_m else math.inf,
            range_sd_m=range_sd_m,
        )
        for azimuth_deg, up_deg, away_m, level, (range_sd_m, across_sd_m) in rows
    ]


def neighbours_of(directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return each direction with its two nearest neighbours at one elevation, otherwise eight: (direction, neighbour).

    Equal directions, such as azimuths of ±180°, share their neighbours in further columns.
    """
    count = 2 if np.ptp(directions[:, 2]) == 0 else _NEIGHBOURS
    # Adding 0 turns -0 into 0.
    rounded = np.round(directions, _SAME_DIGITS) + 0.0
    _, first, group, sizes = np.unique(rounded, axis=0, return_index=True, return_inverse=True, return_counts=True)
    group, kept = group.reshape(-1), np.sort(first)
    _, nearest = scipy.spatial.KDTree(directions[kept]).query(directions, k=min(count + 1, len(kept)))
    rows = kept[np.asarray(nearest, dtype=np.int64).reshape(len(directions), -1)]
    if len(first) == len(directions):
        return rows
    members = np.repeat(first[:, None], sizes.max(), axis=1)
    order = np.argsort(group, kind="stable")
    members[group[order], np.arange(len(order)) - (np.cumsum(sizes) - sizes)[group[order]]] = order
    return np.concatenate([rows, members[group][:, 1:]], axis=1)


def _local_maxima(
    amplitude: NDArray[np.float32],
    neighbours: NDArray[np.int64],
    floor: NDArray[np.float64],
    where: NDArray[np.bool_] | None,
) -> NDArray[np.int64]:
    """Return the local maxima that reach ``floor`` (range,): (peak, [direction, range])."""
    inner = slice(1, -1) if amplitude.shape[1] > 2 else slice(None)
    start = inner.start or 0
    here = amplitude[:, inner]
    is_peak = (here >= floor[inner]) & (here > 0)
    if where is not None:
        is_peak &= where[:, inner]
    if start:
        is_peak &= (here >= amplitude[:, :-2]) & (here > amplitude[:, 2:])
    # Only the few remaining bins are compared over directions.
    directions, ranges = np.nonzero(is_peak)
    ranges += start
    around = amplitude[neighbours[directions], ranges[:, None]]
    highest = around.max(axis=1, initial=0.0) <= amplitude[directions, ranges]
    # The first of two equal neighbours counts.
    equal = (around == amplitude[directions, ranges][:, None]) & (neighbours[directions] < directions[:, None])
    keep = highest & ~equal.any(axis=1)
    return np.stack([directions[keep], ranges[keep]], axis=1)

"""Sources of sound in acoustic maps, with directions and levels interpolated between those of the grid."""

import functools
import math
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.detect import neighbours_of
from ertis_numba.analysis.outside_grid import OutsidePatterns, OutsideSource
from ertis_numba.analysis.quadric_fits import MAX_RISE_DB, QuadricFits
from ertis_numba.base import checks
from ertis_numba.frames import AcousticMap, SoundDirection
from ertis_numba.geometry import ObservableAngles, observable_angles, unit_vectors
from ertis_numba.passive.components import strongest_first
from ertis_numba.passive.wave_delays import WaveDelays
from ertis_numba.settings import Passive, Settings

__all__ = ["find_sound_sources", "sources_of_grid"]

Floats = NDArray[np.float64]
_LossOf = Callable[[Floats, Floats], Floats]

_MIN_LEVEL_DB: Final = -10.0  # Side lobes of most arrays are lower.
_MIN_COMPONENT_DB: Final = -20.0  # CLEAN-SC removes side lobes, but 1 % of a source may remain.
_FLOOR: Final = 2.0  # Lowest power of a maximum relative to the median over directions; that of noise varies less.
_SIDE_LOBES: Final = 2.0  # Lowest power of a maximum relative to predicted side lobes.
_FREQUENCIES: Final = 9  # Frequencies of a band at which side lobes are predicted.
_NARROWER: Final = 3.0  # Main lobe of Capon and MUSIC in decibels, relative to that of delay-and-sum; it may be more.
_EDGE_OF_LOBE: Final = 1e-3  # Power of delay-and-sum relative to a maximum, below which it is not of the main lobe.
_LEAST_LOSS: Final = 0.25  # Power relative to a maximum at the edge of a cell; grids with less do not resolve it.
_NOISE: Final = 10**0.05  # Noise may raise a maximum above a main lobe through its strongest sample.
_FREQUENCIES_OF_PATTERN: Final = 3
_DEEPEST: Final = 1e-6  # Power relative to the maximum of a map that counts in patterns.
_TINY: Final = 1e-300


class _Top(NamedTuple):
    """Source of a band, with its direction as a unit vector, (axis,) float64, and the width of its cell."""

    # The width is 0 if the direction is interpolated, and infinite if the source may lie beyond an edge.

    direction: Floats
    power: float
    width_rad: float


class _Grid(NamedTuple):
    """Directions with their neighbours."""

    directions: Floats
    neighbours: NDArray[np.int64]

    @classmethod
    def of(cls, directions: Floats) -> "_Grid":
        return cls(directions, neighbours_of(directions))

    def spacing_rad(self, place: int) -> float:
        """Return the distance from a direction to its nearest neighbour; infinite at an edge, or if there is none."""
        fits = QuadricFits.of(self.directions, self.neighbours, np.array([place]))
        is_open = fits.are_open(np.zeros(1, np.int64), self.neighbours[[place]])
        return math.inf if is_open[0] else float(fits.width_rad[0])


def find_sound_sources(
    found: AcousticMap, *, top: int | None = 10, min_level_db: float | None = None
) -> list[SoundDirection]:
    """Return the sources of sound in an acoustic map, band by band, strongest first.

    A map shows no uncertainty, so that its sources may be noise, or side lobes where arrays are sparse. If the camera
    searched for bearings, ``AcousticMap.bearings`` has the sources that are neither, with standard deviations; `ertis
    peaks` lists these.

    Maps of CLEAN-SC and HR-CLEAN-SC hold the powers of sources, whose direction and level are those of the map. In
    other maps, a source is a local maximum, which a quadric through the neighbouring directions interpolates. Maxima
    below twice the median over all directions are left out, and with delay-and-sum, those below twice the side lobes of
    stronger sources. The strongest direction of each band is always returned, except in silence.

    `SoundDirection.grid_error_rad` states the error of directions at the edge of a grid. It is infinite if the source
    may lie beyond the grid. Angles that the array cannot observe are NaN: see `ertis_numba.geometry.observable_angles`.
    Errors are small if the main lobe is at least two spacings of the grid wide. The peaks of Capon are often narrower;
    their levels are then too low.

    Parameters
    ----------
    found : AcousticMap
    top : int, optional
        Largest number of sources in a band; 10 by default, None for all.
    min_level_db : float, optional
        Lowest level relative to the strongest source of the band; by default -10 dB, below which side lobes lie, and
        -20 dB for CLEAN-SC and HR-CLEAN-SC.

    Raises
    ------
    ArgumentError
        ``top`` is below 1, or ``min_level_db`` is above 0.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     found = ertis.AcousticCamera(recording.settings).process(recording[0])
    >>> sources = ertis.find_sound_sources(found, top=1)
    >>> len(sources) == len(found.band_hz)
    True
    """
    sources = sources_of_grid(found, top=top, min_level_db=min_level_db)
    seen = observable_angles(found.settings.array)
    is_planar = np.ptp(found.elevation_rad) == 0
    return [_observed(each, seen, is_planar=bool(is_planar)) for each in sources]


def _observed(source: SoundDirection, seen: ObservableAngles, *, is_planar: bool) -> SoundDirection:
    """Return a source without the angles that the array cannot observe."""
    azimuth_rad, elevation_rad = seen.observed_rad(source.azimuth_rad, source.elevation_rad, is_planar=is_planar)
    error_rad = math.nan if math.isnan(azimuth_rad) and math.isnan(elevation_rad) else source.grid_error_rad
    return source._replace(azimuth_rad=azimuth_rad, elevation_rad=elevation_rad, grid_error_rad=error_rad)


def sources_of_grid(
    found: AcousticMap, *, top: int | None = 10, min_level_db: float | None = None
) -> list[SoundDirection]:
    """Return the result of `find_sound_sources` with directions of the grid instead of angles that are not observed."""
    checks.instance("found", found, AcousticMap, "AcousticCamera.map returns")
    top = len(found.azimuth_rad) if top is None else checks.integer("top", top, 1)
    passive = found.settings.passive
    is_of_components = passive.traits.is_sparse
    if min_level_db is None:
        min_level_db = _MIN_COMPONENT_DB if is_of_components else _MIN_LEVEL_DB
    least = 10 ** (checks.between("min_level_db", min_level_db, -1000.0, 0.0) / 10)
    grid = _Grid.of(unit_vectors(found.azimuth_rad, found.elevation_rad))
    search = _components if is_of_components else _maxima
    delays, out = WaveDelays(found.settings), []
    for band, power in enumerate(found.power.T.astype(np.float64)):
        if found.is_silent[band]:
            continue
        highest = float(power.max(initial=0.0)) * 10 ** (MAX_RISE_DB / 10)
        loss_of = functools.partial(_loss, delays, found.band_hz[band])
        tops = sorted(search(power, grid, passive, loss_of), key=lambda each: -each.power)
        tops = [each for each in tops if each.power >= least * tops[0].power]
        outside = None if is_of_components else _outside(power, grid.directions, found.settings, found.band_hz[band])
        if is_of_components or outside is not None:
            tops = _of_doubtful_direction(tops, is_beyond=outside is not None)
        if passive.traits.is_linear and passive.traits.peak is None:  # Other side lobes differ from those of beams.
            tops = _without_side_lobes(tops, delays, found.band_hz[band], top=top, outside=outside)
        for each in tops[:top]:
            x, y, z = each.direction.tolist()
            angles_rad = math.atan2(y, x), math.asin(max(-1.0, min(1.0, z)))
            error_rad = each.width_rad / math.sqrt(12)
            listed = min(each.power, highest)
            out.append(SoundDirection.of(found, band, angles_rad, listed, error_rad))
    return out


def _loss(delays: WaveDelays, band_hz: Floats, tops: Floats, directions: Floats) -> Floats:
    """Return the powers of beams in directions relative to those of maxima near them: (place,) float64."""
    apart_s = delays(tops) - delays(directions)
    beams = np.exp(1j * _omega(band_hz) * apart_s).mean(axis=2)
    return np.asarray((np.abs(beams) ** 2).mean(axis=0).clip(_LEAST_LOSS, 1.0))


def _omega(band_hz: Floats) -> Floats:
    """Return angular frequencies of a band: (frequency, 1, 1) float64."""
    return 2 * np.pi * np.linspace(band_hz[0], band_hz[1], _FREQUENCIES)[:, None, None]


def _outside(power: Floats, directions: Floats, settings: Settings, band_hz: Floats) -> OutsideSource | None:
    """Return the source outside of a grid that explains the map of a band; None if one inside may."""
    low_hz, high_hz = band_hz.tolist()
    highest = float(power.max(initial=0.0))
    patterns = _patterns(settings, directions.tobytes(), low_hz, high_hz) if highest > 0 else None
    if patterns is None:
        return None
    values = np.maximum(power[patterns.samples] / highest, _DEEPEST)
    passive = settings.passive  # These numbers are linear in the beam pattern of a single source in noise.
    values = values ** (1 / passive.traits.order(passive))
    found = patterns.source_of(-1 / values if passive.traits.is_inverse else values)
    return None if found is None else found._replace(power=highest * found.power)


@functools.lru_cache(maxsize=16)
def _patterns(settings: Settings, grid: bytes, low_hz: float, high_hz: float) -> OutsidePatterns | None:
    """Return the patterns of sources in a band."""
    frequency_hz = np.linspace(low_hz, high_hz, _FREQUENCIES_OF_PATTERN)
    return OutsidePatterns.of(np.frombuffer(grid).reshape(-1, 3), WaveDelays(settings), frequency_hz)


def _of_doubtful_direction(tops: list[_Top], *, is_beyond: bool) -> list[_Top]:
    """Return sources with an infinite width from the first one on that may lie beyond the grid."""
    out, is_doubtful = [], is_beyond
    for each in tops:
        is_doubtful |= math.isinf(each.width_rad)
        out.append(each._replace(width_rad=math.inf) if is_doubtful else each)
    return out


def _without_side_lobes(
    tops: list[_Top], delays: WaveDelays, band_hz: Floats, *, top: int, outside: OutsideSource | None
) -> list[_Top]:
    """Return the maxima that exceed the side lobes of the stronger ones, up to a number, the strongest first."""
    delay_s = delays(np.array([each.direction for each in tops]))
    omega = _omega(band_hz)
    kept: list[int] = []
    explained = np.zeros(len(tops))

    def side_lobes(of_s: Floats, power: float) -> Floats:
        beams = np.exp(1j * omega * (delay_s - of_s)).mean(axis=2)
        return np.asarray(power * (np.abs(beams) ** 2).mean(axis=0))

    if outside is not None:
        explained += side_lobes(delays(outside.direction[None])[0], outside.power)
    for place, each in enumerate(tops):
        if len(kept) == top:
            break
        if not place or each.power >= _SIDE_LOBES * explained[place]:
            kept.append(place)
            explained += side_lobes(delay_s[place], each.power)
    return [tops[place] for place in kept]


def _components(power: Floats, grid: _Grid, *_: object) -> Iterator[_Top]:
    """Yield the directions with more power than their neighbours, from the strongest on."""
    is_left = np.ones(len(power), dtype=np.bool_)
    for place in strongest_first(power):
        if is_left[place]:
            is_left[grid.neighbours[place]] = False
            yield _Top(grid.directions[place], float(power[place]), grid.spacing_rad(place))


def _maxima(power: Floats, grid: _Grid, passive: Passive, loss_of: _LossOf) -> Iterator[_Top]:
    """Yield the interpolated local maxima above the floor of a map, and the strongest in any case."""
    around = power[grid.neighbours]
    is_first = ~((around == power[:, None]) & (grid.neighbours < np.arange(len(power))[:, None])).any(axis=1)
    is_peak = (power >= around.max(axis=1)) & is_first & (power > _FLOOR * np.median(power))
    places = np.union1d(np.flatnonzero(is_peak), int(power.argmax()))
    order = _order_of(passive)
    floor = _EDGE_OF_LOBE**order
    relative = np.clip(around[places] / np.maximum(power[places, None], _TINY), floor, 1.0)
    values = 1 - 1 / relative if passive.traits.is_inverse else np.log(relative)
    if passive.traits.is_inverse:
        fits = QuadricFits.of(grid.directions, grid.neighbours, places)
        offsets, rises = fits.tops(np.arange(len(places)), values)
        rises = -np.log(np.where(rises < 1, 1 - rises, 1.0))  # A peak may be too narrow for a quadric.
    else:  # Beyond the main lobe, the logarithm falls steeply, so weights are small there.
        fits = QuadricFits.of(grid.directions, grid.neighbours, places, relative ** (1 / order))
        offsets, rises = fits.tops(np.arange(len(places)), values)
    offsets, widths = fits.within_cells(np.arange(len(places)), offsets)
    widths = np.where(fits.are_open(np.arange(len(places)), grid.neighbours[places], values), np.inf, widths)
    tops = grid.directions[places] + offsets
    tops /= np.linalg.norm(tops, axis=1)[:, None]
    if passive.traits.has_level:  # Other numbers have no main lobe of delay-and-sum.
        rises = np.minimum(rises, order * np.log(_NOISE / loss_of(tops, grid.directions[places])))
    powers = power[places] * np.exp(rises)
    yield from (_Top(top, float(each), float(width)) for top, each, width in zip(tops, powers, widths, strict=True))


def _order_of(passive: Passive) -> float:
    """Return the main lobe of a method in decibels, relative to that of delay-and-sum."""
    return _NARROWER if passive.traits.is_inverse else passive.traits.order(passive)

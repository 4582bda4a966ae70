"""Sources of sound in acoustic maps, with directions and levels interpolated between those of the grid."""

import math
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.analysis.detect import neighbours_of
from ertis_numba.analysis.peak_interpolation import QuadricFits
from ertis_numba.frames import AcousticMap, SoundDirection
from ertis_numba.geometry import unit_vectors
from ertis_numba.passive.wave_delays import WaveDelays
from ertis_numba.settings import Passive

__all__ = ["find_sound_sources"]

Floats = NDArray[np.float64]

_COMPONENTS: Final = frozenset({"clean_sc", "hr_clean_sc"})  # Their maps hold the powers of sources, and 0 elsewhere.
_INVERSE: Final = frozenset({"capon", "music"})  # The inverses of their powers are quadratic forms, and thus smooth.
_MIN_LEVEL_DB: Final = -10.0  # Side lobes of most arrays are lower.
_MIN_COMPONENT_DB: Final = -20.0  # CLEAN-SC removes side lobes, but 1 % of a source may remain.
_FLOOR: Final = 2.0  # Lowest power of a maximum relative to the median over directions; that of noise varies less.
_SIDE_LOBES: Final = 2.0  # Lowest power of a maximum relative to predicted side lobes.
_FREQUENCIES: Final = 9  # Frequencies of a band at which side lobes are predicted.
_TINY: Final = 1e-300


class _Top(NamedTuple):
    """Source of a band, with its direction as a unit vector, (axis,) float64."""

    direction: Floats
    power: float


def find_sound_sources(
    found: AcousticMap, *, top: int | None = 10, min_level_db: float | None = None
) -> list[SoundDirection]:
    """Return the sources of sound in an acoustic map, band by band, strongest first.

    Maps of CLEAN-SC and HR-CLEAN-SC hold the powers of sources. The bins of a source may lie at neighbouring directions
    of the grid. Its power is therefore the sum over a direction and its neighbours, and its direction their mean,
    weighted by power.

    In other maps, a source is a local maximum. A quadric through the neighbouring directions interpolates its direction
    and its level. It fits the logarithm of the power, or for Capon and MUSIC its inverse. Maxima below twice the median
    over all directions belong to the floor of the map, and are left out. With delay-and-sum, so are maxima below twice
    the side lobes of stronger sources. The strongest direction of each band is always returned.

    Errors are small if the main lobe is at least two spacings of the grid wide. The peaks of Capon are often narrower;
    their levels are then too low. CLEAN-SC finds a source in each bin at a direction of the grid, with the level there.

    Parameters
    ----------
    found : AcousticMap
    top : int, optional
        Largest number of sources in a band; 10 by default, None for all.
    min_level_db : float, optional
        Lowest level relative to the strongest source of the band; by default -10 dB, below which side lobes lie, and
        -20 dB for CLEAN-SC and HR-CLEAN-SC.

    Returns
    -------
    list of SoundDirection

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
    checks.instance("found", found, AcousticMap, "AcousticCamera.map returns")
    top = len(found.azimuth_rad) if top is None else checks.integer("top", top, 1)
    passive = found.settings.passive
    method = passive.method
    if min_level_db is None:
        min_level_db = _MIN_COMPONENT_DB if method in _COMPONENTS else _MIN_LEVEL_DB
    least = 10 ** (checks.between("min_level_db", min_level_db, -1000.0, 0.0) / 10)
    directions = unit_vectors(found.azimuth_rad, found.elevation_rad)
    neighbours = neighbours_of(directions)
    search: Callable[[Floats, Floats, NDArray[np.int64], Passive], Iterator[_Top]]
    search = _components if method in _COMPONENTS else _maxima
    delays, out = WaveDelays(found.settings), []
    for band, power in enumerate(found.power.T.astype(np.float64)):
        tops = sorted(search(power, directions, neighbours, passive), key=lambda each: -each.power)
        tops = [each for each in tops if each.power >= least * tops[0].power]
        if method == "delay_and_sum":
            tops = _without_side_lobes(tops, delays, found.band_hz[band], top=top)
        for each in tops[:top]:
            x, y, z = each.direction.tolist()
            angles_rad = math.atan2(y, x), math.asin(max(-1.0, min(1.0, z)))
            out.append(SoundDirection.of(found, band, *angles_rad, power=each.power))
    return out


def _without_side_lobes(tops: list[_Top], delays: WaveDelays, band_hz: Floats, *, top: int) -> list[_Top]:
    """Return the maxima that exceed the side lobes of the stronger ones, up to a number, the strongest first."""
    delay_s = delays(np.array([each.direction for each in tops]))
    omega = 2 * np.pi * np.linspace(band_hz[0], band_hz[1], _FREQUENCIES)[:, None, None]
    kept: list[int] = []
    explained = np.zeros(len(tops))
    for place, each in enumerate(tops):
        if len(kept) == top:
            break
        if each.power >= _SIDE_LOBES * explained[place]:  # Both are 0 in silence.
            kept.append(place)
            beams = np.exp(1j * omega * (delay_s - delay_s[place])).mean(axis=2)
            explained += each.power * (np.abs(beams) ** 2).mean(axis=0)
    return [tops[place] for place in kept]


def _components(power: Floats, directions: Floats, neighbours: NDArray[np.int64], _: Passive) -> Iterator[_Top]:
    """Yield sums of powers over a direction and its neighbours, from the strongest direction on."""
    left = power.copy()
    for place in np.argsort(-power, kind="stable"):
        if not power[place]:
            break
        if not left[place]:
            continue
        around = neighbours[place]
        mean = left[around] @ directions[around]
        yield _Top(mean / np.linalg.norm(mean), float(left[around].sum()))
        left[around] = 0
    if not power.any():
        yield _Top(directions[0], 0.0)


def _maxima(power: Floats, directions: Floats, neighbours: NDArray[np.int64], passive: Passive) -> Iterator[_Top]:
    """Yield the interpolated local maxima above the floor of a map, and the strongest in any case."""
    strongest, is_inverse = int(power.argmax()), passive.method in _INVERSE
    order = passive.functional_order if passive.method == "functional" else 1
    is_peak = (power >= power[neighbours].max(axis=1)) & (power > _FLOOR * np.median(power))
    places = np.union1d(np.flatnonzero(is_peak), strongest)
    around = neighbours[places]
    weights = None
    if is_inverse:
        values = -1 / np.maximum(power, _TINY)
    else:  # Beyond the main lobe, the logarithm falls steeply, so weights are small there.
        values = np.log(np.maximum(power, _TINY))
        weights = np.maximum(power[around] / np.maximum(power[places, None], _TINY), _TINY) ** (1 / order)
    fits = QuadricFits.of(directions, neighbours, places, weights)
    offsets, rises = fits.tops(np.arange(len(places)), values[around] - values[places, None])
    for place, offset, rise in zip(places, offsets, rises, strict=True):
        top, value = directions[place] + offset, values[place] + rise
        level = float(power[place])
        if is_inverse and value < 0:  # A peak may be too narrow for a quadric.
            level = -1 / float(value)
        elif level and not is_inverse:
            level = math.exp(value)
        yield _Top(top / np.linalg.norm(top), level)

"""Grids of directions that are fine enough for acoustic maps, and to find the bearings of sources."""

import functools
import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.array_response import ToneResponse
from ertis_numba.analysis.direction_spacing import LARGEST_GRID, MAX_LOSS_DB, GridCheck, Lobe, Peak, rounded_down
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.passive.block_lengths import block_warning
from ertis_numba.passive.heard_signals import heard_bands
from ertis_numba.passive.scan_extent import is_level
from ertis_numba.passive.wave_delays import WaveDelays
from ertis_numba.settings import Settings

__all__ = ["coarse_map_warning", "search_changes", "search_warning"]

_SEARCH_LOSS_DB: Final = 6.0  # Bearings are refined beyond the grid, and so are their levels.
_LINE: Final = 1e-6  # Width of an array relative to its length, below which it is a line.
_STEP: Final = 1.02
_HALF_DEG: Final = (-90.0, 90.0)
_MOST_SEARCHED: Final = 30_000  # Directions beyond which fine ones within limits are searched instead of all.


def coarse_map_warning(settings: Settings, grid: DegreesFromRadians | None = None) -> str | None:
    """Return a warning if sources between directions of maps are too weak, or weaker than side lobes."""
    # They may lose 3 dB in all bands. The warning names a grid that suffices, or frequencies that the grid resolves.
    check = GridCheck(direction_grid(settings.processing) if grid is None else grid, settings.processing)
    found = (block_warning(settings, heard_bands(settings)), None if check.is_single else _map_warning(settings, check))
    return "; also, ".join(filter(None, found)) or None


def _map_warning(settings: Settings, check: GridCheck) -> str | None:
    """Return the warning of a grid that is too coarse for maps, or of an ambiguous array."""
    bands_hz, lobe_at = _bands_hz(settings), _lobes(settings, _map_peak(settings))
    coarse_hz = _lowest(bands_hz, lambda high_hz: check.suffices(lobe_at(high_hz)))
    found = "" if coarse_hz is None else _coarse(settings, check, lobe_at, coarse_hz, float(bands_hz.max()))
    return "; also, ".join(filter(None, (found, _ambiguity(bands_hz, check, lobe_at)))) or None


def _ambiguity(bands_hz: NDArray[np.float64], check: GridCheck, lobe_at: Callable[[float], Lobe]) -> str | None:
    """Return the warning that side lobes in the directions of a grid are as strong as the main lobe."""
    if _lowest(bands_hz, lambda high_hz: not check.is_ambiguous(lobe_at(high_hz))) is None:
        return None
    limit_hz = _highest_hz(lambda high_hz: not check.is_ambiguous(lobe_at(high_hz)), float(bands_hz.max()))
    return (
        f"above {limit_hz / 1e3:g} kHz, side lobes of this array are as strong as its main lobe, so a source may "
        f"appear in another direction on any grid; use bands_hz up to {limit_hz:g} Hz, or narrower limits of azimuth "
        "and elevation"
    )


def _coarse(
    settings: Settings, check: GridCheck, lobe_at: Callable[[float], Lobe], above_hz: float, highest_hz: float
) -> str:
    """Return the warning of a grid that is too coarse from some band upwards."""
    lobe, method = lobe_at(highest_hz), settings.passive.method
    wide = lobe._replace(peak=np.asarray)
    is_narrower = settings.passive.traits.peak is not None
    is_narrow = is_narrower and check.suffices(wide)
    text = (
        f"directions are {check.apart(lobe)} apart; above {above_hz / 1e3:.3g} kHz, a source "
        f"between them appears up to {check.loss_db(lobe)} dB too weak"
        + (f" in maps of {method}, whose peaks are narrow" if is_narrower else "")
        + ("" if check.exceeds_side_lobes(lobe) else ", or in the direction of a side lobe")
    )
    if named := check.remedy(lobe):
        return f"{text}; {named}"
    if is_narrow:
        return f"{text}; use method delay_and_sum or clean_sc for levels"
    if named := check.remedy(wide) if is_narrower else None:
        return f"{text}; {named}, and method delay_and_sum or clean_sc for levels"
    resolved_hz = _highest_hz(lambda high_hz: check.suffices(lobe_at(high_hz)), highest_hz)
    return (
        f"{text}; no grid of up to {LARGEST_GRID} directions suffices, so use narrower limits of azimuth and "
        f"elevation, or bands_hz up to {resolved_hz:g} Hz, which these directions resolve"
    )


def search_changes(settings: Settings) -> dict[str, object]:
    """Return the changes of settings with which directions suit the search for bearings; empty if none."""
    # They are a grid over all directions, or the half-space or plane that the array resolves.
    processing, limits = settings.processing, _all_directions(settings)
    contains_all = all(
        min(getattr(processing, name)) <= low and high <= max(getattr(processing, name))
        for name, (low, high) in limits.items()
    )
    is_fine = _search_warning(settings) is None
    if is_fine and contains_all and isinstance(processing.directions, str):
        return {}
    wide = settings.replace(**{f"processing.{name}": value for name, value in limits.items()})
    fine = _search_check(wide).finer(_search_lobe(wide))
    if is_fine and (fine is None or len(direction_grid(fine)) > _MOST_SEARCHED):
        return {}
    changes: dict[str, object] = {f"processing.{name}": value for name, value in limits.items()}
    return changes | {"processing.directions": f"3d:{LARGEST_GRID}" if fine is None else fine.directions}


def _all_directions(settings: Settings) -> dict[str, tuple[float, float]]:
    """Return the limits of the directions that an array can tell apart."""
    is_flat = float(np.ptp(microphones(settings.array).enabled_positions_m[:, 0])) == 0
    limits_deg = {"azimuth_limits_deg": _HALF_DEG if is_flat else (-180.0, 180.0)}
    return limits_deg if _is_line(settings) else limits_deg | {"elevation_limits_deg": _HALF_DEG}


def search_warning(settings: Settings) -> str | None:
    """Return a warning if sources between or beside the directions yield wrong bearings, or none."""
    # A source in the middle between directions may lose 6 dB, because bearings are refined beyond the grid.
    check, lobe_at = GridCheck(direction_grid(settings.processing), settings.processing), _lobes(settings, np.asarray)
    ambiguity = None if check.is_single else _ambiguity(_bands_hz(settings), check, lobe_at)
    found = (block_warning(settings, heard_bands(settings)), _search_warning(settings), ambiguity)
    return "; also, ".join(filter(None, found)) or None


def _search_warning(settings: Settings) -> str | None:
    """Return the warning of directions that do not suit the search."""
    grid = direction_grid(settings.processing)
    if is_level(unit_vectors(grid.azimuth_rad, grid.elevation_rad)) and not _is_line(settings):
        elevation_deg = math.degrees(grid.elevation_rad[0])
        return (
            f"directions lie at one elevation, {elevation_deg:g}°, so a source above or below has a wrong azimuth and "
            f"level; {_sufficient(settings)}"
        )
    check, lobe_at = GridCheck(grid, settings.processing), _lobes(settings, np.asarray, _SEARCH_LOSS_DB)
    above_hz = _lowest(_bands_hz(settings), lambda high_hz: check.suffices(lobe_at(high_hz)))
    if above_hz is None:
        return None
    return (
        f"directions are {check.apart(lobe_at(above_hz))} apart; above {above_hz / 1e3:.1f} kHz, sources between "
        f"them may have wrong bearings; {_sufficient(settings)}"
    )


def _sufficient(settings: Settings) -> str:
    """Return the advice to search a grid within the limits of settings that suffices for bearings in all bands."""
    if _is_flat(settings):
        settings = settings.replace(
            **{"processing.azimuth_limits_deg": _HALF_DEG, "processing.elevation_limits_deg": _HALF_DEG}
        )
    advice = _search_check(settings).remedy(_search_lobe(settings), "search")
    return advice or f"search narrower limits or lower bands: no grid of up to {LARGEST_GRID} directions suffices"


def _is_flat(settings: Settings) -> bool:
    """Return True if the limits of directions contain no area."""
    processing = settings.processing
    return not (
        np.ptp(processing.azimuth_limits_deg) and (_is_line(settings) or np.ptp(processing.elevation_limits_deg))
    )


def _search_check(settings: Settings) -> GridCheck:
    """Return the check of a small grid of the kind that suits the array."""
    return GridCheck.of(settings.processing.replace(directions="2d:2" if _is_line(settings) else "3d:2"))


def _search_lobe(settings: Settings) -> Lobe:
    """Return the main lobe at the upper edge of the highest band."""
    return _lobes(settings, np.asarray, _SEARCH_LOSS_DB)(float(_bands_hz(settings).max()))


def _bands_hz(settings: Settings) -> NDArray[np.float64]:
    """Return the edges of the bands from low to high frequencies: (band, 2) float64."""
    return np.sort(heard_bands(settings), axis=0)  # They do not overlap.


def _lowest(bands_hz: NDArray[np.float64], is_fine: Callable[[float], bool]) -> float | None:
    """Return the lower edge of the first band whose upper edge is not fine; None if all are."""
    if is_fine(float(bands_hz[-1, 1])):
        return None
    fine, coarse = -1, len(bands_hz) - 1
    while coarse - fine > 1:
        middle = (fine + coarse) // 2
        fine, coarse = (middle, coarse) if is_fine(float(bands_hz[middle, 1])) else (fine, middle)
    return float(bands_hz[coarse, 0])


def _highest_hz(is_fine: Callable[[float], bool], highest_hz: float) -> float:
    """Return the highest frequency that is fine, with two digits."""
    coarse, fine = 0, 1 + math.ceil(math.log(highest_hz) / math.log(_STEP))  # Numbers of steps below the highest.
    while fine - coarse > 1:
        middle = (fine + coarse) // 2
        is_low = is_fine(rounded_down(highest_hz / _STEP**middle))
        coarse, fine = (coarse, middle) if is_low else (middle, fine)
    return rounded_down(highest_hz / _STEP**fine)


def _lobes(settings: Settings, peak: Peak, max_loss_db: float = MAX_LOSS_DB) -> Callable[[float], Lobe]:
    """Return a function that returns the main lobe at a frequency in hertz."""
    delays = WaveDelays(settings)
    return functools.cache(lambda frequency_hz: Lobe(ToneResponse(settings, frequency_hz, delays), peak, max_loss_db))


def _map_peak(settings: Settings) -> Peak:
    """Return the function from amplitudes of delay-and-sum to those of the method of maps, for one source.

    ``ρ²`` becomes ``(M ρ² − 1) / (M − 1)`` without the diagonal, or the `MapMethod.peak` of the method.
    """
    passive, n_mics = settings.passive, len(microphones(settings.array).enabled_positions_m)

    def peak(rho: NDArray[np.float64]) -> NDArray[np.float64]:
        power = np.clip(rho, 0.0, 1.0) ** 2
        if passive.diagonal_removal:
            power = np.maximum(n_mics * power - 1, 0.0) / max(n_mics - 1, 1)
        elif (narrower := passive.traits.peak) is not None:
            power = narrower(power, n_mics, passive)
        return np.asarray(np.sqrt(power))

    return peak


def _is_line(settings: Settings) -> bool:
    """Return True if microphones lie on a horizontal line, which resolves one angle."""
    places_m = microphones(settings.array).enabled_positions_m
    sizes = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)
    height_m = float(np.ptp(places_m[:, 2]))
    return bool(max([*sizes[1:], height_m]) <= _LINE * sizes[0])

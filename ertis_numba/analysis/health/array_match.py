"""Comparison of the strongest arrival with other arrays: other layouts, orders, sizes, and converters out of step.

Tolerances of microphones spread the arrival over all candidates alike, so that the ratio of their residuals decides.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.arrival import Compressed, strongest
from ertis_numba.analysis.health.not_observable import KNOWN_PLACE, ORDER, SCALE, SEVERAL_ECHOES, TURNED, NotObservable
from ertis_numba.analysis.health.other_orders import other_orders, spreads_s
from ertis_numba.analysis.health.report import Finding
from ertis_numba.analysis.health.wave_shapes import CURVATURES, curved_m, fit_curved, places_of
from ertis_numba.geometry import Layout, layout_names, load_layout

__all__ = ["ARRAY_FAULTS", "MISFIT", "SIGNS", "SIZE", "find_other_array", "is_misfit", "unobservable"]

_HALF: Final = "half late"
SIGNS: Final = "opposite signs"
MISFIT: Final = "misfit of the array"
SIZE: Final = "size of the array"
ARRAY_FAULTS: Final = frozenset({MISFIT, ORDER, SIGNS, _HALF, SIZE})
"""Faults of the array as a whole."""

_MAX_MICS_OF_ORDERS: Final = 16
_MIN_SPARE: Final = 2  # Channels beyond the unknowns of a fit.
_CHANCE: Final = 1e-3  # Probability that one of the alternatives fits the errors of few channels.
_MIN_SPARE_OF_SIZE: Final = 4  # The curvature is one more unknown, whose error must be known, too.
_EQUAL: Final = 1e-3  # Deviation of a layout from a multiple of another one, relative to its size.
_MIN_CURVED: Final = 3.0  # Residuals with the curvature of an echo relative to those with the best curvature.
_MIN_RATIO: Final = 5.0  # Residuals of the array in use relative to those of another one.
_MIN_SPREAD_S: Final = 0.3e-6  # Residuals below it are errors of the times.
_MIN_RESIDUAL_S: Final = 0.02e-6  # Errors of times are never smaller.
_KEPT: Final = 0.9  # Share of the microphones whose residuals count, so that a single one does not decide.
_WIDE_S: Final = 0.4e-3  # Delay across the largest shipped layout, on either side.
_WIDER: Final = 12.0  # Centimetres in place of millimetres delay sound ten times as much.
_MAX_SLOWNESS: Final = 1.1  # Slowness across the array relative to that of sound; a larger one is impossible.
_MIN_EXCLUDED: Final = 4.0  # Residuals of an order that an arrival excludes, relative to those of the given one.
_CLEAR: Final = 0.05  # Residuals of a clear arrival relative to its delays across the array.
_DEVIATIONS: Final = 8.0
_DELAY_SD_S: Final = 3e-6  # Standard deviation of the delays of microphones.
_UNLIKELY: Final = 3.7  # Deviation of a normal distribution that one of 10,000 arrays exceeds.
# Limits of the size relative to the given one; a record that begins before the emission explains a larger one, too.
_MAX_GROWTH: Final = 2.5
_MIN_SHRINKAGE: Final = 0.67
_ITERATIONS: Final = 6
_LEAST_CURVATURE: Final = 1e-3


@dataclass(frozen=True, slots=True)
class _Match:
    """Fit of a wavefront to times of arrival, with the RMS of the residuals without the largest ones."""

    spread_s: float
    slowness: float
    delay_s: float = 0.0
    n_spare: int = 0


def unobservable(
    times_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    path_m: float,
    speed_m_s: float,
    *,
    is_direct: bool = False,
) -> tuple[NotObservable, ...]:
    """Return the faults of an array that an arrival cannot reveal, with the reasons."""
    n_mics, n_unknowns = len(positions_m), 1 + places_of(positions_m).shape[1]
    n_spare = _kept(n_mics, n_unknowns) - n_unknowns
    if n_mics < 2:
        return ()
    few = f"{n_mics} microphones are too few"
    found = [_hidden("they fit every echo as well", TURNED)]
    if n_spare < _MIN_SPARE:
        return _hidden(few, ORDER, SCALE, "delay of channels"), *found
    if n_spare < _MIN_SPARE_OF_SIZE:
        found.insert(0, _hidden(f"{few} to detect even a wrong unit", SCALE))
    if n_spare >= _MIN_SPARE_OF_SIZE and not is_direct:
        found.insert(0, _hidden("an echo fits arrays of about half to twice the size equally well", SCALE))
    orders = _by_order(times_s)
    if len(orders):
        own_s, *others_s = spreads_s(np.stack([times_s, *orders]), positions_m, path_m, speed_m_s)
        limit_s = max(_MIN_SPREAD_S, _MIN_EXCLUDED * own_s)
        names = [name for name, _ in other_orders(n_mics)]
        cases = tuple(name for name, other_s in zip(names, others_s, strict=True) if other_s < limit_s)
        if cases:
            reason = "other orders fit this arrival about as well"
            found.insert(0, NotObservable(faults=(ORDER,), reason=reason, remedy=SEVERAL_ECHOES, cases=cases))
    return tuple(found)


def _hidden(reason: str, *faults: str) -> NotObservable:
    return NotObservable(faults=faults, reason=reason, remedy=KNOWN_PLACE)


def _named_orders(count: int) -> list[str]:
    """Return the names of other orders that may fit; none for many channels, as single ones reveal their order."""
    return [name for name, _ in other_orders(count)] if count <= _MAX_MICS_OF_ORDERS else []


def _by_order(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the times of arrival in other orders of the channels: (order, mic) float64."""
    orders = other_orders(len(times_s))
    return times_s[np.array([order for _, order in orders])] if orders else np.zeros((0, len(times_s)))


def find_other_array(
    found: Compressed,
    times_s: NDArray[np.float64],
    channels: Sequence[int],
    layout: Layout,
    path_m: float,
    speed_m_s: float,
    *,
    is_near: bool = False,
) -> Finding | None:
    """Return the finding of an array that fits the strongest arrival much better than the layout; None without one."""
    picked = list(channels)
    own = _best(times_s, layout.positions_m[picked], path_m, speed_m_s)
    every = [times_s]
    if own is None or own.spread_s >= _MIN_SPREAD_S or own.slowness > _MAX_SLOWNESS:
        # The sound may take longer across the array than its positions suggest.
        across_s = float(2 * np.linalg.norm(layout.positions_m[picked], axis=1).max()) / speed_m_s
        wide = (strongest(found, width_s) for width_s in (_WIDE_S, _WIDER * across_s))
        every += [arrived[0] - layout.delay_s[picked] for arrived in wide if arrived is not None]
    for check in (_other_order, _other_size_of_direct_sound if is_near else _other_size):
        for times in every[::-1]:
            if np.ptp(times) < _MIN_SPREAD_S:  # Equal in all channels, as a disturbance: no direction.
                continue
            finding = check(times, picked, layout, path_m, speed_m_s)
            if finding is not None:
                return finding
    return None


def _other_order(
    times_s: NDArray[np.float64], channels: list[int], layout: Layout, path_m: float, speed_m_s: float
) -> Finding | None:
    """Return the finding of another order, layout or size, or of a late half, if it fits much better."""
    own = _best(times_s, layout.positions_m[channels], path_m, speed_m_s)
    if own is None or own.spread_s < _MIN_SPREAD_S:
        return None
    found = list(_alternatives(times_s, channels, layout, path_m, speed_m_s))
    better, count = [], len(channels)
    for fault, name, match in found:
        # Residuals of n spare channels are r times as small in one of r^n cases. Channels left out are more cases.
        cases = (len(found) + len(_named_orders(count))) * math.comb(count, count - _kept(count, 1)) / _CHANCE
        limit_s = own.spread_s / max(_MIN_RATIO, cases ** (1 / max(1, match.n_spare)))
        if match.slowness <= _MAX_SLOWNESS and max(match.spread_s, _MIN_RESIDUAL_S) < limit_s:
            better.append((match.spread_s, fault, name, match, limit_s))
    if not better:
        return None
    # Several names may mean one order.
    spread_s, fault, name, match, limit_s = min(better, key=lambda each: round(each[0], 9))
    if fault == SIZE:
        return _of_size(channels, 1 / (_multiple(layout)[1] or 1.0), layout)
    measured_s, detail = match.delay_s, f"{name} by {1e6 * match.delay_s:.1f} µs"
    if fault == ORDER:
        residuals = f"{1e6 * spread_s:.2g} instead of {1e6 * own.spread_s:.2g} µs"
        measured_s = own.spread_s
        detail = f"{name} fits far better than that of the settings, with residuals of {residuals}"
    return Finding(fault=fault, channels=tuple(channels), measured=1e6 * measured_s, limit=1e6 * limit_s, detail=detail)


def _alternatives(
    times_s: NDArray[np.float64], channels: list[int], layout: Layout, path_m: float, speed_m_s: float
) -> Iterator[tuple[str, str, _Match]]:
    """Yield the faults of arrays that may fit, their names, and their fits."""
    multiple_of, _ = _multiple(layout)
    for name, other_m in _orders(layout):
        match = _best(times_s, other_m[channels], path_m, speed_m_s)
        if match is not None:
            yield SIZE if name == multiple_of else ORDER, name, match
    count = len(channels)
    if count == len(layout.enabled) and (names := _named_orders(count)):
        orders = _by_order(times_s)
        positions_m = layout.positions_m[channels]
        best = int(np.argmin(spreads_s(orders, positions_m, path_m, speed_m_s)))
        match = _best(orders[best], positions_m, path_m, speed_m_s)
        if match is not None:
            yield ORDER, names[best], match
    for name, late in _halves(len(layout.enabled)):
        match = _best(times_s, layout.positions_m[channels], path_m, speed_m_s, late=late[channels])
        if match is not None:
            yield _HALF, name, match


def _other_size(
    times_s: NDArray[np.float64], channels: list[int], layout: Layout, path_m: float, speed_m_s: float
) -> Finding | None:
    """Return the finding of positions in another unit, by the slowness or the curvature of a clear wavefront."""
    positions_m = layout.positions_m[channels]
    own = _best(times_s, positions_m, path_m, speed_m_s)
    if own is None:
        return None
    if own.n_spare < _MIN_SPARE_OF_SIZE:
        return None
    low, high, spread_s = _scales(times_s, positions_m, path_m, speed_m_s)
    is_possible = own.slowness <= _MAX_SLOWNESS
    if spread_s > _CLEAR * float(np.ptp(times_s)) or (is_possible and own.spread_s < _MIN_CURVED * spread_s):
        return None
    is_plane = low == 0.0  # Waves from far away are flat, too, and fit an array of any size.
    low = max(low, own.slowness)
    if is_possible and low <= _MAX_GROWTH and (is_plane or high >= _MIN_SHRINKAGE):
        return None
    factor, about = (low, "at least ") if low > 1 else (high, "at most ")
    return _of_size(channels, factor, layout, about)


def _other_size_of_direct_sound(
    times_s: NDArray[np.float64], channels: list[int], layout: Layout, path_m: float, speed_m_s: float
) -> Finding | None:
    """Return the finding of positions in another unit, if the sound of an emitter at the centre fits another size."""
    own = _best(times_s, layout.positions_m[channels], path_m, speed_m_s)
    travel_s = np.linalg.norm(layout.positions_m[channels], axis=1) / speed_m_s
    if own is None or own.spread_s < _MIN_SPREAD_S or np.ptp(travel_s) < _MIN_SPREAD_S:
        return None
    solution, spread_s = _solve(times_s, np.column_stack([np.ones(len(travel_s)), travel_s]))
    factor = float(solution[1])
    is_clear = spread_s < min(own.spread_s / _MIN_RATIO, _CLEAR * float(np.ptp(times_s)))
    if not is_clear or _MIN_SHRINKAGE < factor < 1 / _MIN_SHRINKAGE or factor <= 0:
        return None
    return _of_size(channels, factor, layout)


def _of_size(channels: list[int], factor: float, layout: Layout, about: str = "") -> Finding:
    """Return the finding of an array of another size, which may be that of a shipped layout."""
    name, given = _multiple(layout)
    detail = f"the wavefront fits an array {about}{factor:.2g} times as large"
    if given is not None:
        detail = f"the positions are those of {name} times {given:.3g}"
    return Finding(
        fault=SIZE,
        channels=tuple(channels),
        measured=factor,
        limit=_MAX_SLOWNESS if factor > 1 else _MIN_SHRINKAGE,
        detail=detail,
    )


def _best(
    times_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    path_m: float,
    speed_m_s: float,
    *,
    late: NDArray[np.bool_] | None = None,
) -> _Match | None:
    """Return the best fit of a reflector, a wall or the direct sound; None if the array has too few microphones."""
    places_m = places_of(positions_m)
    n_axes = places_m.shape[1]
    n_unknowns = 1 + n_axes + (late is not None)
    if n_axes == 0 or _kept(len(positions_m), n_unknowns) < n_unknowns + _MIN_SPARE:
        return None
    n_spare = _kept(len(positions_m), n_unknowns) - n_unknowns
    columns = [np.ones(len(places_m)), *places_m.T] + ([] if late is None else [late.astype(np.float64)])
    matrix, matches = np.column_stack(columns), []
    for curvature in CURVATURES:
        flat_s = fit_curved(
            times_s,
            positions_m,
            curvature / path_m,
            speed_m_s,
            lambda flat_s: _solve(flat_s, matrix)[0][1 : 1 + n_axes],
        )
        solution, spread_s = _solve(flat_s, matrix)
        slowness = float(np.linalg.norm(solution[1 : 1 + n_axes])) * speed_m_s
        matches.append(_Match(spread_s, slowness, 0.0 if late is None else float(solution[-1]), n_spare))
    travel_s = np.linalg.norm(positions_m, axis=1) / speed_m_s
    of_emitter = matrix[:, [0] if late is None else [0, -1]]
    solution, spread_s = _solve(times_s - travel_s, of_emitter)
    matches.append(_Match(spread_s, 0.0, 0.0 if late is None else float(solution[-1]), n_spare + n_axes))
    return min(matches, key=lambda match: match.spread_s)


def is_misfit(times_s: NDArray[np.float64], positions_m: NDArray[np.float64], path_m: float, speed_m_s: float) -> bool:
    """Return True if no wavefront fits times of arrival as well as tolerances of microphones permit."""
    best = _best(times_s, positions_m, path_m, speed_m_s)
    if best is None:
        return False
    # E. B. Wilson and M. M. Hilferty, The distribution of chi-square, Proc. Natl. Acad. Sci. 17, 1931.
    share = 2 / (9 * best.n_spare)
    limit_s: float = _DELAY_SD_S * (1 - share + _UNLIKELY * math.sqrt(share)) ** 1.5
    return best.spread_s > limit_s


def _kept(n_mics: int, n_unknowns: int) -> int:
    """Return the number of microphones whose residuals count."""
    return min(n_mics, max(n_unknowns + 1, round(_KEPT * n_mics)))


def _solve(times_s: NDArray[np.float64], matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the solution by least squares without the largest residuals, and the root mean square of the others."""
    count = _kept(len(times_s), matrix.shape[1])
    kept = np.arange(len(times_s))
    for _ in range(3):
        solution = np.linalg.lstsq(matrix[kept], times_s[kept], rcond=None)[0]
        kept = np.argsort(np.abs(times_s - matrix @ solution))[:count]
    residual_s = (times_s - matrix @ solution)[kept]
    return np.asarray(solution), float(np.sqrt(np.sum(residual_s**2) / max(1, count - matrix.shape[1])))


def _scales(
    times_s: NDArray[np.float64], positions_m: NDArray[np.float64], path_m: float, speed_m_s: float
) -> tuple[float, float, float]:
    """Return the range of the true size relative to the given one by the curvature of the wavefront, and its residual.

    A wavefront whose source is a path P away has the curvature 1 / P, or 2 / P after a reflector of half the path.
    Positions that are too small by k have a curvature that is too large by k squared.
    """
    places_m, curvature = places_of(positions_m), 1 / path_m
    slope_m, bent_m = np.zeros(len(places_m)), np.zeros(len(places_m))
    for _ in range(_ITERATIONS):
        step = 0.01 * curvature
        bent_m = curved_m(positions_m, slope_m, curvature)
        change_s = (curved_m(positions_m, slope_m, curvature + step) - bent_m) / step / speed_m_s
        matrix = np.column_stack([np.ones(len(places_m)), places_m, change_s])
        solution, spread_s = _solve(times_s - bent_m / speed_m_s, matrix)
        error = _DEVIATIONS * spread_s * float(np.sqrt(np.linalg.pinv(matrix.T @ matrix)[-1, -1]))
        slope_m = places_m @ solution[1:-1] * speed_m_s
        estimate = curvature + float(solution[-1])
        curvature = min(
            max(estimate, _LEAST_CURVATURE / path_m), 0.5 / float(np.linalg.norm(positions_m, axis=1).max())
        )
    low, high = max(0.0, estimate - error), max(0.0, estimate + error)
    return float(np.sqrt(low * path_m / CURVATURES[1])), float(np.sqrt(high * path_m / CURVATURES[0])), spread_s


def _orders(layout: Layout) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield the channel positions for common orders: shipped layouts, and words with reversed bits or bytes."""
    count = len(layout.enabled)
    yield "the reversed order", layout.positions_m[::-1]
    if count % 8 == 0:
        yield "the order of reversed bits in each byte", layout.positions_m[np.arange(count) ^ 7]
        yield "the order of reversed bytes", layout.positions_m[np.arange(count).reshape(-1, 8)[::-1].ravel()]
    if count % 2 == 0:
        yield "the order of swapped halves", np.roll(layout.positions_m, count // 2, axis=0)
        yield "the order of swapped neighbours", layout.positions_m[np.arange(count) ^ 1]
    for name in layout_names():
        other = load_layout(name)
        same = len(other.enabled) == count and np.allclose(other.positions_m, layout.positions_m, atol=1e-6)
        if len(other.enabled) == count and not same:
            yield f"layout {name}", other.positions_m


def _multiple(layout: Layout) -> tuple[str, float | None]:
    """Return the shipped layout whose multiple the positions are, and the factor; no name and None without one."""
    positions_m = layout.positions_m
    for name in layout_names():
        other_m = load_layout(name).positions_m
        if other_m.shape != positions_m.shape:
            continue
        factor = float(np.sum(positions_m * other_m) / np.sum(other_m**2))
        is_multiple = np.abs(positions_m - factor * other_m).max() < _EQUAL * np.abs(positions_m).max()
        if is_multiple and factor > 0 and abs(factor - 1) > _EQUAL:
            return f"layout {name}", factor
    return "", None


def _halves(count: int) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the channels of one of two converters, which share the channels by halves or alternately."""
    channel = np.arange(count)
    yield f"channels {count // 2} to {count - 1} are late", channel >= count // 2
    yield "channels with odd numbers are late", channel % 2 == 1

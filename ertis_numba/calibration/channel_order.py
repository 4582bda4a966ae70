"""Order of the channels: swapped channels, and channels in another known order."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.calibration.wavefronts import Target, locate_source, travel_times
from ertis_numba.geometry import Layout, layout_names, load_layout

__all__ = ["Permutation", "find_order", "find_swaps"]

_MAX_OFFSET_S: Final = 12e-6  # Delay of a channel that still counts as its own; it is subtracted from its residuals.
_MIN_MISFIT_S: Final = 3e-6  # Least misfit of a channel at its own position; errors of 1 mm cause half of it.
_MIN_RATIO: Final = 3.0  # Least ratio of the misfits at the own and at the other position.
_SCALE_S: Final = 5e-6
_MIN_SHARE: Final = 0.85  # Share of the microphones that another order must fit.
_MIN_RECORDS: Final = 3  # With fewer recordings, a delay and another position cannot be distinguished.


@dataclass(frozen=True, slots=True, eq=False)
class Permutation:
    """Positions at which channels fit."""

    place: NDArray[np.int64]  # (mic,) index of the position in the layout; place[i] == i where it is right
    misfit_s: NDArray[np.float64]  # (mic,) root-mean-square residual at the own position, without its mean

    def cycles(self) -> list[tuple[int, ...]]:
        """Return the groups of microphones that exchanged places; a pair is a swap."""
        left, found = set(np.flatnonzero(self.place != np.arange(len(self.place))).tolist()), []
        while left:
            cycle = [min(left)]
            while (following := int(self.place[cycle[-1]])) != cycle[0]:
                cycle.append(following)
            left -= set(cycle)
            found.append(tuple(cycle))
        return found


def find_swaps(
    time_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    source_m: NDArray[np.float64],
    speed_m_s: NDArray[np.float64],
    target: Target,
) -> Permutation:
    """Find microphones whose sounds arrive as they would at the positions of others; NaN times are left out."""
    # The assignment of least total squares (H. W. Kuhn, 1955) counts where the own position fits badly and another
    # well.
    n_mics = len(positions_m)
    place = np.arange(n_mics)
    misfit_s = np.zeros(n_mics)
    if len(time_s) < _MIN_RECORDS:
        return Permutation(place, misfit_s)
    source_m = np.array(source_m)
    for _ in range(2):  # Once swaps are known, the sources are located better.
        for record in range(len(time_s)):
            seen = np.isfinite(time_s[record])
            source_m[record] = locate_source(
                time_s[record, seen],
                positions_m[place][seen],
                source_m[record],
                float(speed_m_s[record]),
                target,
                scale_s=_SCALE_S,
            )
        cost = _costs(time_s, travel_times(source_m, positions_m, speed_m_s, target).time_s)
        known = np.flatnonzero(np.isfinite(time_s).any(axis=0))
        rows, columns = scipy.optimize.linear_sum_assignment(cost[np.ix_(known, known)])
        best = np.arange(n_mics)
        best[known[rows]] = known[columns]
        own, other = cost[np.arange(n_mics), np.arange(n_mics)], cost[np.arange(n_mics), best]
        misfit_s = np.sqrt(own)
        wrong = (misfit_s > _MIN_MISFIT_S) & (misfit_s > _MIN_RATIO * np.sqrt(other))
        place = np.arange(n_mics)
        for cycle in Permutation(best, misfit_s).cycles():
            if wrong[list(cycle)].all():
                place[list(cycle)] = best[list(cycle)]
    return Permutation(place, misfit_s)


def _costs(time_s: NDArray[np.float64], expected_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean square residual of each microphone at each position: (mic, mic) float64."""
    apart_s = time_s[:, :, None] - expected_s[:, None, :]
    with np.errstate(invalid="ignore"):
        common_s = np.nan_to_num(np.nanmean(apart_s, axis=0)) if len(apart_s) else 0.0
    apart_s = np.nan_to_num(apart_s - np.clip(common_s, -_MAX_OFFSET_S, _MAX_OFFSET_S))
    # A few wrong times, such as those of another echo, must not decide.
    middle_s2 = np.sort(apart_s**2, axis=0)[: max(1, int(0.8 * len(apart_s)))]
    return np.asarray(middle_s2.mean(axis=0))


def find_order(
    shares: Callable[[NDArray[np.float64]], float], layout: Layout
) -> tuple[str, NDArray[np.float64]] | None:
    """Find an order of the channels, or a shipped layout, by the share of microphones that wavefronts fit."""
    candidates = [(name, layout.positions_m[order]) for name, order in _known_orders(len(layout.enabled)).items()]
    for name in layout_names():
        other = load_layout(name)
        if len(other.enabled) == len(layout.enabled) and other.enabled.all():
            candidates.append((f"layout {name}", other.positions_m))
    found = [(shares(positions_m), name, positions_m) for name, positions_m in candidates]
    share, name, positions_m = max(found, key=lambda item: item[0])
    return (name, positions_m) if share >= _MIN_SHARE else None


def _known_orders(n_channels: int) -> dict[str, NDArray[np.int64]]:
    """Return orders in which words or cables often deliver channels: name, and position of each channel."""
    channels = np.arange(n_channels)
    orders = {"the reversed order": channels[::-1].copy()}
    if n_channels % 8 == 0:
        orders["the order of reversed bits in each byte"] = channels ^ 7
        orders["the order of reversed bytes"] = channels.reshape(-1, 8)[::-1].ravel()
    if n_channels % 2 == 0:
        orders["the order of swapped halves"] = np.roll(channels, n_channels // 2)
        orders["the order of swapped neighbours"] = channels ^ 1
    return orders

"""Time of the emission according to the direct sound, which passes the array as a sphere around the emitter."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.limits import MAX_SHIFT_S

__all__ = ["describe_shift", "fit_emission"]

_SPARE: Final = 2  # Minimum number of microphones beyond the unknowns of the fit.
_MAX_DEVIATION: Final = 0.2  # of the sphere's share from 1, and of the slope from 0; echoes have a share near 0.
_MAX_SHARE_SD: Final = 0.05
_MIN_DEPTH_S: Final = 5e-6  # Minimum extent of the sphere that a plane wave does not have; a ring has none.
_OUTLIER: Final = 6.0  # Residual of a faulty channel relative to the median.
_MIN_RESIDUAL_S: Final = 1e-6
_DRIFT_S: Final = 50e-6  # Difference of emission times that a clock or a trigger causes.


def fit_emission(times_s: NDArray[np.float64], positions_m: NDArray[np.float64], speed_m_s: float) -> float | None:
    """Return the time at which the emitter at the array's centre emitted an arrival; None if it may be an echo."""
    # The times are a plane wave and a multiple of the distances from the centre: 1 for direct sound, near 0 for echoes.
    _, extent, axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=False)
    plane_s = positions_m @ axes[extent > 1e-3 * max(float(extent[0]), 1e-9)].T / speed_m_s
    sphere_s = np.linalg.norm(positions_m, axis=1) / speed_m_s
    matrix = np.column_stack([sphere_s, plane_s, np.ones(len(times_s))])
    used = np.ones(len(times_s), bool)
    for _ in range(2):
        rows, unknowns = int(used.sum()), matrix.shape[1]
        others = matrix[used, 1:]
        depth_s = sphere_s[used] - others @ np.linalg.lstsq(others, sphere_s[used], rcond=None)[0]
        if rows < unknowns + _SPARE or float(np.std(depth_s)) < _MIN_DEPTH_S:
            return None
        found = np.linalg.lstsq(matrix[used], times_s[used], rcond=None)[0]
        residual_s = np.abs(times_s - matrix @ found)
        share_sd = float(np.sqrt(np.sum(residual_s[used] ** 2) / (rows - unknowns) / np.sum(depth_s**2)))
        used &= residual_s <= _OUTLIER * max(float(np.median(residual_s[used])), _MIN_RESIDUAL_S)
    is_sphere = abs(found[0] - 1) < _MAX_DEVIATION and share_sd < _MAX_SHARE_SD
    if not is_sphere or float(np.linalg.norm(found[1:-1])) > _MAX_DEVIATION:
        return None
    return float(np.median((times_s - sphere_s)[used]))


def describe_shift(late_s: Sequence[float], speed_m_s: float, *, delay_s: float = 0.0) -> tuple[str, str] | None:
    """Return a text about records that begin at other times than the emission, and a remedy; None if none do."""
    if not late_s:
        return None
    first_s, last_s, middle_s = min(late_s), max(late_s), float(np.median(late_s))
    if last_s - first_s > _DRIFT_S:
        text = (
            f"the direct sound drifts from {_side(first_s)} to {_side(last_s)} than the distance of the emitter "
            f"allows; ranges are wrong by up to {_centimetres(max(abs(first_s), abs(last_s)), speed_m_s)}"
        )
        imported = "import again with --sync-channel, or with the exact time between emissions (--length)"
        return text, f"trigger each record by its emission, or {imported}"
    if abs(middle_s) <= MAX_SHIFT_S:
        return None
    text = (
        f"the direct sound arrives {_side(middle_s)} than the distance of the emitter allows; all ranges are "
        f"{_centimetres(abs(middle_s), speed_m_s)} too {'large' if middle_s > 0 else 'small'}"
    )
    return text, _remedy(middle_s, delay_s)


def _remedy(late_s: float, delay_s: float) -> str:
    if delay_s + late_s < 0:
        return f"start recording {-1e3 * late_s:.3g} ms earlier, or import again with a smaller --skip"
    change = f"{'increased' if late_s > 0 else 'reduced'} by {round(abs(late_s), 6):g}"
    return f"set call.delay_s = {round(delay_s + late_s, 6):g} in the settings, or import again with --skip {change}"


def _side(late_s: float) -> str:
    return f"{round(1e3 * abs(late_s), 3):.3g} ms {'later' if late_s >= 0 else 'earlier'}"


def _centimetres(time_s: float, speed_m_s: float) -> str:
    return f"{1e2 * time_s * speed_m_s / 2:.3g} cm"

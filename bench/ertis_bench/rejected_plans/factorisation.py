"""Products per bin of an image for direct sums, a beam grid of the whole array, and beam grids of sub-arrays.

This module counts operations and measures no times. The count is the smallest number of real products among the beam
grids with an error of at most -36 dB. It includes arrays that do not exist.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench.markdown import or_dash, table
from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.settings import Processing, Settings
from ertis_numba.stages.beam_grid import Aperture, BeamGrid
from ertis_numba.stages.error_model import decibels
from ertis_numba.stages.interpolation_fit import one_thread
from ertis_numba.stages.plan_elements import spectrum_of

__all__ = ["CASES", "FORMS", "form", "run"]

CASES = (
    (32, "3000"),
    (32, "3d:30000"),
    (64, "3000"),
    (128, "3000"),
    (256, "3000"),
    (256, "3d:30000"),
    (1024, "3000"),
    (1024, "3d:30000"),
)
_PARTS = (1, 2, 4, 8)
_ERROR_DB = -36.0
_DELAY_TAPS = 2
_COMPLEX, _REAL = 4, 2  # real products of a complex number with a complex and with a real weight
_NODES = {2: (1.5, 2.0, 2.5, 3.0, 4.0), 4: (1.25, 1.5, 1.75, 2.0)}  # beam densities by number of taps


def run(*, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the counts.

    Arrays larger than eRTIS have its density of microphones, at random positions.
    """
    settings = Settings.from_preset("default_25_50")
    rows = []
    for n_mics, directions in CASES:
        say(f"{n_mics} microphones, {directions} directions")
        grid = direction_grid(Processing(directions=directions))
        units = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        positions_m = _array(settings, n_mics)
        rows.append(
            {
                "microphones": n_mics,
                "directions": len(grid),
                "direct": n_mics * _DELAY_TAPS * _COMPLEX,
                "parts": {str(n): _fewest_products(settings, _sub_arrays(positions_m, n), units) for n in _PARTS},
            }
        )
    return {"error_db": _ERROR_DB, "delay_taps": _DELAY_TAPS, "rows": rows}


def _array(settings: Settings, n_mics: int) -> NDArray[np.float64]:
    own_m = microphones(settings.array).enabled_positions_m
    if n_mics == len(own_m):
        return own_m
    half_m = np.ptp(own_m, axis=0) / 2 * np.sqrt(n_mics / len(own_m))
    return np.random.default_rng(1).uniform(-half_m, half_m, (n_mics, 3))


def _sub_arrays(positions_m: NDArray[np.float64], n_parts: int) -> list[NDArray[np.float64]]:
    """Return sub-arrays with equal numbers of microphones, cut across the longer side."""
    parts = [positions_m]
    while len(parts) < n_parts:
        parts = [half for part in parts for half in _halves(part)]
    return parts


def _halves(part_m: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    order = np.argsort(part_m[:, np.argmax(np.ptp(part_m, axis=0))])
    yield part_m[order[: len(order) // 2]]
    yield part_m[order[len(order) // 2 :]]


def _fewest_products(settings: Settings, parts: list[NDArray[np.float64]], units: NDArray[np.float64]) -> int | None:
    """Return the smallest number of products per bin that keeps the error, or None if no beam grid does."""
    counts = []
    for n_taps, densities in _NODES.items():
        for density in densities:
            node_products = [_node_products(settings, part, units, n_taps, density) for part in parts]
            if None in node_products:
                continue
            near = n_taps**2
            # The second sum delays the beams of sub-arrays, as the first sum delays signals.
            second = near * _REAL if len(parts) == 1 else len(parts) * near * _DELAY_TAPS * _COMPLEX
            counts.append(round(sum(filter(None, node_products)) / len(units)) + second)
            break  # Denser grids cost more.
    return min(counts, default=None)


def _node_products(
    settings: Settings, part_m: NDArray[np.float64], units: NDArray[np.float64], n_taps: int, density: float
) -> int | None:
    """Return the products for a sub-array's beam grid at one range, or None if its error is too large."""
    aperture = Aperture.of(part_m - part_m.mean(axis=0), units)
    high_hz, speed_m_s = settings.call.high_frequency_hz, sound_speed_m_s(settings.air)
    with one_thread():
        nodes = BeamGrid(
            aperture,
            spectrum_of(settings),
            n_taps=n_taps,
            density=density,
            high_hz=high_hz,
            sound_speed_m_s=speed_m_s,
            estimate=True,
        )
    if decibels(float(np.mean(nodes.errors))) > _ERROR_DB:
        return None
    count = aperture.count_grid_points(aperture.spacing(density, high_hz=high_hz, sound_speed_m_s=speed_m_s), n_taps)
    return count * len(part_m) * _DELAY_TAPS * _COMPLEX


def form(report: dict[str, Any]) -> str:
    """Return products per bin for direct sums, a beam grid of the whole array, and beam grids of its parts."""
    parts = list(report["rows"][0]["parts"])
    head = ["microphones", "directions", "no beam grid", "beam grid of the whole array"]
    head += [f"of {n} sub-arrays" for n in parts[1:]]
    rows = [
        [str(row["microphones"]), str(row["directions"]), str(row["direct"])]
        + [or_dash(row["parts"][n], 0) for n in parts]
        for row in report["rows"]
    ]
    return table(head, rows)


FORMS = {"factorisation": form}
"""Forms of the table, by the name in its markers."""

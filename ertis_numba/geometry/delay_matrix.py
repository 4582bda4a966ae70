"""Delays of your own for each direction and microphone, in place of those of plane waves."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.csv_numbers import csv_rows, npy_content
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.delays import far_field_delays, unit_vectors
from ertis_numba.geometry.grids import Grid
from ertis_numba.geometry.layouts import microphones
from ertis_numba.settings import Settings

__all__ = ["MAX_DELAY_S", "delay_matrix", "plane_delays"]

MAX_DELAY_S = 0.02
"""Limit on the magnitude of a delay relative to the mean of its direction: sound travels 7 m in this time."""


def delay_matrix(settings: Settings, *, n_directions: int) -> NDArray[np.float64] | None:
    """Return the delays in s, (direction, enabled mic), that ``processing.delay_matrix`` states; None without it."""
    # Positive delays mean later sound. Their mean over microphones is 0, so that ranges count from the array's centre.
    processing = settings.processing
    given = processing.delay_matrix
    if not given:
        return None
    name = f"processing.delay_matrix {given}" if isinstance(given, str) else "processing.delay_matrix"
    samples = _read(name, Path(given)) if isinstance(given, str) else np.array(given, dtype=np.float64)
    layout = microphones(settings.array)
    wanted = n_directions, len(layout.enabled)
    if samples.shape != wanted:
        hint = "; transpose it" if samples.shape == wanted[::-1] else ""
        raise ArgumentError(
            f"{name} has shape {samples.shape}, but the image has {wanted[0]} directions and the array {wanted[1]} "
            f"channels; pass shape {wanted}, a row for each direction{hint}"
        )
    checks.finite_array(name, samples)
    in_layout = microphones(settings.array.replace(disabled=None)).enabled
    delays_s = samples / (processing.delay_rate_hz or settings.signal_rate_hz)
    delays_s = (delays_s - delays_s[:, in_layout].mean(axis=1, keepdims=True))[:, layout.enabled]
    largest_s = float(np.abs(delays_s).max())
    if largest_s > MAX_DELAY_S:
        raise ArgumentError(
            f"{name} has delays of up to {1e3 * largest_s:.4g} ms relative to the mean of their direction, but the "
            f"limit is {1e3 * MAX_DELAY_S:g} ms; correct it, or processing.delay_rate_hz"
        )
    return np.asarray(delays_s)


def plane_delays(settings: Settings, grid: Grid, *, sound_speed_m_s: float) -> NDArray[np.float64]:
    """Return the given delays or else those of plane waves in s: (direction, enabled mic), positive for later sound."""
    given_s = delay_matrix(settings, n_directions=len(grid))
    if given_s is not None:
        return given_s
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    positions_m = microphones(settings.array).enabled_positions_m
    return far_field_delays(positions_m, directions, sound_speed_m_s=sound_speed_m_s)


def _read(name: str, path: Path) -> NDArray[np.float64]:
    """Return the numbers in a CSV or NPY file."""
    suffix = path.suffix.lower()
    if suffix not in {".csv", ".npy"}:
        raise ArgumentError(f"{name} is not a .csv or .npy file; use such a file, or a list of rows")
    try:
        if suffix == ".npy":
            loaded = np.asarray(npy_content(path))
        else:
            rows = csv_rows(name, path.read_text("utf-8-sig"))
            if len({len(row) for row in rows}) != 1:
                raise ArgumentError(f"{name} has rows of different lengths; write a delay for each channel in each row")
            loaded = np.array(rows)
    except (OSError, ValueError) as error:
        if isinstance(error, ArgumentError):
            raise
        reason = checks.reason_unreadable(error) if isinstance(error, OSError | UnicodeDecodeError) else error
        raise ArgumentError(f"{name} cannot be read ({reason}); save it again") from error
    if loaded.ndim != 2 or loaded.dtype.kind not in "iuf":
        raise ArgumentError(f"{name} contains {loaded.dtype} of shape {loaded.shape}; pass rows of real numbers")
    return np.asarray(loaded, dtype=np.float64)

"""Nearest echo of each direction, such as for obstacle avoidance."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.side_lobes import side_lobe_floor
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape

__all__ = ["nearest_echo"]


def nearest_echo(
    image: Energyscape, *, min_level_db: float = -20.0, floor_dbfs: float = -np.inf
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the range and the level of the nearest echo in each direction.

    An echo is a local maximum over range that exceeds both limits and the possible side lobes of the strongest
    reflector at about the same range, as in `PointExtractor`. The first and the last range hold no echoes.

    Parameters
    ----------
    image : Energyscape
        Image with at least three ranges.
    min_level_db : float
        Lowest level relative to the strongest point of the image in dB, at most 0.
    floor_dbfs : float
        Lowest level relative to a full-scale echo in every microphone in dBFS. Without it, the strongest point of an
        image of noise is an echo.

    Returns
    -------
    range_m : (direction,) float64
        Range in metres; infinity for directions without an echo.
    level_dbfs : (direction,) float32
        Level; -infinity for directions without an echo.

    Raises
    ------
    ArgumentError
        ``min_level_db`` is above 0, or the image has fewer than three ranges.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> from ertis_numba.analysis.nearest_echo import nearest_echo
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> range_m, level_dbfs = nearest_echo(image)
    >>> round(float(range_m.min()), 2)
    1.15
    """
    checks.between("min_level_db", min_level_db, -1000.0, 0.0)
    if len(image.range_m) < 3:
        raise ArgumentError(f"the image has {len(image.range_m)} ranges; use an image with at least 3")
    amplitude = image.amplitude
    profile = amplitude.max(axis=0, initial=0.0)
    lowest = max(profile.max() * 10 ** (min_level_db / 20), 10 ** (floor_dbfs / 20), np.finfo(np.float32).tiny)
    floor = np.maximum(side_lobe_floor(profile, image.range_m), np.float32(lowest))
    middle = amplitude[:, 1:-1]
    is_echo = (middle >= floor[1:-1]) & (middle >= amplitude[:, :-2]) & (middle > amplitude[:, 2:])
    nearest = 1 + np.argmax(is_echo, axis=1)
    found = is_echo.any(axis=1)
    levels = amplitude[np.arange(len(amplitude)), nearest]
    with np.errstate(divide="ignore"):
        level_dbfs = np.where(found, 20 * np.log10(levels), -np.inf)
    return np.where(found, image.range_m[nearest], np.inf), level_dbfs.astype(np.float32)

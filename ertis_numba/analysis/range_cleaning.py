"""Range-wise cleaning of images: only the strongest directions of each range remain."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.frames import Energyscape

__all__ = ["clean", "clean_in_place", "keep_strongest"]


def clean(image: Energyscape, *, within_db: float | None = 6.0, above_mean_db: float | None = None) -> Energyscape:
    """Return an image that keeps only the strongest directions of each range; all other bins become 0.

    This removes side lobes, and weaker reflectors at the same range as well. An amplitude ``A(d, r)`` remains if::

        A(d, r) >= 10^(-within_db / 20) · max over d of A(d, r)
        A(d, r) >= 10^(above_mean_db / 20) · mean over d of A(d, r)

    The software of the authors of eRTIS keeps bins above half of the strongest amplitude and above twice the mean of
    the range. That corresponds to ``within_db=6.02, above_mean_db=6.02`` (rtisdev 2.16.0,
    ``maxEnergyRangeThresholdMultiplier`` and ``meanEnergyRangeMultiplier``). With ``processing.clean_within_db`` and
    ``processing.clean_above_mean_db``, a pipeline cleans its images itself.

    Parameters
    ----------
    image : Energyscape
    within_db : float, optional
        Largest level below the strongest direction of the same range, 0 to 1000 dB; 6 by default, None for no limit.
    above_mean_db : float, optional
        Smallest level above the mean amplitude of the range, 0 to 1000 dB; no such limit by default. Above 0 dB, an
        image of one direction keeps no bin.

    Raises
    ------
    ArgumentError
        A level is out of range.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> from ertis_numba.analysis.range_cleaning import clean
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> cleaned = clean(image, within_db=10)
    >>> bool(cleaned.amplitude.max() == image.amplitude.max()), bool((cleaned.amplitude == 0).mean() > 0.5)
    (True, True)
    """
    checks.instance("image", image, Energyscape, "Pipeline.process returns")
    for name, value in (("within_db", within_db), ("above_mean_db", above_mean_db)):
        if value is not None:
            checks.between(name, value, 0.0, 1000.0)
    amplitude = image.amplitude.copy()
    clean_in_place(amplitude, within_db=within_db, above_mean_db=above_mean_db)
    return image.replace(amplitude=amplitude)


def clean_in_place(amplitude: NDArray[np.float32], *, within_db: float | None, above_mean_db: float | None) -> None:
    """Set the amplitudes to 0 that `clean` removes."""
    of_max = None if within_db is None else 10 ** (-within_db / 20)
    of_mean = None if above_mean_db is None else 10 ** (above_mean_db / 20)
    keep_strongest(amplitude, of_max=of_max, of_mean=of_mean)


def keep_strongest(amplitude: NDArray[np.float32], *, of_max: float | None, of_mean: float | None) -> None:
    """Set amplitudes to 0 below limits relative to the strongest of their range, and to its mean."""
    smallest = np.zeros(amplitude.shape[1], dtype=np.float32)
    if of_max is not None:
        np.maximum(smallest, amplitude.max(axis=0, initial=0.0) * np.float32(of_max), out=smallest)
    if of_mean is not None:
        np.maximum(smallest, amplitude.mean(axis=0) * np.float32(of_mean), out=smallest)
    amplitude *= amplitude >= smallest  # A tenth of the time that np.where takes.

"""Noise of images, and amplitudes that noise alone does not reach."""

import math

import numpy as np

from ertis_numba import checks
from ertis_numba.frames import Energyscape

__all__ = ["noise_of", "threshold_of"]

_ROUNDING = 10 ** (-140 / 20)  # of one-bit microphones: their least noise is 40 dB above, arithmetic 10 dB below
_SAMPLE = 32_768  # bins from which the noise is estimated, to a hundredth
_BLOCKS = 16  # of ranges, the noise of each of which is estimated
_QUIET = 1 / 3  # quantile of these estimates: side lobes raise those near echoes, and chance lowers the lowest


def noise_of(image: Energyscape) -> float:
    """Return the root mean square of the noise of an image; 0 if it is unknown.

    It is the lower tercile of estimates from the medians of blocks of ranges. The noise of beamformers other than
    delay-and-sum is unknown, because its distribution is not that of Rayleigh.
    """
    if image.settings.processing.beamformer != "delay_and_sum" or not image.amplitude.size:
        return 0.0
    some = image.amplitude[:: max(1, image.amplitude.size // _SAMPLE)]
    blocks = np.array_split(some, min(_BLOCKS, some.shape[1]), axis=1)
    level = float(np.quantile([np.median(block) for block in blocks], _QUIET))
    return level / math.sqrt(math.log(2))


def threshold_of(image: Energyscape, false_alarm: float) -> float:
    """Return the amplitude that noise reaches anywhere in an image with a given probability; 0 if noise is unknown.

    A bin of noise with root mean square s exceeds t with the probability ``exp(-t²/s²)``. All bins are taken as
    independent, which makes the threshold slightly too high. For one-bit microphones, it is at least -140 dB of full
    scale, because bits that never change leave only rounding errors.

    Parameters
    ----------
    image : Energyscape
    false_alarm : float
        Probability that one bin or more of the image exceeds the threshold.

    Raises
    ------
    ArgumentError
        ``false_alarm`` is not between 0 and 1.
    """
    checks.between("false_alarm", false_alarm, 1e-12, 1.0)
    smallest = _ROUNDING if image.settings.recording.is_pdm else 0.0
    return max(smallest, noise_of(image) * math.sqrt(math.log(max(1, image.amplitude.size) / false_alarm)))

"""Probability that noise alone looks like a source."""

import functools
import math
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.passive.scan_extent import ScanExtent

__all__ = ["LAGS", "chance_of_phases", "exceedance", "independent_samples"]

_CELL_RAD: Final = math.pi / 2
_ROUNDING: Final = 1e-12
_SAMPLES: Final = 512  # of a block from which correlations are computed
LAGS: Final = 4
"""Distance of bins beyond which the spectra of Hann windows are uncorrelated."""


def exceedance(share: float, *, n_samples: float, n_dimensions: int, extent: ScanExtent) -> float:
    """Return the probability that noise alone gives the beam of any direction at least a share of all power.

    In white noise of unknown power, the share R of one direction in the power of D dimensions (microphones minus other
    sources) has the Beta distribution ``R ~ Beta(K, K (D − 1))`` for K independent complex samples. For many
    dimensions, this is nearly a Gamma distribution. The expected Euler characteristic of the directions of a connected
    set that exceed R is ``E = P(R) + L₁ g / √(2πn) + L₂ g′ / (2πn)`` with ``n = 2K (D − 1)`` (K. J. Worsley, Local
    maxima and the expected Euler characteristic of excursion sets of χ², F and t fields, 1994). Here g is the density
    of ``φ = arccos √R``, ``g′`` its derivative, and L₁ and L₂ are the length and the area of the set in units of the
    array's resolution: see `ScanMesh.extent`. At high levels, this is the expected number of places that exceed R.
    These are rare and independent in cells as large as the distance π/2 of orthogonal waves (D. J. Aldous, Probability
    approximations via the Poisson clumping heuristic, 1989). With N cells, the probability of at least one place is
    therefore ``1 − (1 − E / N)^N``. It is 1 if the share is not above its mean.
    """
    if n_dimensions < 2 or share <= 1 / n_dimensions:
        return 1.0
    if share >= 1:
        return 0.0
    rest = n_samples * (n_dimensions - 1)
    law = scipy.stats.beta(n_samples, rest)
    density = float(law.pdf(share)) * 2 * math.sqrt(share * (1 - share))
    ratio = math.sqrt(share / (1 - share))
    slope = density * ((2 * rest - 1) * ratio - (2 * n_samples - 1) / ratio)
    scale = 4 * math.pi * rest
    expected = extent.n_parts * float(law.sf(share)) + extent.length * density / math.sqrt(scale)
    expected += extent.area * slope / scale
    n_cells = extent.n_parts + extent.length / _CELL_RAD + extent.area / _CELL_RAD**2
    return -math.expm1(n_cells * math.log1p(-min(expected / n_cells, 1 - _ROUNDING)))


def chance_of_phases(share: float, *, n_bins: float, n_mics: int, extent: ScanExtent) -> float:
    """Return the probability that random phases of the microphones give a direction at least a share of their power.

    The share of a direction whose phases differ by δ is about ``exp(−Σ |δ|² / M)`` with M microphones. Such phases fill
    a tube around those of all directions, whose volume is that of ``extent`` times a ball, relative to the torus of all
    phases (H. Weyl, On the volume of tubes, 1939). Further independent bins have the same direction.
    """
    n, radius = n_mics - 1, math.sqrt(-n_mics * math.log(min(max(share, 1e-12), 1.0)))
    cell = math.sqrt(n_mics) / (2 * math.pi) ** n

    def tube(n_directions: int, size: float) -> float:
        left = n - n_directions
        ball = math.pi ** (left / 2) / math.gamma(left / 2 + 1) * radius**left if left >= 0 else math.inf
        return size * n_mics ** (n_directions / 2) * ball * cell if size else 0.0

    of_any = sum(tube(k, size) for k, size in enumerate((extent.n_parts, extent.length, extent.area)))
    return float(min(1.0, of_any) * min(1.0, tube(0, 1.0)) ** max(0.0, n_bins - 1))


def independent_samples(
    shares: NDArray[np.floating], n_blocks: int, similarity: NDArray[np.floating] | None = None
) -> float:
    """Return the number of independent samples whose mean power varies as that of bins of blocks.

    Hann windows that overlap by half leave 0.47 independent samples of each bin and block: neighbouring bins and blocks
    are correlated (P. D. Welch, 1967). ``similarity``, (LAGS + 1,), is the squared cosine of the angle between the
    beams of two bins, from 0 bins apart on, which reduces their correlation; 1 by default, as for a microphone.
    """
    same, next_one = _correlations()
    products = np.correlate(shares, shares, "full")[len(shares) - 1 :][: LAGS + 1].astype(np.float64)
    products[1:] *= 2
    if similarity is not None:
        products *= similarity[: len(products)]
    variance = products @ (n_blocks * same + 2 * (n_blocks - 1) * next_one)[: len(products)]
    return float((n_blocks * shares.sum(dtype=np.float64)) ** 2 / variance)


@functools.cache
def _correlations() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the squared correlations of bins at each distance, within a block and from one block to the next."""
    window = scipy.signal.get_window("hann", _SAMPLES)
    turns = np.exp(2j * np.pi * np.outer(np.arange(LAGS + 1), np.arange(_SAMPLES)) / _SAMPLES)
    half = _SAMPLES // 2
    within = np.abs(turns @ window**2) ** 2
    across = np.abs(turns[:, half:] @ (window[half:] * window[:half])) ** 2
    return within / within[0], across / within[0]

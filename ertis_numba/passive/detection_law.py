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
    """Return the probability that noise alone gives the beam of any direction at least a share of all power."""
    # With `n = 2K (D − 1)`, the expected number of places is `E = P(R) + L₁ g / √(2πn) + L₂ g′ / (2πn)` for the density
    # g of `φ = arccos √R` (K. J. Worsley, 1994), and `1 − (1 − E / N)^N` for N independent cells. See
    # docs/explanation/acoustic-maps.md.
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
    """Return the probability that random phases of the microphones give a direction at least a share of their power."""
    # Phases that differ by δ have a share of `exp(−Σ |δ|² / M)`, and fill a tube around all directions (H. Weyl, 1939).
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
    """Return the number of independent samples whose mean power varies as that of bins of blocks."""
    # Hann windows that overlap by half leave 0.47 samples of each bin and block. `similarity` (LAGS + 1,) is that of
    # beams.
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

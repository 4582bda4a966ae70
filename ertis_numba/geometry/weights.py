"""Array weights: real weights of the microphones that trade a wider main lobe for lower side lobes."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.layouts import Layout, microphones
from ertis_numba.settings import Settings, parse_window

__all__ = ["array_weights", "effective_count"]

_SAMPLES = 4097  # of a window; the error of linear interpolation between them is below 1e-6 of its maximum


def array_weights(settings: Settings) -> NDArray[np.float64]:
    """Return the weight of each enabled microphone, by its distance from the centre, with a mean of 1: (mic,)."""
    # A mean of 1 preserves the level of an echo (H. L. Van Trees, Optimum Array Processing, 2002, sections 2.6 and
    # 3.1).
    layout, given = microphones(settings.array), settings.processing.array_weights
    if given == "uniform":
        return np.ones(int(layout.enabled.sum()))
    weights = _window(layout, given) if isinstance(given, str) else _listed(layout, given)
    mean = float(weights.mean())
    if not mean > 0:
        raise ArgumentError(
            f"processing.array_weights is 0 for all {len(weights)} enabled microphones; use a weight above 0 for at "
            "least one of them"
        )
    return np.asarray(weights / mean)


def effective_count(weights: NDArray[np.float64]) -> float:
    """Return the number of equally weighted microphones with the same white noise gain, ``(Σw)² / Σw²``."""
    return len(weights) / float(np.mean(weights**2))


def _listed(layout: Layout, given: tuple[float, ...]) -> NDArray[np.float64]:
    checks.shape("processing.array_weights", (len(given),), layout.enabled.shape)
    return np.asarray(given, dtype=np.float64)[layout.enabled]


def _window(layout: Layout, name: str) -> NDArray[np.float64]:
    """Return samples of a window at the microphones."""
    # Importing SciPy's windows takes longer than starting the chain, and uniform weights do not need them.
    from scipy.signal import windows  # noqa: PLC0415

    taper = parse_window(name)
    if taper.window == "taylor":
        # Taylor's minimum number of nearly equal side lobes (Van Trees, section 3.4).
        equal = math.ceil(2 * (math.acosh(10 ** (taper.parameter / 20)) / math.pi) ** 2 + 0.5)
        samples = windows.taylor(_SAMPLES, nbar=equal, sll=taper.parameter)
    elif taper.window == "kaiser":
        samples = windows.kaiser(_SAMPLES, taper.parameter)
    else:
        samples = getattr(windows, taper.window)(_SAMPLES)
    return np.asarray(
        np.interp(_relative_radius(layout.enabled_positions_m), np.linspace(-1.0, 1.0, _SAMPLES), samples)
    )


def _relative_radius(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return distances from the centre relative to the radius of the aperture: (mic,) float64, from 0 to 1."""
    radius_m = np.linalg.norm(positions_m, axis=1)
    if len(positions_m) == 1:
        return np.zeros(1)
    apart_m = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
    np.fill_diagonal(apart_m, np.inf)
    return np.asarray(radius_m / (radius_m.max() + apart_m.min(axis=1).mean() / 2))

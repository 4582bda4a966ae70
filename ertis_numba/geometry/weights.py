"""Array weights: real weights of microphones that trade the width of the main lobe for the level of side lobes."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.geometry.layouts import Layout, microphones
from ertis_numba.settings import Settings, parse_window

__all__ = ["array_weights", "effective_count"]

_SAMPLES = 4097  # of a window; linear interpolation between them errs by less than 1e-6 of its maximum


def array_weights(settings: Settings) -> NDArray[np.float64]:
    """Return the weight of each enabled microphone, with a mean of 1: (mic,) float64.

    A window is a function of the distance from the centre of the array, relative to the radius of the aperture. The
    aperture ends half of the mean distance between neighbours beyond the outermost microphone, so that no microphone
    has the weight 0.

    A mean of 1 keeps the level of an echo to which all microphones contribute in phase, as the constraint
    ``wᴴv = 1`` does for the response in the steered direction (H. L. Van Trees, Optimum Array Processing, 2002,
    sections 2.6 and 3.1).

    Parameters
    ----------
    settings : Settings

    Raises
    ------
    ArgumentError
        ``processing.array_weights`` is a list of another length than the array has channels, or all enabled
        microphones have the weight 0.
    """
    layout, given = microphones(settings.array), settings.processing.array_weights
    if given == "uniform":
        return np.ones(int(layout.enabled.sum()))
    weights = _window(layout, given) if isinstance(given, str) else _listed(layout, given)
    mean = float(weights.mean())
    if not mean > 0:
        raise ArgumentError(
            f"processing.array_weights is 0 for all {len(weights)} enabled microphones; give one of them a weight "
            "above 0"
        )
    return np.asarray(weights / mean)


def effective_count(weights: NDArray[np.float64]) -> float:
    """Return the number of equally weighted microphones with the same gain over uncorrelated noise, ``(Σw)² / Σw²``.

    It is the white noise gain of the array (Van Trees, section 2.6.2), and the number of microphones if weights are
    uniform.

    Parameters
    ----------
    weights : (mic,) float64
        With a mean of 1.
    """
    return len(weights) / float(np.mean(weights**2))


def _listed(layout: Layout, given: tuple[float, ...]) -> NDArray[np.float64]:
    checks.shape("processing.array_weights", (len(given),), layout.enabled.shape)
    return np.asarray(given, dtype=np.float64)[layout.enabled]


def _window(layout: Layout, name: str) -> NDArray[np.float64]:
    """Return samples of a window at the microphones."""
    # SciPy's windows take longer to import than the chain takes to start, and uniform weights need none.
    from scipy.signal import windows  # noqa: PLC0415

    taper = parse_window(name)
    if taper.window == "taylor":
        # Taylor's least number of nearly equal side lobes (Van Trees, section 3.4).
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

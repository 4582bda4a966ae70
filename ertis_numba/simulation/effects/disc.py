"""Echo of a flat disc in the near and the far field."""

import functools
import math

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ertis_numba.simulation.effects.piston import piston

__all__ = ["disc"]

Floats = NDArray[np.float64]
_FAR = 0.02  # below this u, the far field is accurate to a few thousandths


def disc(tilt: Floats, nearness: Floats) -> NDArray[np.complex128]:
    """Return the echo relative to the far-field echo along the normal: complex128, shaped like the arguments.

    The echo is ``∫₀¹ J₀(v √t) exp(-j u t / 2) dt``. This is Kirchhoff's integral over a disc in Fresnel's
    approximation, as for the field near the focus of a lens (M. Born, E. Wolf, Principles of Optics, 7th edition,
    section 8.8). On the axis it is ``exp(-j u / 4) sin(u / 4) / (u / 4)``. In the far field, u is 0 and the echo has
    the pattern of a piston, ``2 J₁(v) / v``.

    Parameters
    ----------
    tilt : float64
        ``v = k a |s|``. Here s is the component in the disc's plane of the sum of the unit vectors towards emitter and
        microphone.
    nearness : float64
        ``u = k a² (1 / r₁ + 1 / r₂)``.
    """
    found = piston(tilt).astype(np.complex128)
    near = nearness > _FAR
    if near.any():
        v, u = tilt[near], nearness[near]
        turns = (float(u.max()) / 2 + float(v.max())) / (2 * math.pi)
        places, weights = _nodes(16 + 8 * math.ceil(turns / 2))  # four per turn, and some for the ends
        total = np.zeros(len(v), dtype=np.complex128)
        for place, weight in zip((places + 1) / 2, weights / 2, strict=True):
            total += weight * scipy.special.j0(v * math.sqrt(place)) * np.exp(-0.5j * u * place)
        found[near] = total
    return found


@functools.lru_cache(maxsize=16)
def _nodes(count: int) -> tuple[Floats, Floats]:
    places, weights = np.polynomial.legendre.leggauss(count)
    return places, weights

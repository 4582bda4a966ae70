"""Echo of a rigid sphere of at most a few wavelengths."""

import functools

import numpy as np
import scipy.special
from numpy.typing import NDArray

__all__ = ["LARGE", "rigid_sphere"]

Floats = NDArray[np.float64]

LARGE = 60.0
"""Circumference in wavelengths, k a, above which a sphere is a curved mirror; in backscatter the two differ by 2 %."""
_FADES = 40.0  # between this value and `LARGE`, the series blends into the mirror
_ORDERS = np.arange(int(LARGE) + 15)  # beyond k a the terms fall faster than exponentially


def rigid_sphere(size: Floats, cos_turn: Floats) -> NDArray[np.complex128]:
    """Return the echo relative to that of a curved mirror: (path, mic, frequency) complex128.

    The echo is the partial-wave series of a rigid sphere in a plane wave,
    ``f = -(j / k) Σ (2n + 1) jₙ'(ka) / hₙ'(ka) Pₙ(cos Θ)``. The time factor is ``exp(jωt)``, so the spherical Hankel
    functions are of the second kind (P. M. Morse, K. U. Ingard, Theoretical Acoustics, 1968, section 8.2). The echo of
    the mirror is ``(a / 2) exp(2 j k a sin(Θ / 2))``, relative to the sphere's centre. For small k a the ratio falls
    as (k a)² (Rayleigh scattering); near k a = 1 the creeping wave around the sphere makes it oscillate.

    Parameters
    ----------
    size : (path, frequency) float64
        ``k a``, wave number times radius.
    cos_turn : (path, mic) float64
        Cosine of the scattering angle Θ; -1 is backscatter.
    """
    wanted = (size > 0) & (size < LARGE)
    safe = np.where(wanted, size, 1.0)
    terms = np.stack([_terms(row.tobytes()) for row in safe], axis=1)
    legendre = scipy.special.eval_legendre(_ORDERS[:, None, None], cos_turn)
    # Summed without BLAS, because starting its threads takes longer than these sums.
    series = np.einsum("opm,opf->pmf", legendre, terms)
    back = 2 * np.sqrt(np.maximum((1 - cos_turn) / 2, 0.0))  # extra path to the centre, in radii
    ratio = -2j / safe[:, None] * series * np.exp(-1j * back[..., None] * safe[:, None])
    weight = np.where(wanted, np.clip((LARGE - safe) / (LARGE - _FADES), 0.0, 1.0), 0.0)
    return np.asarray(1 + weight[:, None] * (ratio - 1))


@functools.lru_cache(maxsize=64)
def _terms(sizes: bytes) -> NDArray[np.complex128]:
    """Return ``(2n + 1) jₙ' / hₙ'`` for sizes given as the bytes of a float64 array: (order, size) complex128."""
    size, orders = np.frombuffer(sizes), _ORDERS[:, None]
    near = scipy.special.spherical_jn(orders, size, derivative=True)
    far = scipy.special.spherical_yn(orders, size, derivative=True)
    # Where the second function overflows, the term is negligible.
    ratio = np.divide(near, near - 1j * far, out=np.zeros(near.shape, dtype=np.complex128), where=np.isfinite(far))
    return np.asarray((2 * orders + 1) * ratio)

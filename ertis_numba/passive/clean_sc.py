"""CLEAN-SC: sources, and the coherent parts of a map that each of them causes."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["clean_sc"]

_LOOP_GAIN: Final = 0.6
_ROUNDS_PER_MICROPHONE: Final = 2
_GROWTH: Final = 3  # Rounds over which the peak may not grow.
_HOLLOW_ROUNDS: Final = 12  # The component of a source converges within a few.


def clean_sc(
    matrix: NDArray[np.complex64], waves: NDArray[np.complex64], power: NDArray[np.float32], *, hollow: bool
) -> NDArray[np.float32]:
    """Return the power of the sources of one bin (P. Sijtsma, CLEAN based on spatial source coherence, 2007).

    Each round takes the loudest direction, and subtracts 0.6 of all sound that is coherent with it. The rounds end when
    the loudest power exceeds that of three rounds before, or after twice as many rounds as microphones. Both are the
    rules of Acoular.

    Parameters
    ----------
    matrix : (mic, mic) complex64
        Cross-spectral matrix.
    waves : (mic, direction) complex64
        Waves from each direction, of magnitude 1.
    power : (direction,) float32
        Map of delay-and-sum, with or without the diagonal; negative powers must remain.
    hollow : bool
        Leave out the diagonal of the matrix.

    Returns
    -------
    (direction,) float32
    """
    n_mics = len(matrix)
    norm = np.float32(n_mics * n_mics - n_mics if hollow else n_mics * n_mics)
    rest, left = matrix.copy(), power.astype(np.float32)
    if hollow:
        np.fill_diagonal(rest, 0)
    found = np.zeros_like(left)
    conjugate = np.ascontiguousarray(waves.conj().T)
    peaks: list[np.float32] = []
    for number in range(_ROUNDS_PER_MICROPHONE * n_mics):
        loudest = int(left.argmax())
        peak = left[loudest]
        if peak <= 0:
            break
        found[loudest] += np.float32(_LOOP_GAIN) * peak
        peaks.append(peak)
        if number > _GROWTH and peak > peaks[number - _GROWTH]:
            break
        component = _component(rest, waves[:, loudest], peak, norm, hollow=hollow)
        share = np.float32(_LOOP_GAIN) * peak
        seen = conjugate @ component
        coherent = seen.real**2 + seen.imag**2
        if hollow:
            coherent -= np.float32((np.abs(component) ** 2).sum())
        rest -= share * np.outer(component, component.conj())
        if hollow:
            np.fill_diagonal(rest, 0)
        left -= share / norm * coherent
    return found


def _component(
    rest: NDArray[np.complex64], wave: NDArray[np.complex64], peak: np.float32, norm: np.float32, *, hollow: bool
) -> NDArray[np.complex64]:
    """Return the sound at each microphone that is coherent with a direction, relative to the root of its power."""
    weights = wave / np.sqrt(norm)
    seen = rest @ weights / peak
    if not hollow:
        return np.asarray(seen, np.complex64)
    component = wave.copy()
    for _ in range(_HOLLOW_ROUNDS):
        own = np.abs(component) ** 2
        size = np.sqrt(1 + (np.abs(weights) ** 2 * own).sum())
        component = (seen + own * weights) / size
    return np.asarray(component, np.complex64)

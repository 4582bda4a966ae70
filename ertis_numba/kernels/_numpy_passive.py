"""Kernels of acoustic maps in plain NumPy."""

import numpy as np

from ertis_numba.kernels._contract import Complex, Real, Turns
from ertis_numba.kernels._contract.passive import (
    CLEAN_GROWTH,
    CLEAN_HOLLOW_ROUNDS,
    CLEAN_LOOP_GAIN,
    CLEAN_ROUNDS_PER_MICROPHONE,
)

__all__ = ["clean_sources", "cross_spectra", "steer_power", "steer_vectors"]


def cross_spectra(spectra: Complex, first: int, out: Complex) -> None:
    """Sum the products of the spectra of each two microphones over blocks of samples."""
    heard = spectra[:, :, first : first + len(out)].transpose(2, 0, 1)
    np.matmul(heard, heard.conj().transpose(0, 2, 1), out=out)


def steer_power(matrices: Complex, steps: Turns, bins: Turns, out: Real) -> None:
    """Compute the power that Hermitian matrices have for the wave from each direction."""
    for matrix, number, power in zip(matrices, bins, out, strict=True):
        lags = _waves(steps, number)
        upper = np.triu(matrix, 1)
        power[:] = 2 * (lags.conj() * (upper @ lags)).real.sum(axis=0) + np.trace(matrix).real


def steer_vectors(vectors: Complex, steps: Turns, bins: Turns, out: Real) -> None:
    """Compute the power that vectors have for the wave from each direction."""
    for each, number, power in zip(vectors, bins, out, strict=True):
        power[:] = (np.abs(each.conj() @ _waves(steps, number)) ** 2).sum(axis=0)


def _waves(steps: Turns, number: np.uint32) -> Complex:
    """Return the waves from all directions at a bin: (mic, direction) complex64."""
    return np.asarray(np.exp(np.float32(-2 * np.pi / 2**32) * (steps * number).view(np.int32) * np.complex64(1j)))


def clean_sources(
    matrices: Complex,
    steps: Turns,
    bins: Turns,
    powers: Real,
    hollow: bool,  # noqa: FBT001 - kernels have no keywords
    out: Real,
) -> None:
    """Find the sources of each bin, by subtracting all sound that is coherent with the loudest direction."""
    for matrix, number, power, found in zip(matrices, bins, powers, out, strict=True):
        _clean(matrix.copy(), _waves(steps, number), power.copy(), found, hollow=hollow)


def _clean(rest: Complex, waves: Complex, left: Real, found: Real, *, hollow: bool) -> None:
    """Fill the sources of one bin; its matrix and its map are overwritten."""
    n_mics = len(rest)
    norm = np.float32(max(n_mics * n_mics - n_mics, 1) if hollow else n_mics * n_mics)
    found[:] = 0
    conjugate, peaks = np.ascontiguousarray(waves.conj().T), []
    diagonal = np.arange(n_mics if hollow else 0)
    rest[diagonal, diagonal] = 0
    for number in range(CLEAN_ROUNDS_PER_MICROPHONE * n_mics):
        loudest = int(left.argmax())
        peak = left[loudest]
        if not peak > 0:
            break
        share = CLEAN_LOOP_GAIN * peak
        found[loudest] += share
        peaks.append(peak)
        if number > CLEAN_GROWTH and peak > peaks[number - CLEAN_GROWTH]:
            break
        component = _component(rest, waves[:, loudest], peak, norm, hollow=hollow)
        seen = conjugate @ component
        own = (np.abs(component) ** 2).sum() if hollow else np.float32(0)
        rest -= share * np.outer(component, component.conj())
        rest[diagonal, diagonal] = 0
        left -= share / norm * (seen.real**2 + seen.imag**2 - own)


def _component(rest: Complex, wave: Complex, peak: np.float32, norm: np.float32, *, hollow: bool) -> Complex:
    """Return the sound at each microphone that is coherent with a direction, relative to the root of its power."""
    weights = wave / np.sqrt(norm)
    seen = rest @ weights / peak
    if not hollow:
        return np.asarray(seen, np.complex64)
    component = wave
    for _ in range(CLEAN_HOLLOW_ROUNDS):
        own = np.abs(component) ** 2
        component = (seen + own * weights) / np.sqrt(1 + own.sum() / norm)
    return np.asarray(component, np.complex64)

"""Beam errors of a plan: deviations of its beams from exact beams, for each microphone."""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beam_grid import Aperture, BeamGrid
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.chain.plan_elements import ahead_of, beam_grid_of, delay_fit, spectrum_of
from ertis_numba.geometry import array_weights, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["Deviation", "deviation_of"]

_WAVES = 9  # Number of frequencies; the errors of a plan are smooth between them.


class Deviation(NamedTuple):
    """Relative error (direction, mic) of beams as a linear function of frequency: mean at the centre, slope in 1/Hz."""

    centre_hz: float
    mean: NDArray[np.complex64]
    slope_s: NDArray[np.complex64]


def deviation_of(settings: Settings, directions: NDArray[np.float64]) -> Deviation | None:
    """Return the deviation of a fast plan for unit vectors (direction, axis) of the grid; None if 0 or unknown."""
    plan = settings.accuracy
    unknown = None in {plan.oversampling, plan.delay_taps, plan.beam_taps}
    if settings.processing.method != "fast" or unknown or plan.delay_taps == 0:
        return None
    return _deviation_of(settings, np.ascontiguousarray(directions, np.float64).tobytes())


@functools.lru_cache(maxsize=4)
def _deviation_of(settings: Settings, directions: bytes) -> Deviation | None:
    with one_thread():
        return _computed(settings, np.frombuffer(directions).reshape(-1, 3))


def _computed(settings: Settings, directions: NDArray[np.float64]) -> Deviation | None:
    layout, spectrum = microphones(settings.array), spectrum_of(settings)
    is_turned = settings.processing.level_directions
    aperture = Aperture.of(layout.enabled_positions_m, directions, is_turned=is_turned)
    speed_m_s = sound_speed_m_s(settings.air)
    is_plane = settings.processing.wavefront == "plane"
    chosen = np.unique(np.linspace(0, len(spectrum.power) - 1, _WAVES).astype(np.intp))
    frequency_hz = spectrum.frequency_hz[chosen]
    power = spectrum.power[chosen] / spectrum.power[chosen].sum()
    centre_hz = float(power @ frequency_hz)
    offset_hz = frequency_hz - centre_hz
    nodes = beam_grid_of(settings, aperture, spectrum)
    if nodes is None and not is_plane:
        return None
    points = aperture.directions if nodes is None else nodes.points
    delays_s = aperture.delays_s(points, sound_speed_m_s=speed_m_s)
    fit, step_s = delay_fit(settings, spectrum)
    ahead_s = ahead_of(array_weights(settings), step_s)
    taken_s = layout.delay_s[layout.enabled] - ahead_s + delays_s
    first, fractions = fit.split(taken_s)
    weights = fit.weights(fractions)
    shape = (len(directions), delays_s.shape[1])
    mean, slope_s = np.zeros(shape, dtype=np.complex128), np.zeros(shape, dtype=np.complex128)
    exact_s = aperture.delays_s(aperture.directions, sound_speed_m_s=speed_m_s)
    gains = np.ones((shape[1], len(chosen))) if nodes is None else nodes.gain(frequency_hz)
    delay_gains = fit.gain(frequency_hz)
    for k, each_hz in enumerate(frequency_hz):
        turn = 2j * math.pi * each_hz
        made = np.exp(turn * delays_s)
        if is_plane:
            steps = np.exp(turn * step_s * np.arange(fit.n_taps))
            made *= delay_gains[k] * np.exp(turn * (first * step_s - taken_s)) * (weights @ steps)
        if nodes is not None:
            made = _interpolated(nodes, made)
        error = gains[:, k] * made * np.exp(-turn * exact_s) - 1
        mean += power[k] * error
        slope_s += power[k] * offset_hz[k] / float(power @ offset_hz**2) * error
    return Deviation(centre_hz, mean.astype(np.complex64), slope_s.astype(np.complex64))


def _interpolated(nodes: BeamGrid, made: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return beams of all directions, (direction, mic), from those of beam-grid points."""
    beams = np.zeros((len(nodes.rows), made.shape[1]), dtype=np.complex128)
    for pair in range(nodes.places.shape[1]):
        for one in (0, 1):
            beams[nodes.rows] += nodes.weights[:, pair, one, None] * made[nodes.places[:, pair] + one]
    return beams

"""Acoular's beamformer in the time domain, behind a front end in NumPy.

Acoular has no matched filter. Its frequency-domain beamformers average over time, so they have no ranges.
`BeamformerTime` interpolates linearly between samples, in double precision and for real signals. It therefore beamforms
the real and the imaginary part of the analytic signals, at every sample, of which one in `N_PHASES` is kept.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench.peers import _numpy
from ertis_bench.peers.problem import N_PHASES, Implementation, Problem

__all__ = ["make"]

_BLOCK: Final = 128 * N_PHASES  # samples at a time


def make(problem: Problem) -> Implementation:
    """Return the implementation with Acoular."""
    import acoular  # noqa: PLC0415 - an optional dependency
    from acoular.tfastfuncs import nb  # noqa: PLC0415 - the same

    acoular.config.global_caching = "none"

    class PlaneWaves(acoular.Environment):  # type: ignore[misc]
        """Environment of plane waves: a point of the grid is the unit vector of a direction."""

        def apparent_r(self, gpos: NDArray[np.float64], mpos: Any = 0.0) -> NDArray[np.float64]:
            """Return (point, mic) distances, or (point,) from the reference, one place."""
            places_m = np.zeros((3, 1)) if np.isscalar(mpos) else mpos
            distances_m = problem.lead_m - gpos.T @ places_m
            return distances_m[:, 0] if distances_m.shape[1] == 1 else distances_m

    grid = acoular.ImportGrid(pos=np.ascontiguousarray(problem.units.T))
    mics = acoular.MicGeom(pos_total=np.ascontiguousarray(problem.positions_m.T))
    environment = PlaneWaves(c=problem.sound_speed_m_s)
    steer = acoular.SteeringVector(grid=grid, mics=mics, env=environment, steer_type="classic")

    def signals(words: NDArray[Any]) -> NDArray[np.complex64]:
        return _numpy.analytic(problem, words).T

    def delay_and_sum(heard: NDArray[np.complex64]) -> NDArray[np.float32]:
        beams = [beams_of(np.ascontiguousarray(part, np.float64)) for part in (heard.real, heard.imag)]
        return np.hypot(*beams).T

    def beams_of(part: NDArray[np.float64]) -> NDArray[np.float64]:
        source = acoular.TimeSamples(data=part, sample_freq=problem.rate_hz)
        blocks = acoular.BeamformerTime(source=source, steer=steer).result(_BLOCK)
        return np.concatenate([block[::N_PHASES] for block in blocks])[: problem.n_ranges]

    return Implementation.of(signals, delay_and_sum, threads=nb.get_num_threads())

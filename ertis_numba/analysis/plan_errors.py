"""Errors of a plan that remain after they were predicted."""

import functools
import math

from ertis_numba import kernels
from ertis_numba.chain.error_model import SignalModel
from ertis_numba.chain.planner import Planner
from ertis_numba.geometry import array_weights, effective_count
from ertis_numba.settings import Settings

__all__ = ["plan_error"]

# Fits include the predicted errors of a plan. This share of their root mean square remains, because errors
# are approximated as linear over frequency, and samples are rounded. `ertis bench points` measures it.
_OF_PREDICTED = 0.02
# With spherical wavefronts, fractional delays depend on the range and are not predicted. Their errors are alike in
# neighbouring bins, so they shift a maximum by less than noise of the same power.
_OF_DELAYS, _OF_ONE_TAP = 0.1, 0.22


@functools.lru_cache(maxsize=8)
def plan_error(settings: Settings) -> float:
    """Return the errors of a plan that fits do not include, relative to an echo; 0 if the plan is unknown."""
    accuracy = settings.accuracy
    plan = (accuracy.oversampling, accuracy.delay_taps, accuracy.beam_taps)
    if settings.processing.method != "fast" or None in plan or accuracy.precision == "auto":
        return 0.0
    echo = SignalModel.echo(settings, effective_count(array_weights(settings)))
    parts = Planner(settings, kernels.load("numpy"), threads=1, signal_model=echo).parts(accuracy)
    # Half of the power of an error changes a magnitude, and so does half of the power of noise.
    delays, beams = (math.sqrt(2 * parts[name]) for name in ("delays", "beams"))
    share = _OF_PREDICTED
    if settings.processing.wavefront == "spherical":
        share = _OF_ONE_TAP if accuracy.delay_taps == 1 else _OF_DELAYS
    return math.hypot(share * delays, _OF_PREDICTED * beams)

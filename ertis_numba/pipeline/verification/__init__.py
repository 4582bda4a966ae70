"""Errors of images relative to exact ones, which are computed independently in float64."""

from ertis_numba.pipeline.verification._beamformers import combine
from ertis_numba.pipeline.verification._exact import ExactImage
from ertis_numba.pipeline.verification._measured import (
    Measured,
    error_db,
    exact_image,
    measure,
    sampled,
    sampled_error_db,
)
from ertis_numba.pipeline.verification._peaks import PEAKS, PeakErrors, peak_errors

__all__ = [
    "PEAKS",
    "ExactImage",
    "Measured",
    "PeakErrors",
    "combine",
    "error_db",
    "exact_image",
    "measure",
    "peak_errors",
    "sampled",
    "sampled_error_db",
]

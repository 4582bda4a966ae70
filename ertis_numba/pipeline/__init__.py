"""Pipeline from measurements to energyscapes, its steps on plain arrays, predictions and checks."""

from ertis_numba.pipeline.pipeline import Pipeline

__all__ = ["Pipeline"]

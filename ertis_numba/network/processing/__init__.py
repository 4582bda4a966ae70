"""Processing state: worker processes make images of measurements, a publisher hands them to applications."""

from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.processing import ImageProcessing
from ertis_numba.network.processing.queues import SensorCounts

__all__ = ["ImageProcessing", "ProcessingOptions", "SensorCounts"]

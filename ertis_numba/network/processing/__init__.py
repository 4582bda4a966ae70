"""Image processing: worker processes make images of measurements, and a publisher sends them to applications."""

from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.processing import ImageProcessing
from ertis_numba.network.processing.queues import ProcessingCounts

__all__ = ["ImageProcessing", "ProcessingCounts", "ProcessingOptions"]

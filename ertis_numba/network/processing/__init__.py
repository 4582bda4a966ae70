"""Processing state: worker processes make images of measurements, a publisher hands them to applications."""

from ertis_numba.network.processing.options import Options
from ertis_numba.network.processing.processing import Processing
from ertis_numba.network.processing.queues import Counts

__all__ = ["Counts", "Options", "Processing"]

"""Pipeline of a worker process, on this machine or in a cluster."""

import statistics
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.points import PointExtractor
from ertis_numba.base.errors import DataError
from ertis_numba.chain import memory
from ertis_numba.chain.costs import PlanCosts
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.network.processing.pipe_messages import Prepared
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings

__all__ = ["SharedPipeline"]

_TIMED: Final = 5  # Number of measurements, of which the median counts.


class SharedPipeline:
    """Thread-safe pipeline for one kind, from bytes in a format to images (direction, range) and points."""

    def __init__(self, settings: str, device: str, plan: PlanCosts = "nominal") -> None:
        stated = Settings.from_toml(settings, "settings of a sensor", find_line=False)
        stated.processing.require_image()
        stated.processing.require_sensor_frame("a central node does not know the poses of measurements in time")
        self.pipeline = Pipeline(stated, device=device, max_bytes=memory.MAX_BYTES, predict=False, plan=plan)
        self.shape = (len(self.pipeline.grid), len(self.pipeline.range_m))
        self.format = sample_format(self.pipeline.settings)
        self._extractor = PointExtractor(self.pipeline.settings)

    def image(
        self, words: "bytes | memoryview", out: NDArray[np.float32] | None = None, *, threads: int | None = None
    ) -> Energyscape:
        """Return the image of a measurement that is given as bytes."""
        if len(words) != self.format.n_bytes:
            raise DataError(
                f"a measurement has {len(words)} bytes, which does not match its settings; send Hello again"
            )
        array = self.format.from_bytes(words)
        return self.pipeline.process(Measurement(array, self.pipeline.settings), out, threads=threads)

    def points(self, image: Energyscape, largest: int) -> NDArray[np.float32]:
        """Return the points of an image, ``(point, 4)``: x, y, z in m and the amplitude; the strongest come first."""
        cloud = self._extractor(image)
        rows: NDArray[np.float32] = np.column_stack([cloud.position_m, cloud.amplitude]).astype("<f4")[:largest]
        return rows

    def times_s(self, threads: int, at_once: int) -> tuple[float, float]:
        """Return the time of one measurement on all threads, and of one among several that share the threads."""
        silence = bytes(self.format.n_bytes)
        out = np.empty(self.shape, np.float32)
        wide_s = _median_s(lambda: self.image(silence, out, threads=threads))
        if at_once == 1:
            return wide_s, wide_s
        share = max(1, threads // at_once)
        return wide_s, _median_s(lambda: self.image(silence, out, threads=share))

    def prepared(self, kind: int, wide_s: float, many_s: float) -> Prepared:
        """Return the description of the pipeline for the central node."""
        axes = (self.pipeline.grid.azimuth_rad, self.pipeline.grid.elevation_rad, self.pipeline.range_m)
        azimuth_rad, elevation_rad, range_m = (axis.astype("<f8").tobytes() for axis in axes)
        return Prepared(
            kind=kind,
            settings=self.pipeline.settings.to_toml(),
            azimuth_rad=azimuth_rad,
            elevation_rad=elevation_rad,
            range_m=range_m,
            shape=self.shape,
            wide_s=wide_s,
            many_s=many_s,
        )


def _median_s(work: Callable[[], Any]) -> float:
    took_s = []
    for _ in range(_TIMED + 1):
        begun_s = time.perf_counter()
        work()
        took_s.append(time.perf_counter() - begun_s)
    return statistics.median(took_s[1:])

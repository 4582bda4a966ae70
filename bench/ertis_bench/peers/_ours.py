"""Default plan of this package, and the paper's algorithm in plain NumPy and SciPy."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench.peers.problem import Implementation
from ertis_bench.plans import BEAMFORMING_KERNELS
from ertis_numba import kernels
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.frames import Measurement
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings

__all__ = ["paper", "this_package"]


def this_package(settings: Settings) -> Implementation:
    """Return the default plan of this package on the CPU."""
    kernel_set = kernels.load("cpu")
    pipeline = Pipeline(settings, device="cpu", predict=False)
    image = np.empty((len(pipeline.grid), len(pipeline.range_m)), np.float32)

    def prepared(words: NDArray[Any]) -> Callable[[], NDArray[np.float32]]:
        """Process the words once, and repeat the recorded calls of the beamforming kernels."""
        calls: list[tuple[Callable[..., None], tuple[Any, ...]]] = []

        def recorded(kernel: Callable[..., None]) -> Callable[..., None]:
            def run(*arguments: Any) -> None:
                calls.append((kernel, arguments))
                kernel(*arguments)

            return run

        spies: dict[str, Any] = {name: recorded(getattr(kernel_set, name)) for name in BEAMFORMING_KERNELS}
        chain = FastChain(pipeline.settings, dataclasses.replace(kernel_set, **spies), threads=kernel_set.max_threads)
        chain.process(words.reshape(len(words), -1), image)

        def repeat() -> NDArray[np.float32]:
            with kernel_set.threads(kernel_set.max_threads):
                for kernel, arguments in calls:
                    kernel(*arguments)
            return image

        return repeat

    return Implementation(_process(pipeline, settings), prepared, kernel_set.max_threads)


def paper(settings: Settings) -> Implementation:
    """Return the paper's algorithm in NumPy and SciPy."""
    processing = settings.processing.replace(method="paper")
    pipeline = Pipeline(settings.replace(processing=processing), device="numpy", predict=False)
    return Implementation(_process(pipeline, settings), None, threads=1)


def _process(pipeline: Pipeline, settings: Settings) -> Callable[[NDArray[Any]], NDArray[np.float32]]:
    image = np.empty((len(pipeline.grid), len(pipeline.range_m)), np.float32)
    return lambda words: pipeline.process(Measurement(words, settings), out=image).amplitude

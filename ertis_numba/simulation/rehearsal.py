"""Two renderings compared: what an effect really changes in an image."""

import functools
import math

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.errors import ArgumentError
from ertis_numba.settings import Settings
from ertis_numba.simulation.engine import Engine
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sight import SAME_RANGE_M, Sight
from ertis_numba.simulation.snapshot import snapshot
from ertis_numba.stages import planner
from ertis_numba.stages.fast import FastChain

__all__ = ["Rehearsal", "image_change_db"]


_KEPT = 24  # images: most verdicts are about the same effects with one more or less


class Rehearsal:
    """Renders and processes measurements of a scene with some effects and with others.

    The modulators are left out: they answer to any change with other noise, which is no change of the image.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._image = functools.lru_cache(maxsize=_KEPT)(self._rendered)
        self._chain = functools.lru_cache(maxsize=8)(_chain)
        # All renderings have the same noise, which takes as long as the rest of one.
        self._noise = functools.lru_cache(maxsize=1)(_noise)

    def change_db(self, index: int, others: frozenset[str], name: str) -> float | None:
        """Return by how much an effect changes the images of all sensors at the most, in decibels.

        None where a sensor's settings give no image, as with a range window beyond the end of its record.

        Parameters
        ----------
        index : int
            Of the measurement.
        others : frozenset of str
            The other effects.
        name : str
        """
        changes_db = []
        for sensor in self._scene.sensors:
            both = others, others | {name}
            try:
                self._chain(sensor.settings())
            except ArgumentError:
                return None
            before, after = (self._image(sensor.name, index, active) for active in both)
            shot = snapshot(self._scene, sensor, index / self._scene.rate_hz)
            spacing_m = shot.speed_m_s / 2 / sensor.settings().output_rate_hz
            floor = min(Sight(shot, active).floor for active in both)
            changes_db.append(image_change_db(before, after, spacing_m=spacing_m, floor=floor))
        return max(changes_db)

    def _rendered(self, name: str, index: int, active: frozenset[str]) -> NDArray[np.float32]:
        sensor = self._scene.sensor(name)
        signals = Engine(self._scene, sensor, active).signals(index)
        dbfs = sensor.electronics.noise_dbfs
        if "microphone_noise" in active and dbfs is not None:
            signals += 10 ** (dbfs / 20) * self._noise(self._scene.seed, signals.shape)
        chain = self._chain(sensor.settings())
        image = np.empty((len(chain.grid), len(chain.range_m)), dtype=np.float32)
        chain.process_signals(signals, image)
        return image


def image_change_db(
    before: NDArray[np.float32], after: NDArray[np.float32], *, spacing_m: float, floor: float
) -> float:
    """Return by how much two images differ at the most.

    At each place the difference is taken beside the strongest, over all directions and 5 cm of range, that both
    images have there, and at least beside ``floor``: ``20 log10(1 + |Δ| / beside)``. So what hides among
    the side lobes of a stronger echo does not count.

    Parameters
    ----------
    before, after : (direction, range) float32
    spacing_m : float
        Of the ranges.
    floor : float
        The weakest reflector that is to be kept.
    """
    both = np.minimum(before, after).max(axis=0)
    near = 2 * math.ceil(min(SAME_RANGE_M / spacing_m, len(both))) + 1
    beside = np.maximum(scipy.ndimage.maximum_filter1d(both, near), floor)
    return float(20 * np.log10(1 + np.max(np.abs(after - before) / beside, initial=0.0)))


def _noise(seed: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.random.default_rng(seed).standard_normal(shape)


def _chain(settings: Settings) -> FastChain:
    kernel_set = kernels.load("cpu")
    threads = kernel_set.max_threads
    single = settings.replace(
        processing=settings.processing.replace(method="fast"),
        accuracy=settings.accuracy.replace(precision="float32"),
    )
    return FastChain(planner.complete(single, kernel_set, threads=threads), kernel_set, threads=threads)

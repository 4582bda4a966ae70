"""A/B renders: the change of an image by one effect, measured with two renderings."""

import functools
import math

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain import planner
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.geometry import direction_grid
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings
from ertis_numba.simulation.engine import Engine
from ertis_numba.simulation.image_estimate import SAME_RANGE_M, Sight
from ertis_numba.simulation.loudness import LOUD
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.snapshot import snapshot

__all__ = ["ABRender", "image_change_db"]

Image = NDArray[np.float32]

_KEPT = 24  # images: most verdicts compare sets of effects that differ by one
_KEPT_BYTES = 2**28  # total size of the stored images; for large grids it allows only a few


class ABRender:
    """Renders and processes measurements of a scene with two different sets of effects."""

    # Modulators and converters, whose noise any change affects, are left out below 6 dB of full scale.

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._signals = functools.lru_cache(maxsize=2)(self._rendered)
        kept = min(_KEPT, max(2, _KEPT_BYTES // max(_image_bytes(sensor.settings()) for sensor in scene.sensors)))
        self._image = functools.lru_cache(maxsize=kept)(self._imaged)
        self._images = functools.lru_cache(maxsize=max(2, kept // 2))(self._converted)
        self._chain = functools.lru_cache(maxsize=8)(_chain)
        # All renderings share one noise, because drawing it takes as long as the rest of a rendering.
        self._noise = functools.lru_cache(maxsize=1)(_noise)

    def change_db(self, index: int, name: str, others: frozenset[str], effect: str) -> float | None:
        """Return the greatest change of a sensor's image by an effect, given the others; None without an image."""
        sensor, both = self._scene.sensor(name), (others, others | {effect})
        try:
            self._chain(sensor.settings())
        except ArgumentError:
            return None
        shot = snapshot(self._scene, sensor, index / self._scene.rate_hz)
        spacing_m = shot.speed_m_s / 2 / sensor.settings().output_rate_hz
        floor = min(Sight(shot, active).floor for active in both)
        (before, one), (after, other) = (self._image(name, index, active) for active in both)
        change_db = image_change_db(before, after, spacing_m=spacing_m, floor=floor)
        if max(one, other) < LOUD:
            return change_db
        pairs = [self._images(name, index, active) for active in both]
        noise = np.min([_local(np.abs(pair[1] - pair[0]), spacing_m) for pair in pairs], axis=0)
        converted_db = image_change_db(pairs[0][0], pairs[1][0], spacing_m=spacing_m, floor=floor, noise=noise)
        return max(change_db, converted_db)

    def _rendered(self, name: str, index: int, active: frozenset[str]) -> NDArray[np.float64]:
        """Return the input of the modulators or converters, including noise: (mic, sample) float64."""
        sensor = self._scene.sensor(name)
        engine = Engine(self._scene, sensor, active)
        signals, rms = engine.signals(index), engine.noise_rms()
        if rms:
            signals += rms * self._noise(self._scene.seed, signals.shape)
        return signals

    def _imaged(self, name: str, index: int, active: frozenset[str]) -> tuple[Image, float]:
        """Return the image of the signals before conversion, and their highest amplitude."""
        signals = self._signals(name, index, active)
        chain = self._chain(self._scene.sensor(name).settings())
        image = np.empty((len(chain.grid), len(chain.range_m)), dtype=np.float32)
        chain.process_signals(signals, image)
        return image, float(np.abs(signals).max())

    def _converted(self, name: str, index: int, active: frozenset[str]) -> list[Image]:
        """Return two images from the output of the modulators or converters, with different dither."""
        sensor = self._scene.sensor(name)
        engine, signals = Engine(self._scene, sensor, active), self._signals(name, index, active)
        chain = self._chain(sensor.settings())
        images = [np.empty((len(chain.grid), len(chain.range_m)), dtype=np.float32) for _ in range(2)]
        for draw, image in enumerate(images):
            chain.process(engine.converted(signals, draw), image)
        return images


def image_change_db(
    before: Image,
    after: Image,
    *,
    spacing_m: float,
    floor: float,
    noise: Image | float = 0.0,
) -> float:
    """Return the greatest difference of two images (direction, range) in decibels."""
    # It is `20 log10(1 + |Δ| / reference)` less that of `noise`. The reference is the strongest amplitude that both
    # images have over all directions and 5 cm of range, but at least `floor`.
    beside = np.maximum(_local(np.minimum(before, after), spacing_m), floor)
    change = np.maximum(np.abs(after - before) - noise, 0.0)
    return float(20 * np.log10(1 + np.max(change / beside, initial=0.0)))


def _local(image: Image, spacing_m: float) -> Image:
    """Return the highest amplitude over all directions and 5 cm of range: (range,) float32."""
    strongest = image.max(axis=0)
    near = 2 * math.ceil(min(SAME_RANGE_M / spacing_m, len(strongest))) + 1
    return np.asarray(scipy.ndimage.maximum_filter1d(strongest, near))


def _image_bytes(settings: Settings) -> int:
    """Return the approximate size of an image in bytes."""
    range_rate_m = 2 * settings.output_rate_hz / sound_speed_m_s(settings.air)
    n_ranges = np.ptp(settings.processing.range_m) * range_rate_m + 1
    return int(4 * len(direction_grid(settings.processing).azimuth_rad) * n_ranges)


def _noise(seed: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.random.default_rng(seed).standard_normal(shape)


def _chain(settings: Settings) -> FastChain:
    kernel_set = kernels.load_host()
    return FastChain(_planned(settings), kernel_set, threads=kernel_set.max_threads)


@functools.lru_cache(maxsize=8)  # Planning takes as long as a render, and scenes often share their sensors.
def _planned(settings: Settings) -> Settings:
    """Return settings with the plan of a chain."""
    kernel_set = kernels.load_host()
    single = settings.replace(
        processing=settings.processing.replace(method="fast"),
        accuracy=settings.accuracy.replace(precision="float32"),
    )
    return planner.complete(single, kernel_set, threads=kernel_set.max_threads)

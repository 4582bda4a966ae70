"""Separation of two incoherent sources by each method, over many seeds."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench.passive.signals import NoiseSource, listening, noise
from ertis_numba.passive import AcousticCamera

__all__ = ["APART_DEG", "AVERAGES", "BAND_HZ", "SNR_DB", "are_separated", "measure"]

APART_DEG: Final = (5.0, 7.5, 10.0)
"""Angles between the sources."""

BAND_HZ: Final = (38e3, 42e3)
"""Band of the maps."""

SNR_DB: Final = 10.0
"""Level of each source at a microphone relative to the noise of the microphone, both white."""

AVERAGES: Final = (1, 4)
"""Numbers of measurements over which powers are averaged."""

_METHODS: Final[dict[str, dict[str, Any]]] = {
    "delay_and_sum": {},
    "functional": {"method": "functional"},
    "capon": {"method": "capon"},
    "music": {"method": "music", "n_sources": 2},
    "clean_sc": {"method": "clean_sc", "diagonal_removal": True},
}
_DIRECTIONS: Final = "2d:361"  # every half degree
_MAX_AZIMUTH_DEG: Final = 30.0
_TOLERANCE_DEG: Final = 1.5
_RMS: Final = 0.05


def measure(*, count: int, seed: int, say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the share of seeds in which each method separates two sources.

    Parameters
    ----------
    count : int
        Number of seeds.
    seed : int
        First seed.
    say : callable
        Function that reports progress.
    """
    rows: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        cameras = {name: stack.enter_context(_camera(changes)) for name, changes in _METHODS.items()}
        for apart_deg in APART_DEG:
            say(f"separating sources {apart_deg:g}° apart")
            found = {name: dict.fromkeys(AVERAGES, 0) for name in cameras}
            for number in range(seed, seed + count):
                middle_deg = np.random.default_rng((number, 1)).uniform(-_MAX_AZIMUTH_DEG, _MAX_AZIMUTH_DEG)
                true_deg = middle_deg - apart_deg / 2, middle_deg + apart_deg / 2
                for name, averages in _separated(cameras, true_deg, number):
                    found[name][averages] += 1
            rows += [
                {"name": name, "apart_deg": apart_deg, "shares": [each[n] / count for n in AVERAGES]}
                for name, each in found.items()
            ]
    return rows


def _camera(changes: dict[str, Any]) -> AcousticCamera:
    passive = {"bands_hz": [list(BAND_HZ)], **changes}
    settings = listening(
        processing__directions=_DIRECTIONS, **{f"passive__{key}": value for key, value in passive.items()}
    )
    return AcousticCamera(settings, "cpu")


def _separated(cameras: dict[str, AcousticCamera], true_deg: Sequence[float], seed: int) -> Iterator[tuple[str, int]]:
    """Return an iterator over the methods, and the numbers of measurements, that separate two sources."""
    for camera in cameras.values():
        camera.reset()
    for n in range(max(AVERAGES)):
        settings = next(iter(cameras.values())).settings
        own_rms = _RMS * 10 ** (-SNR_DB / 20)
        sources = [NoiseSource(each, 0.0, _RMS) for each in true_deg]
        heard = noise(settings, sources, own_rms=own_rms, seed=seed * max(AVERAGES) + n)
        for name, camera in cameras.items():
            camera.add(heard)
            if n + 1 in AVERAGES:
                azimuth_deg = np.degrees(camera.grid.azimuth_rad)
                if are_separated(camera.map().power[:, 0], azimuth_deg, true_deg):
                    yield name, n + 1


def are_separated(power: NDArray[np.float32], azimuth_deg: NDArray[np.float64], true_deg: Sequence[float]) -> bool:
    """Return True if the two largest local maxima of a map lie within 1.5° of two sources, one beside each.

    Two local maxima always have a dip between them.

    Parameters
    ----------
    power : (direction,) float32
    azimuth_deg : (direction,) float64
        In ascending order.
    true_deg : (first, second)
        Azimuths of the sources.
    """
    padded = np.concatenate([[-np.inf], power, [-np.inf]])
    places = np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]) & (power > 0))
    largest = np.sort(azimuth_deg[places[np.argsort(power[places])[-2:]]])
    return len(largest) == 2 and bool(np.all(np.abs(largest - np.sort(true_deg)) < _TOLERANCE_DEG))

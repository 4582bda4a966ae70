"""Separation of two incoherent sources by each method, over many seeds."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_bench.passive.sound_signals import NoiseSource, listening, noise
from ertis_numba.passive import AcousticCamera

__all__ = ["AVERAGES", "BAND_HZ", "PAIRS", "SNR_DB", "SourcePair", "are_separated", "measure"]


class SourcePair(NamedTuple):
    """Two sources."""

    apart_deg: float
    weaker_db: float = 0.0


PAIRS: Final = (
    SourcePair(2.0),
    SourcePair(2.5),
    SourcePair(5.0),
    SourcePair(7.5),
    SourcePair(10.0),
    SourcePair(5.0, 10.0),
)
"""Pairs of sources to separate."""

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
    "hr_clean_sc": {"method": "hr_clean_sc"},
}
_DIRECTIONS: Final = "2d:361"  # every half degree
_MAX_AZIMUTH_DEG: Final = 30.0
_TOLERANCE_DEG: Final = 1.5
_RMS: Final = 0.05


def measure(*, count: int, seed: int, say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the share of seeds in which each method separates two sources."""
    rows: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        cameras = {name: stack.enter_context(_camera(changes)) for name, changes in _METHODS.items()}
        for pair in PAIRS:
            say(f"separating sources {pair.apart_deg:g}° and {pair.weaker_db:g} dB apart")
            found = {name: dict.fromkeys(AVERAGES, 0) for name in cameras}
            for number in range(seed, seed + count):
                for name, averages in _separated(cameras, pair, number):
                    found[name][averages] += 1
            rows += [
                {"name": name, **pair._asdict(), "shares": [each[n] / count for n in AVERAGES]}
                for name, each in found.items()
            ]
    return rows


def _camera(changes: dict[str, Any]) -> AcousticCamera:
    passive = {"bands_hz": [list(BAND_HZ)], **changes}
    settings = listening(
        processing__directions=_DIRECTIONS, **{f"passive__{key}": value for key, value in passive.items()}
    )
    return AcousticCamera(settings, "cpu", check=False)


def _separated(cameras: dict[str, AcousticCamera], pair: SourcePair, seed: int) -> Iterator[tuple[str, int]]:
    """Return an iterator over the methods, and the numbers of measurements, that separate two sources."""
    for camera in cameras.values():
        camera.reset()
    settings = next(iter(cameras.values())).settings
    middle_deg = np.random.default_rng((seed, 1)).uniform(-_MAX_AZIMUTH_DEG, _MAX_AZIMUTH_DEG)
    true_deg = middle_deg - pair.apart_deg / 2, middle_deg + pair.apart_deg / 2
    weaker, stronger = _RMS * 10 ** (-pair.weaker_db / 20), _RMS
    sources = [NoiseSource(true_deg[0], 0.0, weaker), NoiseSource(true_deg[1], 0.0, stronger)]
    own_rms = _RMS * 10 ** (-SNR_DB / 20)
    for n in range(max(AVERAGES)):
        heard = noise(settings, sources, own_rms=own_rms, seed=seed * max(AVERAGES) + n)
        for name, camera in cameras.items():
            camera.add(heard)
            if n + 1 in AVERAGES:
                azimuth_deg = np.degrees(camera.grid.azimuth_rad)
                if are_separated(camera.map().power[:, 0], azimuth_deg, true_deg):
                    yield name, n + 1


def are_separated(power: NDArray[np.float32], azimuth_deg: NDArray[np.float64], true_deg: Sequence[float]) -> bool:
    """Return True if the two largest local maxima of a map lie near two sources, one beside each.

    Both must lie within 1.5° of their source, and nearer to it than to the middle between both. Two local maxima always
    have a dip between them.

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
    tolerance_deg = min(_TOLERANCE_DEG, abs(true_deg[1] - true_deg[0]) / 2)
    return len(largest) == 2 and bool(np.all(np.abs(largest - np.sort(true_deg)) < tolerance_deg))

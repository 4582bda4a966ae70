"""When and how strongly every sound of a scene reaches every microphone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.frames import Peak
from ertis_numba.geometry import Layout, microphones, unit_vectors
from ertis_numba.simulation.scene import Point, Scene

__all__ = ["Arrivals", "arrivals", "true_peaks"]

_NEAREST_M = 0.01  # emitters, reflectors and microphones have a size: amplitudes stop growing here
_TICK_S = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """Delayed and attenuated copies of the call, one row per way of the sound.

    Attributes
    ----------
    delay_s : (way, mic) float64
        From the start of the emission, the microphone's own lateness included.
    amplitude : (way, mic) float64
        The microphone's own sensitivity included.
    """

    delay_s: NDArray[np.float64]
    amplitude: NDArray[np.float64]


def arrivals(scene: Scene) -> Arrivals:
    """Return all arrivals of a scene: the direct sound first, then the points in their order.

    A point returns the call on spherical waves, ``a = s / (r_tx r_rx)`` after ``(r_tx + r_rx) / c``,
    from the emitter at the origin to the point and on to each microphone; the direct sound is
    ``s / r`` after ``r / c``. Delays are whole picoseconds: far finer than what can be measured, but
    coarse enough that the last digits of sines and roots, in which processors differ, do not show.
    """
    layout = microphones(scene.sensor.array)
    positions_m = layout.enabled_positions_m
    ways_m, amplitudes = [], []
    if scene.direct_sound is not None:
        there_m = _length(positions_m)
        ways_m.append(there_m)
        amplitudes.append(_linear(scene.direct_sound.strength_db) / np.maximum(there_m, _NEAREST_M))
    for point in scene.points:
        back_m = _back_m(point, layout)
        ways_m.append(point.range_m + back_m)
        amplitudes.append(_amplitude(point, back_m))
    wanted = (len(ways_m), len(positions_m))
    delay_s = np.reshape(ways_m, wanted) / sound_speed_m_s(scene.sensor.air) + layout.delay_s[layout.enabled]
    return Arrivals(
        delay_s=np.rint(delay_s / _TICK_S) * _TICK_S,
        amplitude=np.reshape(amplitudes, wanted) * layout.gain[layout.enabled],
    )


def true_peaks(scene: Scene) -> list[Peak]:
    """Return the points as an image should show them, strongest first.

    The level is that of the mean amplitude over the microphones, spreading included, below the
    strongest point.
    """
    layout = microphones(scene.sensor.array)
    amplitudes = [float(np.mean(_amplitude(point, _back_m(point, layout)))) for point in scene.points]
    peaks = [
        Peak(
            azimuth_deg=point.azimuth_deg,
            elevation_deg=point.elevation_deg,
            range_m=point.range_m,
            level_db=float(20 * np.log10(amplitude / max(amplitudes))),
        )
        for point, amplitude in zip(scene.points, amplitudes, strict=True)
    ]
    return sorted(peaks, key=lambda peak: -peak.level_db)


def _back_m(point: Point, layout: Layout) -> NDArray[np.float64]:
    """Return the distance from a point to each microphone: (mic,)."""
    direction = unit_vectors(np.radians(point.azimuth_deg), np.radians(point.elevation_deg))
    return _length(point.range_m * direction - layout.enabled_positions_m)


def _amplitude(point: Point, back_m: NDArray[np.float64]) -> NDArray[np.float64]:
    spread_m2 = max(point.range_m, _NEAREST_M) * np.maximum(back_m, _NEAREST_M)
    return np.asarray(_linear(point.strength_db) / spread_m2)


def _length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.sum(vectors**2, axis=-1)))


def _linear(level_db: float) -> float:
    return float(10 ** (level_db / 20))

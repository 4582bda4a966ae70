"""Arrays with random errors, their recordings of one reflector, and errors of their calibration."""

import gc
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ertis_numba.calibration import Calibration
from ertis_numba.frames import Measurement
from ertis_numba.geometry import load_layout, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Array
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator

__all__ = ["FaultyArray", "calibration_errors", "faulty_array", "image_losses", "record"]

LAYOUT: Final = "eRTIS_v3D1"
_GAIN_DB, _DELAY_S, _MOVED_M = 3.0, 5e-6, 1e-3  # largest errors
_MAX_DEAD, _MAX_SWAPS, _MAX_INVERTED = 4, 2, 2
_AZIMUTH_DEG, _ELEVATION_DEG, _RANGE_M = 60.0, 40.0, (0.8, 2.0)
_STRENGTH_DB, _LEVEL_DB = -10.0, -6.0


@dataclass(frozen=True, slots=True, eq=False)
class FaultyArray:
    """Array whose microphones differ from its layout.

    Attributes
    ----------
    gain_db, delay_s : (channel,) float64
    positions_m : (channel, axis) float64
        Positions of the microphones on each channel.
    order : (channel,) int64
        Index of the position in the layout of each channel.
    dead, inverted : tuple of int
        Channels without sound, and with inverted polarity.
    """

    gain_db: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    positions_m: NDArray[np.float64]
    order: NDArray[np.int64]
    dead: tuple[int, ...]
    inverted: tuple[int, ...]

    @property
    def displaced(self) -> tuple[int, ...]:
        """Channels that are not in their places and that sound."""
        return tuple(int(i) for i in np.flatnonzero(self.order != np.arange(len(self.order))) if i not in self.dead)


def faulty_array(seed: int, *, healthy: bool = False) -> FaultyArray:
    """Return an array with random gains, delays and positions, and, unless healthy, with random faults."""
    rng = np.random.default_rng(seed)
    layout = load_layout(LAYOUT)
    n = len(layout.enabled)
    gain_db = rng.uniform(-_GAIN_DB, _GAIN_DB, n)
    delay_s = rng.uniform(-_DELAY_S, _DELAY_S, n)
    moved_m = rng.uniform(-_MOVED_M, _MOVED_M, (n, 3))
    order = np.arange(n)
    dead: tuple[int, ...] = ()
    inverted: tuple[int, ...] = ()
    if not healthy:
        dead = tuple(sorted(rng.choice(n, rng.integers(0, _MAX_DEAD + 1), replace=False).tolist()))
        alive = np.setdiff1d(np.arange(n), dead)
        for _ in range(rng.integers(0, _MAX_SWAPS + 1)):
            pair = rng.choice(alive, 2, replace=False)
            order[pair] = order[pair[::-1]]
        inverted = tuple(sorted(rng.choice(alive, rng.integers(0, _MAX_INVERTED + 1), replace=False).tolist()))
    return FaultyArray(gain_db, delay_s, layout.positions_m[order] + moved_m, order, dead, inverted)


def record(array: FaultyArray, seed: int, count: int, *, noise_dbfs: float = -50.0) -> list[Measurement]:
    """Return recordings of a reflector at random places, with the settings of the layout."""
    rng = np.random.default_rng((seed, 1))
    real = Array(
        layout="real",
        positions_m=tuple((float(x), float(y), float(z)) for x, y, z in array.positions_m),
        gain=tuple((10 ** (array.gain_db / 20)).tolist()),
        delay_s=tuple(array.delay_s.tolist()),
    )
    sensor = Sensor(
        array=real,
        emitter=Emitter(level_db=_LEVEL_DB),
        electronics=Electronics(noise_dbfs=noise_dbfs, dead_channels=array.dead),
    )
    plan, made = None, []
    gc.collect()  # The renderers of former arrays refer to themselves, and hold 40 MB each.
    for number in range(count):
        reflector = Point(
            azimuth_deg=float(rng.uniform(-_AZIMUTH_DEG, _AZIMUTH_DEG)),
            elevation_deg=float(rng.uniform(-_ELEVATION_DEG, _ELEVATION_DEG)),
            range_m=float(rng.uniform(*_RANGE_M)),
            strength_db=_STRENGTH_DB,
        )
        scene = Scene(seed=1000 * seed + number, points=(reflector,), sensors=(sensor,))
        simulator = Simulator(scene, plan=plan)
        plan = simulator.plan  # A reflector elsewhere needs the same effects, and plans take longer than renderings.
        found = simulator.render(0)
        words = found.data.copy()
        for channel in array.inverted:
            words ^= words.dtype.type(1 << channel)
        made.append(replace(found, data=words, settings=found.settings.replace(array=Array(layout=LAYOUT))))
    return made


def calibration_errors(array: FaultyArray, made: Calibration) -> NDArray[np.float64]:
    """Return the errors of gain in dB, delay in µs, and x, y and z in mm: (mic, quantity) float64.

    Errors exclude what no recording can observe: a common gain and delay, and a rotation and shift of the array.
    """
    channels = list(made.channels)
    found_m = made.layout.positions_m[channels]
    later_us = 1e6 * (made.layout.delay_s - array.delay_s)[channels]
    gain_db = (20 * np.log10(np.abs(made.layout.gain)) - array.gain_db)[channels]
    return np.column_stack(
        [
            gain_db - gain_db.mean(),
            later_us - later_us.mean(),
            1e3 * (found_m - _turned_onto(array.positions_m[channels], found_m)),
        ]
    )


def _turned_onto(positions_m: NDArray[np.float64], others_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions, rotated and shifted as near as possible to others."""
    centred_m = positions_m - positions_m.mean(axis=0)
    rotation, _ = Rotation.align_vectors(others_m - others_m.mean(axis=0), centred_m)
    return np.asarray(rotation.apply(centred_m) + others_m.mean(axis=0))


def image_losses(array: FaultyArray, made: Calibration, *, calibrated: bool = True) -> tuple[float, float]:
    """Return the largest loss of level, and rise of side lobes, relative to the perfectly known array, in dB.

    Beams for nine directions are computed for plane waves at nine frequencies of the call, and their powers are added.
    Side lobes are maxima of the pattern outside its main lobe, within 60° of azimuth and 40° of elevation.
    """
    channels = list(made.channels)
    layout = made.layout if calibrated else made.former
    real_m = _turned_onto(array.positions_m[channels], made.layout.positions_m[channels])
    sign = np.where(np.isin(channels, array.inverted), -1.0, 1.0)
    real = sign * 10 ** (array.gain_db[channels] / 20)
    speed_m_s = sound_speed_m_s(Sensor().air)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-60, 61, 2.0)), np.radians(np.arange(-40, 41, 2.0)))
    from_all = unit_vectors(azimuth.ravel(), elevation.ravel())
    waves = 2j * np.pi * np.linspace(27e3, 48e3, 9)[:, None, None]
    arriving = real * np.exp(-waves * (array.delay_s[channels] - from_all @ real_m.T / speed_m_s))
    losses, rises = [], []
    for towards in unit_vectors(*np.radians([[-40.0, 0.0, 40.0] * 3, [-20.0] * 3 + [0.0] * 3 + [20.0] * 3])):
        patterns = []
        for gain, delay_s, places_m in (
            (real, array.delay_s[channels], real_m),
            (layout.gain[channels], layout.delay_s[channels], layout.positions_m[channels]),
        ):
            weights = np.exp(waves[:, 0] * (delay_s - places_m @ towards / speed_m_s)) / gain
            beams = np.einsum("fdm,fm->fd", arriving, weights) / len(channels)
            patterns.append(np.sum(np.abs(beams) ** 2, axis=0).reshape(azimuth.shape))
        perfect, found = patterns
        # A common gain is not observable, and does not change an image relative to its maximum.
        scale = np.mean(np.abs(real)) / np.mean(np.abs(layout.gain[channels]))
        losses.append(10 * np.log10(perfect.max() / (found.max() / scale**2)))
        rises.append(_side_lobe_db(found) - _side_lobe_db(perfect))
    return float(max(losses)), float(max(rises))


def _side_lobe_db(pattern: NDArray[np.float64]) -> float:
    """Return the level of the highest maximum besides the main one."""
    padded = np.pad(pattern, 1, constant_values=-np.inf)
    around = [np.roll(padded, (i, j), (0, 1))[1:-1, 1:-1] for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    maxima = np.sort(pattern[pattern > np.max(around, axis=0)])
    return float(10 * np.log10(maxima[-2] / maxima[-1])) if len(maxima) > 1 else -np.inf

"""Recordings with healthy and faulty microphones, for the tests of array health."""

import dataclasses
import functools
import importlib.metadata
from pathlib import Path

import numpy as np

from ertis_numba.frames import Measurement
from ertis_numba.settings import Recording, Settings
from ertis_numba.simulation import Electronics, Point
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.render import Simulator
from tests.scenes import SENSOR, line_array, only, scene_of

ROOT = Path(__file__).parents[1]
DATA = ROOT / "data" / "synthetic"
RAW = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
REAL = Settings.from_preset("default_25_50")
EIGHT = SENSOR.replace(
    array=line_array(8, 0.004).replace(word_bits=8),
    recording=Recording(n_samples=65_536),
    electronics=Electronics(noise_dbfs=-45.0),
)
ECHOES = (Point(range_m=0.5, strength_db=-20), Point(azimuth_deg=40, range_m=0.9, strength_db=-10))


def rendered(sensor=EIGHT, *points, **more):
    """Render a measurement with every effect on."""
    return Simulator(scene_of(*(points or ECHOES), sensor=sensor, **more), plan=only(*EFFECTS)).render()


@functools.cache
def sound():
    return rendered()


@functools.cache
def real():
    return Measurement(np.fromfile(RAW, dtype="<u4"), REAL)


def with_bits(measurement, channel, bits):
    """Replace the bits of one channel, (sample,) of 0 and 1, in words of 8 or 32 bits."""
    words = measurement.data & ~words_bit(measurement, channel)
    return dataclasses.replace(measurement, data=words | (np.asarray(bits).astype(words.dtype) << channel))


def words_bit(measurement, channel):
    return measurement.data.dtype.type(1 << channel)


def modulated(signal, channel=0):
    """The healthy measurement with another signal in one channel, converted by a first-order modulator."""
    total = np.floor(np.cumsum((1 + np.clip(signal, -1, 1)) / 2 + np.zeros(65_536)))
    return with_bits(sound(), channel, np.diff(total, prepend=0.0) > 0)


TIME_S = np.arange(65_536) / 4.5e6
NOISE = 0.01 * np.random.default_rng(5).standard_normal(65_536)

BY_HAND = {
    "stuck at 0": lambda: with_bits(sound(), 3, np.zeros(65_536)),
    "stuck at 1": lambda: with_bits(sound(), 3, np.arange(65_536) % 10_000 > 0),  # with an occasional glitch
    "stuck in a pattern": lambda: with_bits(sound(), 3, np.arange(65_536) % 2),
    "offset": lambda: modulated(0.08 + NOISE + 0.05 * np.sin(2.5e5 * TIME_S), 3),
    "saturated": lambda: modulated(1.5 * np.sin(2.5e5 * TIME_S) * (TIME_S < 2.5e-3) + NOISE, 3),
    "idle tone": lambda: modulated(NOISE + 0.03 * np.sin(2 * np.pi * 31e3 * TIME_S), 3),
    "dead": lambda: with_bits(sound(), 3, np.random.default_rng(2).random(65_536) < 0.5),
}

"""Echoes of points, rendered as delayed sweeps with noise, and standardised errors of what the library locates.

Nothing here comes from the simulator: sweep, ramps, spherical wavefronts, noise and the bits of microphones are written
out again.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

import ertis_numba as ertis
from ertis_numba.frames import Measurement
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Accuracy, Array, Processing, Recording, Settings

RATE_HZ = 450_000.0
AMPLITUDE = 0.01


@dataclass(frozen=True, slots=True)
class Case:
    """Images of one kind, and the places and levels of the echoes in them."""

    directions: str
    snr_db: float
    layout: str = "eRTIS_v3D1"
    azimuth_deg: tuple[float, float] = (-60.0, 60.0)
    elevation_deg: tuple[float, float] = (-35.0, 35.0)
    range_m: tuple[float, float] = (0.65, 1.05)
    limits_deg: tuple[float, float, float, float] = (-70.0, 70.0, -50.0, 50.0)
    budget_db: float = -35.0
    wavefront: str = "spherical"
    encoding: str = "float32"
    is_plane: bool = False
    window_m: tuple[float, float] = (0.6, 1.1)
    n_samples: int = 4_096

    @property
    def is_planar(self):
        return self.directions.startswith("2d")


def unit(azimuth_deg, elevation_deg):
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])


def sweep(time_s, *, first_hz=50e3, last_hz=25e3, duration_s=2.5e-3, ramp=0.1):
    """Hyperbolic sweep with ramps of a squared sine, 0 outside: an array like ``time_s``."""
    inside = (time_s >= 0) & (time_s <= duration_s)
    time_s = np.where(inside, time_s, 0.0)
    rate = (1 / last_hz - 1 / first_hz) / duration_s
    phase = 2 * math.pi / rate * np.log(1 + time_s * rate * first_hz)
    edge_s = np.minimum(time_s, duration_s - time_s)
    return np.where(
        inside, np.sin(phase) * np.sin(0.5 * math.pi * np.minimum(1.0, edge_s / (ramp * duration_s))) ** 2, 0
    )


def absorption_1_m(frequency_hz):
    """Nepers per metre of air of 20 °C and 50 % humidity at sea level, after ISO 9613-1: an array like the argument."""
    water = 50 * 10 ** (4.6151 - 6.8346 * (273.16 / 293.15) ** 1.261)
    oxygen_hz = 24 + 4.04e4 * water * (0.02 + water) / (0.391 + water)
    nitrogen_hz = 9 + 280 * water
    oxygen = 0.01275 * math.exp(-2239.1 / 293.15) / (oxygen_hz + frequency_hz**2 / oxygen_hz)
    nitrogen = 0.1068 * math.exp(-3352.0 / 293.15) / (nitrogen_hz + frequency_hz**2 / nitrogen_hz)
    return frequency_hz**2 * (1.84e-11 + oxygen + nitrogen)


def compressed(path_m):
    """Amplitude of the compressed pulse after a path through air, relative to that of the call."""
    frequency_hz, bins = np.fft.rfftfreq(2_048, 1 / RATE_HZ), np.fft.rfft(sweep(np.arange(2_048) / RATE_HZ))
    inside = np.clip(np.minimum((frequency_hz - 20e3) / 5e3, (55e3 - frequency_hz) / 5e3), 0, 1)
    power = np.abs(bins) ** 2 * np.sin(math.pi / 2 * inside) ** 2
    return float(power @ np.exp(-path_m * absorption_1_m(frequency_hz)) / power.sum())


@njit(cache=True)
def bits_of(signal):
    """One-bit samples of a second-order modulator: (mic, sample) uint8."""
    out = np.zeros(signal.shape, np.uint8)
    for mic in range(signal.shape[0]):
        first = second = 0.0
        for sample in range(signal.shape[1]):
            is_up = second >= 0.0
            fed = 1.0 if is_up else -1.0
            first += signal[mic, sample] - fed
            second += first - fed
            out[mic, sample] = is_up
    return out


class Draws:
    """Pipeline of a case, and random echoes for it."""

    def __init__(self, case):
        self.case = case
        low_deg, high_deg = (0.0, 0.0) if case.is_planar else case.limits_deg[2:]
        spatial = {} if case.is_planar else {"elevation_limits_deg": (low_deg, high_deg)}
        is_pdm = case.encoding == "pdm"
        self.rate_hz, self.n_samples = (10 * RATE_HZ, 10 * case.n_samples) if is_pdm else (RATE_HZ, case.n_samples)
        settings = Settings(
            array=Array(layout=case.layout),
            recording=Recording(sample_rate_hz=self.rate_hz, n_samples=self.n_samples, encoding=case.encoding),
            processing=Processing(
                directions=case.directions,
                azimuth_limits_deg=case.limits_deg[:2],
                range_m=case.window_m,
                range_decimation=100 if is_pdm else 10,
                wavefront=case.wavefront,
                **spatial,
            ),
            accuracy=Accuracy(max_error_db=case.budget_db),
        )
        self.pipeline = ertis.Pipeline(settings, threads=1, predict=False)
        self.settings = self.pipeline.settings
        layout = ertis.geometry.microphones(settings.array)
        self.positions_m, self.enabled = layout.enabled_positions_m, np.asarray(layout.enabled)
        self.extract = ertis.PointExtractor(self.settings, self.pipeline.grid)
        self.speed_m_s = sound_speed_m_s(settings.air)
        rng = np.random.default_rng(99)
        noise = self.image(rng.standard_normal((len(self.positions_m), self.n_samples)))
        self.noise = math.sqrt(np.mean(noise.amplitude.astype(float) ** 2))

    def signals(self, direction, range_m):
        """Echo at each microphone whose compressed pulse has the amplitude 1, without noise: (mic, sample)."""
        if self.case.is_plane:
            path_m = 2 * range_m - self.positions_m @ direction
        else:
            path_m = range_m + np.linalg.norm(range_m * direction - self.positions_m, axis=1)
        first = 1 if self.case.encoding == "pdm" else 0  # The modulator delays by a sample.
        time_s = (first + np.arange(self.n_samples)) / self.rate_hz
        heard = sweep(time_s - path_m[:, None] / self.speed_m_s)
        loss_1_m = absorption_1_m(np.fft.rfftfreq(self.n_samples, 1 / self.rate_hz))
        bins = np.fft.rfft(heard) * np.exp(-path_m[:, None] * loss_1_m)
        return np.fft.irfft(bins, self.n_samples) / compressed(2 * range_m)

    def image(self, signals):
        """Image of signals, (mic, sample)."""
        every = np.zeros((self.n_samples, len(self.enabled)), np.float32)
        every[:, self.enabled] = AMPLITUDE * signals.T
        if self.case.encoding == "pdm":
            bits = bits_of(np.ascontiguousarray(every.T.astype(np.float64)))
            words = np.ascontiguousarray(np.packbits(bits.T, axis=1, bitorder="little")).view("<u4")[:, 0]
        else:
            words = every
        return self.pipeline.process(Measurement(words, self.settings))

    def place(self, rng):
        """Direction in degrees and range of a random echo."""
        azimuth, low, high = rng.uniform(*self.case.azimuth_deg), *self.case.elevation_deg
        elevation = 0.0 if self.case.is_planar else rng.uniform(low, high)
        return azimuth, elevation, rng.uniform(*self.case.range_m)

    def drawn(self, rng):
        """Image of a random echo in noise, and its place."""
        place = self.place(rng)
        heard = self.signals(unit(*place[:2]), place[2])
        noise = AMPLITUDE / self.noise * 10 ** (-self.case.snr_db / 20)
        return self.image(heard + noise * rng.standard_normal(heard.shape)), place

"""Uncertainty of points: two in three lie within it, whatever the grid, the budget and the noise."""

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.air import sound_speed_m_s
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.settings import Accuracy, Processing, Recording, Settings
from ertis_numba.stages import planner
from ertis_numba.stages.fast import FastChain
from ertis_numba.stages.points import PointExtractor
from ertis_numba.waveform import call_at

N_TRIALS = 24
LEAST, MOST = 0.4, 0.98  # chance leaves 68 % between 40 and 92 %; side lobes at 60 dB count as noise


class Trials:
    """Echoes at random places in noise, and the points that are found of them."""

    def __init__(self, directions, max_error_db):
        elevations = {"elevation_limits_deg": (-50.0, 50.0)} if directions.startswith("3d") else {}
        processing = Processing(
            directions=directions, range_m=(0.6, 1.1), azimuth_limits_deg=(-70.0, 70.0), **elevations
        )
        accuracy = Accuracy(max_error_db=max_error_db)
        settings = Settings(recording=Recording(n_samples=40_960), processing=processing, accuracy=accuracy)
        device = kernels.load("cpu")
        self.settings = planner.complete(settings, device, threads=1)
        self.chain = FastChain(self.settings, device, threads=1)
        self.extract = PointExtractor(self.settings)
        self.grid = direction_grid(self.settings.processing)
        self.positions_m = microphones(self.settings.array).enabled_positions_m
        self.speed_m_s = sound_speed_m_s(self.settings.air)
        self.time_s = np.arange(40_960) / self.settings.recording.sample_rate_hz
        self.is_planar = directions.startswith("2d")
        noise = self.image(np.random.default_rng(99).standard_normal((len(self.positions_m), 40_960)))
        self.noise = self.image(self.echo(np.array([1.0, 0.0, 0.0]), 0.85)).max() / np.sqrt(np.mean(noise**2))

    def image(self, signals):
        out = self.chain.new_image()
        self.chain.process_signals(0.01 * signals, out)
        return out.astype(float)

    def echo(self, direction, range_m):
        delays_s = (2 * range_m - self.positions_m @ direction) / self.speed_m_s
        return np.array([call_at(self.settings.call, self.time_s - delay_s) for delay_s in delays_s])

    def errors(self, ratio, n_trials, seed):
        """Errors along range and across, in the direction that the array tells least, by what is said of them."""
        rng = np.random.default_rng(seed)
        found = []
        for _ in range(n_trials):
            azimuth_rad = np.radians(rng.uniform(-60, 60))
            elevation_rad = 0.0 if self.is_planar else np.radians(rng.uniform(-35, 35))
            range_m = rng.uniform(0.7, 1.0)
            (direction,) = unit_vectors(np.array([azimuth_rad]), np.array([elevation_rad]))
            heard = self.echo(direction, range_m)
            energy = self.image(heard + self.noise / ratio * rng.standard_normal(heard.shape)).astype(np.float32)
            image = Energyscape(
                energy, self.grid.azimuth_rad, self.grid.elevation_rad, self.chain.range_m, self.settings
            )
            cloud = self.extract(image)
            point = cloud.position_m[0].astype(float)
            at_m = np.linalg.norm(point)
            upwards = np.arcsin(point[2] / at_m) - elevation_rad
            sideways = np.cos(elevation_rad) * (np.arctan2(point[1], point[0]) - azimuth_rad)
            across_m = range_m * (sideways if self.is_planar else upwards)  # eRTIS is wider than it is high
            found.append(np.array([at_m - range_m, across_m]) / cloud.uncertainty_m[0])
        return np.array(found)


@pytest.mark.parametrize(("directions", "max_error_db"), [("2d:91", -35.0), ("3d:600", -20.0), ("3d:600", -60.0)])
def test_two_thirds_of_points_lie_within_one_standard_deviation(directions, max_error_db):
    trials = Trials(directions, max_error_db)
    for ratio in (10.0, 1000.0):
        within = np.mean(np.abs(trials.errors(ratio, N_TRIALS, seed=1)) < 1, axis=0)
        assert (within > LEAST).all(), (ratio, within)
        assert (within < MOST).all(), (ratio, within)

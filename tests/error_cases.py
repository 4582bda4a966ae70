"""Scenes and plans for the tests of the error model, and nearly exact images."""

import functools

import numpy as np

from ertis_numba import kernels
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.planner import Planner
from ertis_numba.chain.signal_model import signal_model_of
from ertis_numba.geometry import microphones
from ertis_numba.settings import Accuracy, Array, Call, Processing, Recording
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator
from tests import reference
from tests.scenes import only

CPU = kernels.load("cpu")
BEST = Accuracy(
    precision="float32",
    oversampling=6,
    delay_taps=6,
    beam_taps=0,
    beam_density=2.0,
    stopband_attenuation_db=140.0,
    focal_zones=1,
)
"""The plan of the reference image, which differs from the exact image by -115 dB or less."""


def _plan(**changes):
    return BEST.replace(**changes)


PLANS = {
    # Each part of the error alone, then plans as a planner chooses them.
    **{
        f"delays {oversampling} {taps}": _plan(oversampling=oversampling, delay_taps=taps)
        for oversampling, taps in [(1, 2), (4, 1), (16, 1), (2, 2), (6, 2), (3, 3), (1, 4), (2, 4), (4, 4), (2, 6)]
    },
    **{
        f"nodes {taps} {density:g}": _plan(beam_taps=taps, beam_density=density)
        for taps, density in [(2, 2.0), (2, 4.0), (4, 1.25), (4, 2.0), (4, 3.0), (6, 1.75), (6, 3.0)]
    },
    # Beam grids average the errors of delays, at most where delays are interpolated between fine steps.
    "delays 16 1, nodes": _plan(oversampling=16, delay_taps=1, beam_taps=6, beam_density=3.0),
    "delays 4 2, nodes": _plan(oversampling=4, delay_taps=2, beam_taps=6, beam_density=3.0),
    "delays 2 2, nodes": _plan(oversampling=2, delay_taps=2, beam_taps=4, beam_density=3.0),
    "16 bits": _plan(precision="int16", oversampling=8, delay_taps=4),
    "16 bits, one tap": _plan(precision="int16", oversampling=64, delay_taps=1),
    "16 bits, nodes": _plan(precision="int16", beam_taps=4, beam_density=3.0),
    **{
        f"stop band {stopband_attenuation_db:g}": _plan(stopband_attenuation_db=stopband_attenuation_db)
        for stopband_attenuation_db in (40.0, 60.0, 80.0, 100.0)
    },
    "draft": _plan(precision="int16", oversampling=1, delay_taps=2, beam_taps=2, stopband_attenuation_db=40.0),
    "standard": _plan(precision="int16", oversampling=2, delay_taps=2, beam_taps=4, stopband_attenuation_db=40.0),
    "fine": _plan(precision="int16", oversampling=3, delay_taps=3, beam_taps=6, stopband_attenuation_db=60.0),
}


def tuned_for(settings, plan):
    return settings.replace(accuracy=plan)


def image_of(measurement, settings):
    """Compute an image with a complete plan: (direction, range) float32."""
    chain = FastChain(settings, CPU, threads=1)
    image = np.empty((len(chain.grid), len(chain.range_m)), dtype=np.float32)
    chain.process(measurement.data.reshape(len(measurement.data), -1), image)
    return image


class Rated:
    """A measurement with the predicted and the measured error of plans in its image."""

    def __init__(self, measurement, settings):
        self.measurement, self.settings = measurement, settings
        self.signal_model = signal_model_of(measurement, settings, CPU, threads=2)
        self._best = image_of(measurement, tuned_for(settings, BEST))

    def predicted(self, plan):
        """Predict the error of a plan with the signal model of the measurement."""
        settings = tuned_for(self.settings, plan)
        return Planner(settings, CPU, threads=1, signal_model=self.signal_model).chosen(plan)

    def measured_db(self, plan):
        image = image_of(self.measurement, tuned_for(self.settings, plan))
        return reference.error_db(image.astype(float), self._best.astype(float))


def random_measurement(seed):
    """Render echoes inside or outside the field of view, some with noise, for a random part of the eRTIS array."""
    random = np.random.default_rng(seed)
    layout = microphones(Array())
    heard = np.zeros(32, dtype=bool)
    heard[random.permutation(32)[: random.integers(8, 33)]] = True
    wide = random.random() < 0.5
    low_deg, high_deg = sorted(random.uniform(-90, 90, 2))
    if high_deg - low_deg < 30:
        low_deg, high_deg = -60.0, 60.0
    processing = Processing(
        directions=f"{random.choice(['2d', '3d'])}:{random.integers(100, 201)}",
        azimuth_limits_deg=(float(low_deg), float(high_deg)),
        elevation_limits_deg=(-60.0, 60.0),
        range_m=(0.3, 0.9),
        range_decimation=40 if wide else 100,
        wavefront="plane",
    )
    points = tuple(
        Point(
            azimuth_deg=float(random.uniform(-90, 90)),
            elevation_deg=float(random.uniform(-50, 50)) if random.random() < 0.5 else 0.0,
            range_m=(range_m := float(random.uniform(0.25, 0.95))),
            strength_db=float(random.uniform(-40, -6) + 40 * np.log10(range_m)),
        )
        for _ in range(random.integers(1, 30 if random.random() < 0.3 else 5))
    )
    sensor = Sensor(
        array=Array(
            layout="some of eRTIS",
            positions_m=tuple(map(tuple, layout.positions_m.tolist())),
            enabled=tuple(heard.tolist()),
        ),
        call=Call(start_frequency_hz=80e3, stop_frequency_hz=20e3) if wide else Call(),
        recording=Recording(n_samples=36_000),
        processing=processing,
        emitter=Emitter(level_db=-15.0),
        electronics=Electronics(noise_dbfs=float(random.uniform(-70, -25)) if random.random() < 0.5 else None),
    )
    scene = Scene(seed=seed, sensors=(sensor,), points=points)
    simulator = Simulator(scene, plan=only("spreading", "microphone_noise"))
    return simulator.render(), sensor.settings()


@functools.lru_cache(maxsize=60)
def rated(seed):
    return Rated(*random_measurement(seed))

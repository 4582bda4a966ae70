"""Bearings of simulated sources: errors relative to the Cramér-Rao bound, and leaks in ambient noise."""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Bearing, Measurement, Stamp
from ertis_numba.geometry import far_field_delays, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive import AcousticCamera, BearingFinder
from ertis_numba.settings import Settings
from ertis_numba.simulation import Scene
from ertis_numba.simulation.render import Simulator

__all__ = ["away_deg", "bound_rad", "errors_at", "leak_scene", "measure", "plane_wave", "plane_wave_settings"]

Floats = NDArray[np.float64]

SNRS_DB: Final = (-10, -5, 0, 5, 10, 15, 20)
BAND_HZ: Final = (35e3, 45e3)
NOISE_BAND_HZ: Final = (30e3, 50e3)
FALSE_ALARM: Final = 0.01
_NOISE: Final = 0.01
_STEP_RAD: Final = 1e-5
_LEAK_M: Final = 2.5
_AVERAGES: Final = 10
_NEAR_DEG: Final = 2.0


def measure(seeds: int, seed: int, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Return errors of bearings relative to the bound, and the share of leaks found.

    Returns
    -------
    dict
        ``errors``: for each SNR, the root mean square of the errors and of the bounds in degrees, their ratio, the root
        mean square of errors relative to their stated standard deviations, and the number of trials without a bearing.
        ``leak``: trials, leaks found within 2°, trials with a bearing elsewhere, and the requested rate.
    """
    settings = plane_wave_settings()
    errors = []
    with AcousticCamera(settings, "cpu", check=False) as camera:
        finder = BearingFinder(camera, false_alarm=FALSE_ALARM)
        for snr_db in SNRS_DB:
            errors.append(errors_at(camera, finder, snr_db, seeds=seeds, seed=seed))
            say(f"{snr_db} dB: {errors[-1]['ratio']:.2f} times the bound")
    leak = _leaks(seeds=seeds, seed=seed, say=say)
    return {"band_hz": BAND_HZ, "errors": errors, "leak": leak}


def plane_wave_settings() -> Settings:
    """Return settings of the eRTIS with 36 ms of PCM, one band, and directions all around the front."""
    return Settings().replace(
        **{
            "recording.encoding": "float32",
            "recording.sample_rate_hz": 225e3,
            "recording.n_samples": 8192,
            "processing.directions": "3d:3000",
            "passive.bands_hz": [list(BAND_HZ)],
            "passive.resolution_hz": 250.0,
        }
    )


def plane_wave(settings: Settings, direction: Floats, snr_db: float, seed: int) -> Measurement:
    """Return a measurement of white noise as a plane wave, and of white noise of the microphones.

    Parameters
    ----------
    settings : Settings
    direction : (1, axis) float64
        Unit vector towards the source.
    snr_db : float
        Power of the source relative to the noise of a microphone.
    seed : int
    """
    random, recording = np.random.default_rng(seed), settings.recording
    frequency_hz = np.fft.rfftfreq(recording.n_samples, 1 / recording.sample_rate_hz)
    source = np.fft.rfft(random.standard_normal(recording.n_samples))
    turns = np.exp(-2j * np.pi * frequency_hz * _delays(settings, direction)[0][:, None])
    heard = 10 ** (snr_db / 20) * np.fft.irfft(source * turns, recording.n_samples)
    samples = _NOISE * (heard + random.standard_normal(heard.shape))
    return Measurement(np.ascontiguousarray(samples.T, np.float32), settings, Stamp(behaviour="passive"))


def bound_rad(settings: Settings, direction: Floats, snr_db: float) -> Floats:
    """Return the Cramér-Rao bound of the covariance of a direction's errors, sideways and upwards: (2, 2) float64.

    A source and noise with flat spectra S and σ² over a band B for a time T have ``B T`` independent complex samples.
    The Fisher information of each at the angular frequency ω is ``2 (S² M / (σ² (σ² + M S))) Re(∂v^H P ∂v)``, where v
    is the wave at M microphones and ``P = I − v v^H / M`` (P. Stoica and A. Nehorai, Performance study of conditional
    and unconditional direction-of-arrival estimation, IEEE Trans. ASSP 38, 1990, equation 3.1 for one source). It is
    integrated over the band. Powers of source and noise are unknown.
    """
    snr, recording = 10 ** (snr_db / 10), settings.recording
    sideways = np.array([-direction[0, 1], direction[0, 0], 0.0]) / math.hypot(direction[0, 0], direction[0, 1])
    axes = np.stack([sideways, np.cross(direction[0], sideways)])
    slopes = (_delays(settings, direction + _STEP_RAD * axes) - _delays(settings, direction - _STEP_RAD * axes)) / (
        2 * _STEP_RAD
    )
    slopes -= slopes.mean(axis=1, keepdims=True)
    n_mics, (low_hz, high_hz) = slopes.shape[1], BAND_HZ
    omega_squared = (2 * np.pi) ** 2 * (high_hz**3 - low_hz**3) / 3  # integral over the band
    gain = 2 * snr**2 * n_mics / (1 + n_mics * snr)
    information = recording.n_samples / recording.sample_rate_hz * gain * omega_squared * slopes @ slopes.T
    return np.asarray(np.linalg.inv(information))


def _delays(settings: Settings, directions: Floats) -> Floats:
    positions_m = microphones(settings.array).enabled_positions_m
    return far_field_delays(positions_m, directions, sound_speed_m_s=sound_speed_m_s(settings.air))


def errors_at(camera: AcousticCamera, finder: BearingFinder, snr_db: float, *, seeds: int, seed: int) -> dict[str, Any]:
    """Return the errors of one SNR, over directions up to 60° from the front."""
    squares, bounds, stated, missed, more = [], [], [], 0, 0
    for trial in range(seeds):
        random = np.random.default_rng((seed, trial))
        azimuth_rad, elevation_rad = np.radians(random.uniform((-60, -40), (60, 40)))
        direction = unit_vectors(np.array([azimuth_rad]), np.array([elevation_rad]))
        camera.reset()
        camera.add(plane_wave(camera.settings, direction, snr_db, seed=int(random.integers(2**31))))
        found = finder.find()
        more += max(0, len(found) - 1)
        if not found or away_deg(found[0], direction[0]) > 10 * _NEAR_DEG:
            missed += 1
            continue
        squares.append(away_deg(found[0], direction[0]) ** 2)
        bounds.append(np.degrees(np.degrees(np.trace(bound_rad(camera.settings, direction, snr_db)))))
        stated.append(squares[-1] / (found[0].sideways_deg ** 2 + found[0].upwards_deg ** 2))
    error, bound = (math.sqrt(float(np.mean(each))) if each else math.nan for each in (squares, bounds))
    return {
        "snr_db": snr_db,
        "error_deg": error,
        "bound_deg": bound,
        "ratio": error / bound,
        "relative_to_stated": math.sqrt(float(np.mean(stated))) if stated else math.nan,
        "missed": missed,
        "more": more,
        "trials": seeds,
    }


def away_deg(bearing: Bearing, direction: Floats) -> float:
    """Return the angle between a bearing and a unit vector in degrees."""
    found = unit_vectors(np.array([bearing.azimuth_rad]), np.array([bearing.elevation_rad]))[0]
    return math.degrees(2 * math.asin(min(1.0, float(np.linalg.norm(found - direction)) / 2)))


def leak_scene(direction: Floats, *, seed: int) -> Scene:
    """Return a scene with diffuse noise and, 10 dB below it at the array in the band, a leak; the sensor emits nothing.

    The noise extends beyond the band: in a bin where it ends, its coherence is that of other frequencies.
    """
    x, y, z = (_LEAK_M * direction).tolist()
    level_db = -60 - 10 + 20 * math.log10(_LEAK_M)
    noise_dbfs = -60 + 10 * math.log10((NOISE_BAND_HZ[1] - NOISE_BAND_HZ[0]) / (BAND_HZ[1] - BAND_HZ[0]))
    band = f"band_hz = [{BAND_HZ[0]}, {BAND_HZ[1]}]"
    leak = f"[[noises]]\nposition_m = [{x}, {y}, {z}]\n{band}\nlevel_db = {level_db}\n"
    return Scene.from_toml(
        f"seed = {seed}\ncount = {_AVERAGES}\n[effects]\nabsorption = false\n[[sensors]]\nemitter.silent = true\n"
        f"{leak}[ambient]\nband_hz = [{NOISE_BAND_HZ[0]}, {NOISE_BAND_HZ[1]}]\nlevel_dbfs = {noise_dbfs}\n"
    )


def _leaks(*, seeds: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Count the trials in which a leak is found in diffuse noise, with PDM signals."""
    counts = {"found": 0, "beside": 0}
    settings = leak_scene(np.array([1.0, 0.0, 0.0]), seed=0).sensors[0].settings()
    settings = settings.replace(
        **{
            "processing.directions": "3d:3000",
            "passive.bands_hz": [list(BAND_HZ)],
            "passive.averages": _AVERAGES,
        }
    )
    with AcousticCamera(settings, "cpu", check=False) as camera:
        finder = BearingFinder(camera, false_alarm=FALSE_ALARM)
        for trial in range(seeds):
            random = np.random.default_rng((seed, trial, 1))
            azimuth_rad, elevation_rad = np.radians(random.uniform((-60, -40), (60, 40)))
            direction = unit_vectors(np.array([azimuth_rad]), np.array([elevation_rad]))[0]
            camera.reset()
            simulator = Simulator(leak_scene(direction, seed=int(random.integers(2**31))))
            for index in range(_AVERAGES):
                heard = simulator.render(index)
                camera.add(Measurement(heard.data, settings, heard.stamp))
            near = [away_deg(bearing, direction) <= _NEAR_DEG for bearing in finder.find()]
            counts["found"] += any(near)
            counts["beside"] += sum(near) < len(near)
            say(f"leak {trial + 1} of {seeds}: {counts}")
    return {"trials": seeds, "asked_rate": FALSE_ALARM, **counts}

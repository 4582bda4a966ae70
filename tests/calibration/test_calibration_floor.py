"""Calibration with recordings of a reflector over a floor, rendered without the simulator."""

import numpy as np
import pytest
import scipy

from ertis_numba.calibration import calibrate
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Processing, Recording, Settings
from tests.echo_draws import sweep, unit

FLOOR_M, N_RECORDINGS, N_SAMPLES, RATE_HZ = 0.5, 8, 6_000, 450e3
SETTINGS = Settings(
    recording=Recording(sample_rate_hz=RATE_HZ, n_samples=N_SAMPLES, encoding="float32"),
    processing=Processing(range_m=(0.3, 2.0)),
)


def recorded(rng):
    """Recordings of a reflector over a floor that reflects all sound; and gains, delays and positions of the array."""
    positions_m = microphones(SETTINGS.array).enabled_positions_m
    n_mics = len(positions_m)
    gain, delay_s = 10 ** (rng.standard_normal(n_mics) / 20), 2e-6 * rng.standard_normal(n_mics)
    true_m = positions_m + 0.3e-3 * rng.standard_normal((n_mics, 3))
    time_s, speed_m_s = np.arange(N_SAMPLES) / RATE_HZ, sound_speed_m_s(SETTINGS.air)
    found = []
    for _ in range(N_RECORDINGS):
        place_m = rng.uniform(0.5, 1.2) * unit(rng.uniform(-50, 50), rng.uniform(-40, 0))
        place_m[2] = max(place_m[2], 0.05 - FLOOR_M)
        image_m = place_m * [1, 1, -1] - [0, 0, 2 * FLOOR_M]
        heard = np.zeros((n_mics, N_SAMPLES))
        for out_m in map(np.linalg.norm, (place_m, image_m)):
            for source_m in (place_m, image_m):
                back_m = np.linalg.norm(true_m - source_m, axis=1)
                arrival_s = (out_m + back_m) / speed_m_s + delay_s
                heard += (0.01 * gain / (out_m * back_m))[:, None] * sweep(time_s - arrival_s[:, None])
        heard += 1e-4 / np.dot(place_m, place_m) * rng.standard_normal(heard.shape)
        found.append(Measurement(np.ascontiguousarray(heard.T, np.float32), SETTINGS))
    return found, gain, delay_s, true_m


@pytest.fixture(scope="module")
def calibrated():
    recordings, gain, delay_s, true_m = recorded(np.random.default_rng([5, 0]))
    made = calibrate(recordings)
    positions_m = microphones(SETTINGS.array).enabled_positions_m + made.moved_m
    centred_m, true_m = positions_m - positions_m.mean(axis=0), true_m - true_m.mean(axis=0)
    turn, _ = scipy.spatial.transform.Rotation.align_vectors(true_m, centred_m)  # No recording observes a rotation.
    gain_db = 20 * np.log10(gain)
    errors = np.column_stack(
        [
            made.gain_db - (gain_db - gain_db.mean()),
            1e6 * (made.delay_s - (delay_s - delay_s.mean())),
            1e3 * (turn.apply(centred_m) - true_m),
        ]
    )
    return made, np.abs(errors / made.sd)


def test_recording_with_an_overlapping_echo_is_listed_as_rejected(calibrated):
    made, _ = calibrated
    assert set(made.rejected) == {1, 7}  # The floor is 0.22 and 0.28 m below these places, which are 1.3 m away.
    assert all("another sound overlaps its echo" in reason for reason in made.rejected.values())
    assert len(made.source_m) == N_RECORDINGS - 2


def test_intervals_contain_the_errors_over_a_floor(calibrated):
    _, standardised = calibrated
    assert (np.mean(standardised < 1.96, axis=0) > 0.9).all()
    assert not (standardised > 4).any()

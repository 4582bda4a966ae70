"""Errors of bearings as stated, for sound of any spectrum; and no bearings of sound that the window spreads."""

import numpy as np
import pytest
import scipy

import ertis_numba as ertis
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive import AcousticCamera, BearingFinder
from ertis_numba.passive.likelihood import moved, tangents

pytestmark = pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")  # Small grids save time.

RATE_HZ, N_SAMPLES = 225e3, 8192


def settings_of(*bands_hz, directions="3d:500"):
    """Return settings of the eRTIS with 36 ms of PCM."""
    changes = {
        "recording.encoding": "float32",
        "recording.sample_rate_hz": RATE_HZ,
        "recording.n_samples": N_SAMPLES,
        "processing.directions": directions,
        "passive.bands_hz": [list(band_hz) for band_hz in bands_hz],
    }
    return ertis.Settings().replace(**changes)


def direction_of(azimuth_deg, elevation_deg):
    return unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))[0]


def heard(settings, sources, noise, random, range_m=None):
    """Return a measurement of plane waves, or waves from points, and of white noise of each microphone.

    A source has a direction, a root mean square within its band, and the band: a tone if both edges are equal.
    """
    places_m = microphones(settings.array).enabled_positions_m
    places_m = places_m - places_m.mean(axis=0)
    n, speed_m_s = 4 * N_SAMPLES, sound_speed_m_s(settings.air)
    frequency_hz, time_s = np.fft.rfftfreq(n, 1 / RATE_HZ), np.arange(N_SAMPLES) / RATE_HZ
    out = noise * random.standard_normal((len(places_m), N_SAMPLES))
    for direction, rms, (low_hz, high_hz) in sources:
        delay_s = -(places_m @ direction)[:, None] / speed_m_s
        if range_m is not None:
            away_m = np.linalg.norm(range_m * direction - places_m, axis=1)
            delay_s = (away_m[:, None] - range_m) / speed_m_s
        if low_hz == high_hz:
            phase = random.uniform(0, 2 * np.pi)
            out += np.sqrt(2) * rms * np.cos(2 * np.pi * low_hz * (time_s - delay_s) + phase)
            continue
        is_within = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
        spectrum = np.fft.rfft(random.standard_normal(n)) * is_within / np.sqrt(2 * (high_hz - low_hz) / RATE_HZ)
        waves = spectrum * np.exp(-2j * np.pi * frequency_hz * delay_s)
        out += rms * np.fft.irfft(waves, n)[:, N_SAMPLES : 2 * N_SAMPLES]
    return ertis.Measurement(np.ascontiguousarray(out.T, np.float32), settings, ertis.Stamp(behaviour="passive"))


def squares(bearing, direction):
    """Return the squared distance of a bearing from the truth in its covariance, which has the law of chi-square."""
    (found,) = unit_vectors(np.array([bearing.azimuth_rad]), np.array([bearing.elevation_rad]))
    away = np.degrees(tangents(found) @ direction)
    sizes = np.array([bearing.sideways_deg, bearing.upwards_deg])
    correlation = np.array([[1, bearing.correlation], [bearing.correlation, 1]])
    return away @ np.linalg.solve(np.outer(sizes, sizes) * correlation, away)


WIDE = (1e3, 100e3)


@pytest.mark.parametrize(
    ("azimuth_deg", "snr_db", "band_hz"),
    [
        (0, 40, WIDE),
        (60, -5, WIDE),
        (60, 25, WIDE),
        (75, 25, WIDE),
        (-40, 25, (30e3, 40e3)),  # The sound ends within the band, …
        (-40, 25, (38e3, 42e3)),
        (-40, 25, (44.7e3, 60e3)),  # … or begins near its edge.
        (10, 35, (36e3, 36.8e3)),
        (60, 20, (35.2e3, 35.2e3)),
        (60, -8, (35.2e3, 35.2e3)),
        (60, 60, (35.2e3, 35.2e3)),
        (-25, 20, (40.5e3, 40.5e3)),
    ],
)
def test_errors_have_the_stated_law(azimuth_deg, snr_db, band_hz):
    """Signal-to-noise ratios are those of the sound's band, and of 10 kHz for tones."""
    settings = settings_of((35e3, 45e3))
    width_hz = band_hz[1] - band_hz[0] or 10e3
    rms = 10 ** (snr_db / 20) * np.sqrt(2 * width_hz / RATE_HZ)
    found = []
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera, top=3)
        for seed in range(12):
            random = np.random.default_rng(seed)
            direction = direction_of(azimuth_deg + random.uniform(-3, 3), random.uniform(-10, 10))
            camera.reset()
            camera.add(heard(settings, [(direction, rms, band_hz)], 1.0, random))
            (bearing,) = finder.find()
            found.append(squares(bearing, direction))
    limits = scipy.stats.chi2(2 * len(found)).ppf([0.001, 0.999]) / (2 * len(found))
    assert 0.7**2 * limits[0] < np.mean(found) / 2 < 1.3**2 * limits[1]
    assert np.max(found) < 5**2


@pytest.mark.parametrize(
    "sources",
    [
        [(-25, 1.0, (40e3, 40e3))],
        [(-25, 1.0, (40e3, 40e3)), (30, 0.5, (41.5e3, 41.5e3))],
        [(-40, 1.0, (38e3, 42e3))],
        [(60, 1.0, (43.9e3, 43.9e3))],
    ],
)
@pytest.mark.parametrize("noise", [1e-2, 1e-3, 1e-4])
def test_sound_of_one_band_yields_no_bearings_in_others(sources, noise):
    settings = settings_of((20e3, 28e3), (28e3, 36.5e3), (36.5e3, 45e3), (45e3, 60e3))
    random = np.random.default_rng(7)
    with AcousticCamera(settings, "cpu", 1) as camera:
        camera.add(heard(settings, [(direction_of(each[0], 0), *each[1:]) for each in sources], noise, random))
        bearings = BearingFinder(camera).find()
    assert {each.band_hz for each in bearings} == {(36.5e3, 45e3)}
    assert sorted(each.azimuth_deg for each in bearings) == pytest.approx(sorted(each[0] for each in sources), abs=0.1)


def test_quiet_sources_beside_a_loud_one_are_found():
    """The frequencies within a bin change the loud source's wave by more than the power of the quiet source."""
    settings, n_seeds, found = settings_of((38e3, 43e3)), 12, 0
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera, min_level_db=-40)
        for seed in range(n_seeds):
            random = np.random.default_rng([17, seed])
            loud = direction_of(random.choice([-1, 1]) * 45, random.uniform(-10, 10))
            quiet = moved(loud, np.radians([random.uniform(-1, 1, 2) * 15 + [20, 0]]), level=False)[0]
            camera.reset()
            camera.add(heard(settings, [(loud, 300.0, WIDE), (quiet, 10.0, WIDE)], 1.0, random))
            bearings = finder.find()
            assert len(bearings) < 3
            found += any(np.dot(direction_of(each.azimuth_deg, each.elevation_deg), quiet) > 0.998 for each in bearings)
    assert found >= 11


def test_quiet_source_beside_the_band_of_a_loud_one_is_found():
    settings = settings_of((20e3, 36e3), (36e3, 45e3))
    sources = [(direction_of(-25, 0), 1.0, (40e3, 40e3)), (direction_of(20, 5), 2e-3, (22e3, 30e3))]
    with AcousticCamera(settings, "cpu", 1) as camera:
        camera.add(heard(settings, sources, 1e-3, np.random.default_rng(8)))
        quiet, loud = BearingFinder(camera).find()
    assert (quiet.azimuth_deg, quiet.elevation_deg) == pytest.approx((20, 5), abs=4 * quiet.sideways_deg)
    assert loud.azimuth_deg == pytest.approx(-25, abs=0.01)


@pytest.mark.parametrize(("apart_deg", "snr_db"), [(2, 25), (4, 10), (6, 0), (6, 25), (9, 25)])
def test_sources_are_separated_or_as_uncertain_as_they_are_far_apart(apart_deg, snr_db):
    settings, found = settings_of((35e3, 45e3)), []
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera)
        for seed in range(6):
            random = np.random.default_rng([apart_deg, seed])
            azimuth_deg, elevation_deg = random.uniform((-30, -10), (30, 10))
            first = direction_of(azimuth_deg, elevation_deg)
            second = moved(first, np.radians([[apart_deg, 0]]), level=False)[0]
            camera.reset()
            camera.add(heard(settings, [(each, 10 ** (snr_db / 20), WIDE) for each in (first, second)], 1.0, random))
            bearings = finder.find()
            found += [min(squares(each, direction) for each in bearings) for direction in (first, second)]
    assert np.mean(np.array(found) < 3**2) > 0.8
    assert np.max(found) < 6**2


def crosstalk(settings, snr_db, random):
    """Return a measurement of white noise of each microphone, and of one white signal in all channels."""
    n_mics = microphones(settings.array).enabled.sum()
    samples = random.standard_normal((n_mics, N_SAMPLES)) + 10 ** (snr_db / 20) * random.standard_normal(N_SAMPLES)
    return ertis.Measurement(np.ascontiguousarray(samples.T, np.float32), settings, ertis.Stamp(behaviour="passive"))


@pytest.mark.parametrize("snr_db", [-10, 10, 40])
def test_equal_channels_may_be_crosstalk(snr_db):
    settings = settings_of((35e3, 45e3))
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera)
        for seed in range(3):
            camera.reset()
            camera.add(crosstalk(settings, snr_db, np.random.default_rng([11, seed])))
            (bearing,) = finder.find()
            assert bearing.may_be_crosstalk


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg", "snr_db"), [(1.5, 0, 10), (0, -3, 10), (20, 10, -10)])
def test_sound_from_aside_is_no_crosstalk(azimuth_deg, elevation_deg, snr_db):
    settings = settings_of((35e3, 45e3))
    with AcousticCamera(settings, "cpu", 1) as camera:
        source = direction_of(azimuth_deg, elevation_deg), 10 ** (snr_db / 20), WIDE
        camera.add(heard(settings, [source], 1.0, np.random.default_rng(12)))
        (bearing,) = BearingFinder(camera).find()
    assert not bearing.may_be_crosstalk


def test_crosstalk_of_an_array_that_is_not_flat_is_marked():
    places_m = np.random.default_rng(13).uniform(-0.01, 0.01, (10, 3))
    settings = settings_of((20e3, 30e3)).replace(**{"array.positions_m": places_m.tolist()})
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera)
        camera.add(crosstalk(settings, 0, np.random.default_rng(14)))
        assert all(bearing.may_be_crosstalk for bearing in finder.find())
        camera.reset()
        camera.add(heard(settings, [(direction_of(0, 0), 1.0, WIDE)], 1.0, np.random.default_rng(15)))
        assert [bearing.may_be_crosstalk for bearing in finder.find()] == [False]


@pytest.mark.parametrize("range_m", [1.0, 3.0])
def test_sources_at_a_finite_range_have_the_stated_errors(range_m):
    """Without passive.focus_m, waves from points differ from plane ones by more than the noise."""
    settings, found = settings_of((38e3, 42e3), (56e3, 77e3)), []
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera)
        for seed in range(6):
            random = np.random.default_rng([29, seed])
            direction = direction_of(random.uniform(-60, 60), random.uniform(-50, 50))
            camera.reset()
            camera.add(heard(settings, [(direction, 1.0, WIDE)], 1e-3, random, range_m))
            bearings = finder.find()
            assert [each.band_hz for each in bearings] == [(38e3, 42e3), (56e3, 77e3)]
            found += [squares(each, direction) for each in bearings]
            # Errors are not much smaller than stated, either.
            assert all(np.hypot(each.sideways_deg, each.upwards_deg) < 0.15 / range_m for each in bearings)
    assert 0.2 < np.mean(found) / 2 < 1.5
    assert np.max(found) < 4**2


def test_dead_channels_leave_no_certain_bearings():
    settings, direction = settings_of((38e3, 42e3)), direction_of(30, 10)
    measurement = heard(settings, [(direction, 1.0, WIDE)], 0.1, np.random.default_rng(31))
    samples = measurement.data.copy()
    samples[:, [3, 11, 20]] = 0
    with AcousticCamera(settings, "cpu", 1) as camera:
        camera.add(ertis.Measurement(samples, settings, measurement.stamp))
        bearings = BearingFinder(camera).find()
    assert bearings
    assert all(np.isinf([each.sideways_deg, each.upwards_deg]).all() for each in bearings)

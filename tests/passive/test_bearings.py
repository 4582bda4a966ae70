"""Bearings: right laws of noise, and directions as accurate as the signals permit."""

from pathlib import Path

import numpy as np
import pytest
import scipy
from ertis_bench.passive import bearings as passive_bearings

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive import AcousticCamera, BearingFinder, find_bearings
from ertis_numba.passive.bands import bin_shares
from ertis_numba.passive.detection_law import LAGS, exceedance, independent_samples
from ertis_numba.passive.direction_errors import _inverse
from ertis_numba.passive.likelihood import BandLikelihood, moved
from ertis_numba.passive.noise_model import NoiseModel
from ertis_numba.passive.scan_extent import ScanExtent, ScanMesh
from tests.passive.test_acoustic_camera import settings_of, sound

pytestmark = pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")  # Small grids save time.

SPACE = {"processing__directions": "3d:400", "passive__bands_hz": [[30e3, 45e3]]}


def test_independent_samples_are_those_of_the_variance_of_powers():
    random = np.random.default_rng(0)
    window = scipy.signal.get_window("hann", 64)
    shares, n_blocks = np.array([0.5, 1.0, 1.0, 1.0, 0.25]), 9
    noise = random.standard_normal((4000, 32 * (n_blocks + 1)))
    blocks = np.lib.stride_tricks.sliding_window_view(noise, 64, axis=1)[:, ::32]
    powers = (np.abs(np.fft.rfft(blocks * window)[:, :, 10:15]) ** 2 @ shares).mean(axis=1)
    assert powers.mean() ** 2 / powers.var() == pytest.approx(independent_samples(shares, n_blocks), rel=0.08)


def test_independent_samples_are_those_of_beams_that_turn_from_bin_to_bin():
    """Sound from the side crosses this array in a quarter of a block, so the beams of neighbouring bins differ."""
    random, n_block, n_blocks, n_mics = np.random.default_rng(6), 64, 9, 5
    window = scipy.signal.get_window("hann", n_block)
    delay_s = np.linspace(-12, 12, n_mics) / n_block  # relative to the duration of a block
    beams = np.exp(2j * np.pi * np.arange(10, 15)[:, None] * delay_s) / n_mics
    noise = random.standard_normal((3000, n_mics, n_block // 2 * (n_blocks + 1)))
    blocks = np.lib.stride_tricks.sliding_window_view(noise, n_block, axis=2)[:, :, :: n_block // 2]
    spectra = np.fft.rfft(blocks * window)[..., 10:15]
    powers = (np.abs(np.einsum("nmbk,km->nbk", spectra, beams)) ** 2).sum(axis=2).mean(axis=1)
    directions = unit_vectors(np.radians([0.0]), np.radians([0.0]))
    similarity = ScanMesh(directions, delay_s[None]).similarity(2 * np.pi * 10, 2 * np.pi, LAGS + 1)
    assert similarity[0] == pytest.approx(1)
    assert similarity[1] < 0.9
    expected = independent_samples(np.ones(5), n_blocks, similarity)
    assert expected > 1.1 * independent_samples(np.ones(5), n_blocks)
    assert powers.mean() ** 2 / powers.var() == pytest.approx(expected, rel=0.08)


def test_exceedance_is_that_of_random_vectors():
    """Draw vectors of noise, and compare the largest share along an arc of directions with the law."""
    random, n_mics, n_samples = np.random.default_rng(1), 6, 5
    delay_s = np.linspace(-1, 1, 60)[:, None] * np.linspace(-2.5, 2.5, n_mics)
    waves = np.exp(1j * delay_s) / np.sqrt(n_mics)
    noise = random.standard_normal((20_000, n_samples, n_mics, 2)) @ np.array([1, 1j])
    shares = (np.abs(noise @ waves.T) ** 2).sum(axis=1) / (np.abs(noise) ** 2).sum(axis=(1, 2))[:, None]
    extent = ScanExtent(1.0, float(np.linalg.norm(np.diff(delay_s, axis=0), axis=1).sum() / np.sqrt(n_mics)), 0.0)
    for share in (0.3, 0.38):
        expected = exceedance(share, n_samples=n_samples, n_dimensions=n_mics, extent=extent)
        found = (shares.max(axis=1) > share).mean()
        assert found == pytest.approx(expected, rel=0.1)


def test_exceedance_has_simple_limits():
    point = ScanExtent(1.0, 0.0, 0.0)
    assert exceedance(0.1, n_samples=3, n_dimensions=5, extent=point) == 1
    assert exceedance(1.0, n_samples=3, n_dimensions=5, extent=point) == 0
    assert exceedance(0.9, n_samples=3, n_dimensions=1, extent=point) == 1


def test_extent_of_a_plane_is_that_of_direction_cosines():
    """A planar array sees a disc of direction cosines, whose area and perimeter are known."""
    random = np.random.default_rng(2)
    positions_m = np.zeros((12, 3))
    positions_m[:, 1:] = random.normal(scale=0.02, size=(12, 2))
    processing = ertis.Settings().replace("processing.directions", "3d:3000").processing
    grid = ertis.geometry.direction_grid(processing)
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    found = ScanMesh(directions, -directions @ positions_m.T / 340).extent(1.0)
    covariance = np.cov(positions_m[:, 1:].T, bias=True) / 340**2
    assert found.area == pytest.approx(np.pi * np.sqrt(np.linalg.det(covariance)), rel=0.03)
    turn = np.linspace(0, 2 * np.pi, 1000)
    slopes = np.stack([-np.sin(turn), np.cos(turn)])
    around = np.sqrt(np.einsum("it,ij,jt->t", slopes, covariance, slopes)).mean() * 2 * np.pi
    assert found.length == pytest.approx(around / 2, rel=0.05)


def test_extent_of_a_line_is_its_length():
    directions = unit_vectors(np.radians(np.arange(-90, 91.0)), np.zeros(181))
    found = ScanMesh(directions, directions[:, 1:2] * np.array([[-1.0, 1.0]])).extent(1.0)
    assert found == pytest.approx((1.0, 2.0, 0.0), rel=1e-3)
    assert ScanMesh(directions[:2], directions[:2, 1:2] * np.ones(3)).extent(1.0) == (2.0, 0.0, 0.0)


def test_extent_of_whitened_waves_is_that_of_their_angles():
    """The angle between two waves is the arc cosine of the magnitude of their normalised product."""
    random = np.random.default_rng(7)
    directions = unit_vectors(np.radians(np.linspace(-60, 60, 4000)), np.zeros(4000))
    delay_s, omega = -directions @ random.normal(scale=0.02, size=(3, 6)) / 340, 2 * np.pi * 30e3
    whitening = random.standard_normal((6, 6))
    waves = np.exp(-1j * omega * delay_s) @ whitening.T
    waves /= np.linalg.norm(waves, axis=1, keepdims=True)
    angles = np.arccos(np.minimum(np.abs((waves[1:].conj() * waves[:-1]).sum(axis=1)), 1))
    found = ScanMesh(directions, delay_s).extent(omega, whitening)
    assert found == pytest.approx((1.0, angles.sum(), 0.0), rel=1e-3)
    assert found.length != pytest.approx(ScanMesh(directions, delay_s).extent(omega).length, rel=0.01)


def test_coherence_of_diffuse_noise_is_that_of_blocks():
    """Sum plane waves from many directions, and compare the blocks of two microphones with the model."""
    n_block, rate_hz, number, n_waves = 64, 200e3, 3, 200
    spacing_hz = rate_hz / n_block
    apart_s = np.array([0.0, 7.7, -3.3]) / (2 * np.pi * number * spacing_hz)
    random, cosines = np.random.default_rng(8), (np.arange(n_waves) + 0.5) / n_waves * 2 - 1
    frequency_hz, window = np.fft.rfftfreq(1 << 15, 1 / rate_hz), scipy.signal.get_window("hann", n_block)
    products = np.zeros((3, 3))
    for cosine in cosines:
        spectrum = np.fft.rfft(random.standard_normal(1 << 15))
        heard = np.fft.irfft(spectrum * np.exp(-2j * np.pi * frequency_hz * cosine * apart_s[:, None]))
        bins = np.fft.rfft(heard.reshape(3, -1, n_block) * window)[:, :, number]
        products += (bins @ bins.conj().T).real
    places_m = np.stack([340 * apart_s, np.zeros(3), np.zeros(3)], axis=1)
    model = NoiseModel(places_m, np.array([number * spacing_hz]), spacing_hz=spacing_hz, sound_speed_m_s=340)
    mixing = np.linalg.inv(model.whitening(0.999)[0])
    assert mixing @ mixing.T == pytest.approx(products / products.trace() * 3, abs=0.01)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_share_of_diffuse_noise_is_found(share):
    random = np.random.default_rng(3)
    positions_m, frequency_hz = random.normal(scale=0.01, size=(8, 3)), np.linspace(20e3, 30e3, 6)
    apart_m = np.linalg.norm(positions_m[:, None] - positions_m, axis=-1)
    coherence = share * np.sinc(2 * apart_m / 340 * frequency_hz[:, None, None]) + (1 - share) * np.eye(8)
    drawn = random.standard_normal((6, 8, 400, 2)) @ np.array([1, 1j])
    heard = np.linalg.cholesky(coherence) @ drawn
    matrix = heard @ heard.conj().transpose(0, 2, 1) / 800
    model = NoiseModel(positions_m, frequency_hz, spacing_hz=1.0, sound_speed_m_s=340)
    found = model.diffuse_share(matrix, np.full(6, 1 / 6))
    assert found == pytest.approx(share, abs=0.05)
    white = model.whitening(found) @ matrix @ model.whitening(found).transpose(0, 2, 1)
    assert np.abs(white.mean(axis=0) - np.eye(8)).max() < 0.12


def test_maximum_is_that_of_a_fine_search():
    random = np.random.default_rng(4)
    positions_m = random.normal(scale=0.02, size=(7, 3))

    def delays(directions):
        return -directions @ positions_m.T / 340

    omega = 2 * np.pi * np.linspace(20e3, 24e3, 5)
    truth = unit_vectors(np.radians([20.0, -15.0]), np.radians([10.0, 0.0]))
    waves = np.exp(-1j * omega[:, None, None] * delays(truth).T)
    matrix = waves @ waves.conj().transpose(0, 2, 1) + 0.3 * np.eye(7)
    likelihood = BandLikelihood(matrix, np.broadcast_to(np.eye(7), matrix.shape), omega, np.full(5, 0.2), delays)
    beside = likelihood.beside(truth[1:])
    found = beside.maximum(moved(truth[0], np.radians([[2.0, -1.5]]), level=False)[0], reach_rad=0.1, level=False)
    assert np.linalg.norm(found - truth[0]) < 1e-6
    around = moved(found, np.radians(random.uniform(-1, 1, (200, 2))), level=False)
    assert beside(found[None]) >= beside(around).max()


def test_separated_powers_are_those_outside_of_the_other_sources():
    random = np.random.default_rng(5)
    positions_m = random.normal(scale=0.02, size=(7, 3))
    directions = unit_vectors(np.radians([20.0, -15.0, 24.0]), np.radians([10.0, 0.0, 30.0]))
    heard = random.standard_normal((4, 7, 9, 2)) @ np.array([1, 1j])
    matrix, whitening = heard @ heard.conj().transpose(0, 2, 1), random.standard_normal((4, 7, 7))
    omega = 2 * np.pi * np.linspace(20e3, 24e3, 4)
    likelihood = BandLikelihood(matrix, whitening, omega, np.full(4, 0.25), lambda there: -there @ positions_m.T / 340)
    found, noise = likelihood.separated(directions)
    for k, each in enumerate(directions):
        beside = likelihood.beside(np.delete(directions, k, axis=0))
        beam, size = beside.beams(each[None])
        assert noise == pytest.approx((beside.power - beam[:, 0]) / 4)  # 7 microphones without three sources
        assert found[:, k] == pytest.approx((beam[:, 0] - noise) / size[:, 0])


def diffuse_sound(settings, share, seed):
    """Return noise of which a share is a diffuse field, and the rest that of each microphone."""
    recording, places_m = settings.recording, microphones(settings.array).enabled_positions_m
    frequency_hz = np.fft.rfftfreq(recording.n_samples, 1 / recording.sample_rate_hz)[:, None, None]
    apart_s = np.linalg.norm(places_m[:, None] - places_m, axis=-1) / sound_speed_m_s(settings.air)
    coherence = share * np.sinc(2 * frequency_hz * apart_s) + (1 - share) * np.eye(len(places_m))
    drawn = np.random.default_rng(seed).standard_normal((*coherence.shape[:2], 2)) @ np.array([1, 1j])
    spectra = (np.linalg.cholesky(coherence) @ drawn[:, :, None])[:, :, 0]
    return ertis.Measurement(np.ascontiguousarray(np.fft.irfft(spectra, axis=0), np.float32), settings)


@pytest.mark.parametrize(
    ("directions", "band_hz", "diffuse"),
    [
        ("2d:181", SPACE["passive__bands_hz"][0], 0.0),
        ("3d:1500", SPACE["passive__bands_hz"][0], 0.0),
        ("3d:400", [10e3, 14e3], 0.95),
    ],
)
def test_false_alarms_have_the_requested_rate(directions, band_hz, diffuse):
    settings, asked, n_seeds = settings_of(processing__directions=directions, passive__bands_hz=[band_hz]), 0.1, 200
    alarms = 0
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera, false_alarm=asked, top=1)
        for seed in range(n_seeds):
            camera.reset()
            camera.add(diffuse_sound(settings, diffuse, seed))
            alarms += bool(finder.find())
    low, high = scipy.stats.binom.interval(0.998, n_seeds, asked)
    assert low <= alarms <= high


def other_noise(kind, n_mics, n_samples, random):
    """Return noise of separate microphones that is not white, at 225 kHz."""
    frequency_hz, time_s = np.fft.rfftfreq(n_samples, 1 / 225e3), np.arange(n_samples) / 225e3
    white = random.standard_normal((n_mics, n_samples))
    if kind == "tone":
        phase = random.uniform(0, 2 * np.pi, (n_mics, 1))
        return white + np.cos(2 * np.pi * random.uniform(36e3, 44e3) * time_s + phase)
    if kind == "burst":
        return white * (1 + 10 * ((time_s > 0.010) & (time_s < 0.015)))
    if kind == "gains":
        return white * 10 ** random.normal(0, 3 / 20, (n_mics, 1))
    low_hz, high_hz = kind
    is_within = (frequency_hz > low_hz) & (frequency_hz < high_hz)
    return np.fft.irfft(np.fft.rfft(white) * is_within, n_samples)


@pytest.mark.parametrize("kind", [(38e3, 42e3), (39.7e3, 40e3), "tone", "burst", "gains"], ids=str)
def test_false_alarms_in_other_noise_have_the_requested_rate(kind):
    settings = passive_bearings.plane_wave_settings()
    settings = settings.replace(**{"passive.resolution_hz": None, "processing.directions": "3d:600"})
    asked, n_seeds, alarms = 0.3, 40, 0
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera, false_alarm=asked, top=1)
        for seed in range(n_seeds):
            heard = other_noise(kind, 32, settings.recording.n_samples, np.random.default_rng([3, seed]))
            camera.reset()
            camera.add(ertis.Measurement(np.ascontiguousarray(heard.T, np.float32), settings))
            alarms += bool(finder.find())
    low, high = scipy.stats.binom.interval(0.998, n_seeds, asked)
    assert low <= alarms <= high


def test_errors_are_those_of_the_bound_and_as_stated():
    settings = passive_bearings.plane_wave_settings().replace("processing.directions", "3d:1500")
    with AcousticCamera(settings, "cpu", 1) as camera:
        finder = BearingFinder(camera)
        for snr_db in (-5.0, 15.0):
            row = passive_bearings.errors_at(camera, finder, snr_db, seeds=16, seed=0)
            assert row["missed"] == 0
            assert 0.5 < row["ratio"] < 1.5
            assert 0.5 < row["relative_to_stated"] < 1.5


def test_two_sources_have_their_directions_and_levels():
    settings = settings_of(passive__resolution_hz=300.0, **SPACE)
    with AcousticCamera(settings, "cpu") as camera:
        camera.add(sound(settings, [(30, 0.1), (-42, 0.05)], noise=0.03))
        first, second = find_bearings(camera, false_alarm=1e-6)
    share = 15e3 / (settings.recording.sample_rate_hz / 2)
    for found, azimuth_deg, rms in ((first, 30, 0.1), (second, -42, 0.05)):
        assert found.azimuth_deg == pytest.approx(azimuth_deg, abs=5 * found.sideways_deg)
        assert found.elevation_deg == pytest.approx(0, abs=5 * found.upwards_deg)
        assert found.level_dbfs == pytest.approx(10 * np.log10(rms**2 * share), abs=0.7)
        assert found.snr_db == pytest.approx(20 * np.log10(rms / 0.03), abs=0.7)
        assert found.band_hz == (30e3, 45e3)


@pytest.mark.parametrize("directions", [{"directions": "2d:61"}, {"directions": "2d:61", "elevation_deg": 20.0}])
def test_sources_outside_the_directions_of_maps_are_found(directions):
    settings = settings_of(**{f"processing__{name}": value for name, value in directions.items()})
    with AcousticCamera(settings, "cpu", false_alarm=1e-3) as camera:
        found = camera.process(sound(settings, [(30, 0.1)], noise=0.02)).bearings
    assert len(found) == 2  # one in each band
    for bearing in found:
        assert abs(bearing.elevation_deg) < 5 * bearing.upwards_deg < 10
        assert abs(bearing.azimuth_deg - 30) < 5 * bearing.sideways_deg < 10


@pytest.mark.parametrize("directions", ["2d:61", "3d:400"])
def test_array_on_a_line_resolves_one_angle(directions):
    positions_m = [[0, y, 0] for y in (0, 0.004, 0.011, 0.02, 0.031, 0.04)]
    settings = settings_of(array__positions_m=positions_m, **SPACE | {"processing__directions": directions})
    with AcousticCamera(settings, "cpu") as camera:
        camera.add(sound(settings, [(20, 0.1)], noise=0.02))
        found = find_bearings(camera, top=1)[0]
    sine = np.cos(np.radians(found.elevation_deg)) * np.sin(np.radians(found.azimuth_deg))
    assert sine == pytest.approx(np.sin(np.radians(20)), abs=0.005)
    assert found.upwards_deg == np.inf
    assert (found.sideways_deg < 1) == (directions == "2d:61")


@pytest.mark.parametrize("level", [True, False])
def test_directions_without_information_are_unknown(level):
    n = 1 if level else 2
    np.testing.assert_array_equal(_inverse(np.zeros((n, n))), np.diag([np.inf, np.inf]))


@pytest.mark.parametrize("directions", ["2d:90", "3d:10", "3d:30", "3d:1300"])
def test_levels_never_exceed_the_sound_or_fall_below_the_least_level(directions):
    scene = ertis.load_scene(Path(__file__).parents[2] / "data" / "synthetic" / "scenes" / "leak.toml")
    changes = {"processing.directions": directions, "passive.limits_hz": (28e3, 71e3)}
    with AcousticCamera(scene.sensors[0].settings().replace(**changes), "cpu") as camera:
        for number in range(3):
            heard = ertis.render(scene, number)
            camera.add(ertis.Measurement(heard.data, camera.settings, heard.stamp))
        finder, matrix = BearingFinder(camera), camera.cross_spectrum().matrix
        found = finder.find()
    power = np.trace(matrix, axis1=1, axis2=2).real / matrix.shape[1]
    assert found
    for band_hz, share in zip(camera.band_hz, bin_shares(camera.band_hz, camera.frequency_hz), strict=True):
        levels = [bearing.level_dbfs for bearing in found if bearing.band_hz == tuple(band_hz)]
        assert sum(10 ** (level / 10) for level in levels) <= 10**0.1 * (share @ power)
        assert not levels or min(levels) >= max(levels) - 20
    assert finder.warning is None


@pytest.mark.parametrize(
    ("n_mics", "is_source", "marked"),
    [(4, True, (22, 24)), (8, False, (18, 24)), (8, True, (0, 2)), (12, True, (0, 2))],
)
def test_tones_that_random_phases_resemble_are_marked(n_mics, is_source, marked):
    turn, random = np.arange(n_mics) * 2.399963, np.random.default_rng(n_mics)
    places_m = 0.03 * np.stack([0 * turn, np.cos(turn), np.sin(turn)] * np.sqrt((np.arange(n_mics) + 0.5) / n_mics)).T
    settings = passive_bearings.plane_wave_settings().replace(
        **{"array.positions_m": np.round(places_m, 6).tolist(), "passive.resolution_hz": None}
    )
    places_m = microphones(settings.array).enabled_positions_m
    time_s, counts = np.arange(settings.recording.n_samples)[:, None] / settings.recording.sample_rate_hz, []
    with AcousticCamera(settings, "cpu", 1, false_alarm=0.1, check=False) as camera:
        for _ in range(24):
            direction = unit_vectors(*np.radians([[random.uniform(-60, 60)], [random.uniform(-40, 40)]]))[0]
            delay_s = -places_m @ direction / sound_speed_m_s(settings.air)
            omega = 2 * np.pi * random.uniform(36e3, 44e3)
            phases = -omega * delay_s if is_source else random.uniform(0, 2 * np.pi, n_mics)
            heard = np.cos(omega * time_s + phases) + 0.05 * random.standard_normal((len(time_s), n_mics))
            found = camera.process(ertis.Measurement(heard.astype(np.float32), settings)).bearings
            counts.append(all(each.may_be_interference for each in found))
    assert marked[0] <= sum(counts) <= marked[1]


def test_silence_has_no_bearings():
    settings = settings_of(**SPACE)
    with AcousticCamera(settings, "cpu") as camera:
        camera.add(sound(settings, []))
        assert find_bearings(camera) == []
        camera.reset()
        with pytest.raises(DataError, match="no measurement"):
            find_bearings(camera)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"false_alarm": 0.0}, "false_alarm"), ({"top": 0}, "top"), ({"min_level_db": 1.0}, "min_level_db")],
)
def test_arguments_outside_their_limits_are_refused(changes, words):
    with AcousticCamera(settings_of(), "cpu") as camera, pytest.raises(ArgumentError, match=words):
        BearingFinder(camera, **changes)
    with pytest.raises(ArgumentError, match="camera"):
        find_bearings(None)


def test_bench_measures_bearings_and_leaks():
    said = []
    report = passive_bearings.measure(1, 3, said.append)
    assert [row["snr_db"] for row in report["errors"]] == list(passive_bearings.SNRS_DB)
    assert all(row["trials"] == 1 and row["bound_deg"] > 0 for row in report["errors"])
    assert report["leak"]["trials"] == report["leak"]["found"] == 1
    assert len(said) == len(passive_bearings.SNRS_DB) + 1

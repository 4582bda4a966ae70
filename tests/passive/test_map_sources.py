"""Sources of acoustic maps: number, directions and levels, whatever the directions and the method of the map."""

import numpy as np
import pytest
from ertis_bench.passive.sound_signals import NoiseSource, listening, noise
from matplotlib.text import Text

import ertis_numba as ertis
from ertis_numba import figures
from ertis_numba.geometry import unit_vectors

pytestmark = pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")  # Small grids save time.

OWN_RMS, RMS = 0.005, 0.05
BANDS_HZ = [[20e3, 24e3], [38e3, 42e3]]
PLACES_DEG = np.random.default_rng(1).uniform((-60, -40), (60, 40), (6, 2))


def camera_of(method="delay_and_sum", directions="3d:300", false_alarm=1e-3, **changes):
    changes = {"passive__bands_hz": BANDS_HZ, "passive__method": method, "processing__directions": directions} | changes
    return ertis.AcousticCamera(listening(**changes), "cpu", 1, false_alarm=false_alarm)


def levels_dbfs(camera):
    """Return the level of a single source in each band, which is that of the microphones without their own noise."""
    spectrum = camera.cross_spectrum()
    power = np.trace(spectrum.matrix, axis1=1, axis2=2).real / spectrum.matrix.shape[1]
    own = OWN_RMS**2 / 112.5e3 * (spectrum.frequency_hz[1] - spectrum.frequency_hz[0])
    inside = [(spectrum.frequency_hz > low) & (spectrum.frequency_hz < high) for low, high in BANDS_HZ]
    bins = [(high - low) / (spectrum.frequency_hz[1] - spectrum.frequency_hz[0]) for low, high in BANDS_HZ]
    return [10 * np.log10((power[each] - own).mean() * n) for each, n in zip(inside, bins, strict=True)]


@pytest.mark.parametrize("directions", ["90", "3d:300", "3d:3000"])
def test_single_source_is_one_source_of_each_band(directions):
    with camera_of(directions=directions) as camera:
        for seed, (azimuth_deg, elevation_deg) in enumerate(PLACES_DEG):
            heard = noise(camera.settings, [NoiseSource(azimuth_deg, elevation_deg, RMS)], own_rms=OWN_RMS, seed=seed)
            found = camera.process(heard).bearings
            true = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))[0]
            assert [each.band_hz for each in found] == [tuple(band) for band in BANDS_HZ]
            for each, level_dbfs in zip(found, levels_dbfs(camera), strict=True):
                listed = unit_vectors(np.array([each.azimuth_rad]), np.array([each.elevation_rad]))[0]
                error_deg = np.degrees(np.linalg.norm(listed - true))
                assert error_deg < 4 * np.hypot(each.sideways_deg, each.upwards_deg) < 1
                assert each.level_dbfs == pytest.approx(level_dbfs, abs=0.3)


def test_method_has_no_influence_on_sources():
    found = []
    for method in ("delay_and_sum", "functional", "capon", "music", "clean_sc", "hr_clean_sc"):
        with camera_of(method) as camera:
            heard = noise(camera.settings, [NoiseSource(20, 5, RMS)], own_rms=OWN_RMS, seed=0)
            found.append(camera.process(heard).bearings)
    assert found == found[:1] * 6


@pytest.mark.parametrize("seed", range(3))
def test_two_sources_20_degrees_apart_are_two_sources(seed):
    places = [NoiseSource(-5, 4, RMS), NoiseSource(15, 4, RMS / 2)]
    with camera_of() as camera:
        found = camera.process(noise(camera.settings, places, own_rms=OWN_RMS, seed=seed)).bearings
    for band_hz in BANDS_HZ:
        listed = [each.azimuth_deg for each in found if each.band_hz == tuple(band_hz)]
        assert listed == pytest.approx([-5, 15], abs=0.5)


def test_all_sources_are_listed_loudest_first():
    places = [NoiseSource(-35, 10, RMS), NoiseSource(20, -5, RMS / 2), NoiseSource(-5, 30, RMS / 1.5)]
    with camera_of() as camera:
        found = camera.process(noise(camera.settings, places, own_rms=OWN_RMS, seed=0)).bearings
    sources = [each for each in found if each.band_hz == tuple(BANDS_HZ[1])]
    assert [each.azimuth_deg for each in sources] == pytest.approx([-35, -5, 20], abs=0.5)
    steps_db = np.diff([each.level_dbfs for each in sources])
    # The level of a noise of 36 ms has a standard deviation of 0.4 dB.
    assert steps_db == pytest.approx([-3.5, -2.5], abs=2)


@pytest.mark.parametrize("place", [(60.0, -10.0), (-58.0, 15.0), (5.0, 48.0), (34.0, 0.0)])
def test_sources_beyond_the_limits_of_a_map_have_their_own_direction(place):
    limits = {"processing__azimuth_limits_deg": (-40.0, 30.0), "processing__elevation_limits_deg": (-25.0, 25.0)}
    with camera_of(**limits) as camera:
        found = camera.process(noise(camera.settings, [NoiseSource(*place, RMS)], own_rms=OWN_RMS, seed=2)).bearings
    assert [(each.azimuth_deg, each.elevation_deg) for each in found] == [pytest.approx(place, abs=0.5)] * 2


@pytest.mark.parametrize("kind", ["white", "coloured", "dead"])
def test_noise_yields_sources_at_the_requested_rate(kind):
    """Over 200 draws of each, a requested 0.1 yields 0.075 to 0.085; 40 draws here limit the time."""
    count = 0
    with camera_of(directions="90", false_alarm=0.1) as camera:
        for seed in range(40):
            drawn = np.random.default_rng([9, seed]).standard_normal((8192, 32))
            if kind == "coloured":
                slope = 1 / (1 + (np.fft.rfftfreq(8192, 1 / 225e3)[:, None] / 2e4) ** 2)
                drawn = np.fft.irfft(np.fft.rfft(drawn, axis=0) * slope, axis=0)
            if kind == "dead":
                drawn[:, 7] = 0
            found = camera.process(ertis.Measurement((0.01 * drawn).astype(np.float32), camera.settings))
            count += bool(found.bearings)
    assert count <= 11  # with a probability of 0.999


def test_silence_has_no_source():
    with camera_of() as camera:
        found = camera.process(noise(camera.settings, [], own_rms=0.0, seed=0))
    assert found.bearings == ()
    assert found.loudest() == []
    title = " ".join(text.get_text() for text in figures.acoustic_map(found).findobj(Text))
    assert "silence: all values are 0" in title


def test_files_keep_the_bearings_of_each_map(tmp_path):
    with camera_of(array__sensitivity_dbfs=-30.0) as camera:
        sources = [NoiseSource(-35, 10, RMS), NoiseSource(20, -5, RMS / 2)]
        made = [camera.process(noise(camera.settings, each, own_rms=OWN_RMS, seed=0)) for each in ([], sources)]
    path = ertis.write_acoustic_maps(tmp_path / "maps.h5", [*made, *made])
    with ertis.open_acoustic_maps(path) as maps:
        assert maps.has_bearings
        assert [each.bearings for each in maps] == [each.bearings for each in made] * 2
        assert {each.false_alarm for each in maps} == {1e-3}
    assert len(made[1].bearings) == 4
    unsearched = ertis.write_acoustic_maps(tmp_path / "more.h5", [made[0].replace(false_alarm=np.nan)])
    with ertis.open_acoustic_maps(unsearched) as maps:
        assert not maps.has_bearings
        assert not maps[0].has_bearings

"""Sources in acoustic maps: number, directions and levels."""

import numpy as np
import pytest
from ertis_bench.passive.sound_signals import NoiseSource, listening, noise
from matplotlib.text import Text

import ertis_numba as ertis
from ertis_numba import figures
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import unit_vectors

pytestmark = pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")  # Small grids save time.

OWN_RMS, RMS = 0.005, 0.05
BANDS_HZ = [[20e3, 24e3], [38e3, 42e3]]
SPACING_DEG = 2.6  # of 3000 directions


def camera_of(method, directions="3d:3000", **passive):
    changes = {"passive__bands_hz": BANDS_HZ, "passive__method": method}
    changes |= {f"passive__{name}": value for name, value in passive.items()}
    return ertis.AcousticCamera(listening(processing__directions=directions, **changes), "cpu", 1)


def levels_dbfs(camera):
    """Return the level of a single source in each band, which is that of the microphones without their own noise."""
    spectrum = camera.cross_spectrum()
    power = np.trace(spectrum.matrix, axis1=1, axis2=2).real / spectrum.matrix.shape[1]
    inside = [(spectrum.frequency_hz > low) & (spectrum.frequency_hz < high) for low, high in BANDS_HZ]
    own = OWN_RMS**2 / 112.5e3 * (spectrum.frequency_hz[1] - spectrum.frequency_hz[0])
    return [10 * np.log10((power[each] - own).mean()) for each in inside]


def errors(camera, places_deg):
    """Return the errors of angles in degrees and of levels in dB, both (place, band), and the sources per map."""
    angles, levels, counts = [], [], []
    bin_hz = camera.frequency_hz[1] - camera.frequency_hz[0]
    for seed, (azimuth_deg, elevation_deg) in enumerate(places_deg):
        heard = noise(camera.settings, [NoiseSource(azimuth_deg, elevation_deg, RMS)], own_rms=OWN_RMS, seed=seed)
        acoustic_map = camera.process(heard)
        found = ertis.find_sound_sources(acoustic_map)
        true = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))[0]
        strongest = [next(each for each in found if each.band_hz == tuple(band)) for band in BANDS_HZ]
        away = [unit_vectors(np.array([each.azimuth_rad]), np.array([each.elevation_rad]))[0] for each in strongest]
        angles.append([np.degrees(np.linalg.norm(each - true)) for each in away])
        per_bin = [10 * np.log10((high - low) / bin_hz) for low, high in BANDS_HZ]
        highest = acoustic_map.level_dbfs.max(axis=0) + 1  # Listed levels are at most 1 dB above their map.
        expected = np.minimum(np.add(levels_dbfs(camera), per_bin), highest)
        levels.append([each.level_dbfs - level for each, level in zip(strongest, expected, strict=True)])
        counts.append(len(found))
    return np.array(angles), np.array(levels), counts


PLACES_DEG = np.random.default_rng(1).uniform((-60, -40), (60, 40), (6, 2))


@pytest.mark.parametrize("method", ["delay_and_sum", "functional"])
def test_maxima_are_interpolated_between_directions(method):
    with camera_of(method) as camera:
        angles, levels, counts = errors(camera, PLACES_DEG)
    assert angles.max() < SPACING_DEG / 10
    assert np.abs(levels).max() < 0.5
    assert counts == [2] * len(PLACES_DEG)  # one of each band, and no side lobes


@pytest.mark.parametrize("method", ["clean_sc", "hr_clean_sc"])
def test_components_lie_near_the_source_and_have_its_level(method):
    with camera_of(method) as camera:
        angles, levels, _ = errors(camera, PLACES_DEG)
    assert angles.max() < 0.7 * SPACING_DEG
    assert np.abs(levels).max() < 0.6  # between directions, the main lobe of 7.4° is up to 0.5 dB lower


@pytest.mark.parametrize(("method", "n_sources"), [("capon", 1), ("music", 3)])
def test_inverses_are_interpolated_in_one_plane(method, n_sources):
    with camera_of(method, "2d:91", n_sources=n_sources) as camera:
        heard = noise(camera.settings, [NoiseSource(-35, 0, RMS), NoiseSource(20.9, 0, RMS)], own_rms=OWN_RMS, seed=3)
        found = ertis.find_sound_sources(camera.process(heard))
    for band in BANDS_HZ:
        azimuths_deg = sorted(np.degrees(each.azimuth_rad) for each in found if each.band_hz == tuple(band))
        assert min(abs(each + 35) for each in azimuths_deg) < 0.3  # directions are 2° apart
        assert min(abs(each - 20.9) for each in azimuths_deg) < 0.3
    assert all((each.level_dbfs is None) == (method == "music") for each in found)


@pytest.mark.parametrize("method", ["delay_and_sum", "clean_sc", "hr_clean_sc"])
def test_all_sources_are_listed_strongest_first(method):
    places = [NoiseSource(-35, 10, RMS), NoiseSource(20, -5, RMS / 2), NoiseSource(-5, 30, RMS / 1.5)]
    with camera_of(method) as camera:
        found = camera.process(noise(camera.settings, places, own_rms=OWN_RMS, seed=0))
    sources = [each for each in ertis.find_sound_sources(found) if each.band_hz == tuple(BANDS_HZ[1])]
    assert np.degrees([each.azimuth_rad for each in sources[:3]]) == pytest.approx([-35, -5, 20], abs=SPACING_DEG)
    steps_db = np.diff([each.level_dbfs for each in sources[:3]])
    # The level of a noise of 36 ms has a standard deviation of 0.4 dB.
    assert steps_db == pytest.approx([-3.5, -2.5], abs=2)
    assert all(each.level_dbfs < sources[2].level_dbfs for each in sources[3:])
    assert ertis.find_sound_sources(found, top=1) == [
        next(each for each in ertis.find_sound_sources(found) if each.band_hz == tuple(band)) for band in BANDS_HZ
    ]
    assert len(ertis.find_sound_sources(found, min_level_db=-5)) < len(ertis.find_sound_sources(found))


def test_noise_has_only_its_loudest_direction():
    with camera_of("delay_and_sum") as camera:
        found = camera.process(noise(camera.settings, [], own_rms=OWN_RMS, seed=0))
    assert [each.band_hz for each in ertis.find_sound_sources(found)] == [tuple(each) for each in BANDS_HZ]


@pytest.mark.parametrize("method", ["delay_and_sum", "capon", "clean_sc"])
def test_silence_has_no_source(method):
    with camera_of(method, "3d:400") as camera:
        found = camera.process(noise(camera.settings, [], own_rms=0.0, seed=0))
    assert ertis.find_sound_sources(found) == found.loudest() == []
    title = " ".join(text.get_text() for text in figures.acoustic_map(found).findobj(Text))
    assert "silence: all values are 0" in title


def test_arguments_of_sources_are_checked():
    with camera_of("delay_and_sum", "3d:400") as camera:
        found = camera.process(noise(camera.settings, [], own_rms=0.1, seed=0))
    for arguments, message in (({"top": 0}, "top is 0"), ({"min_level_db": 1}, "min_level_db is 1")):
        with pytest.raises(ArgumentError, match=message):
            ertis.find_sound_sources(found, **arguments)
    with pytest.raises(ArgumentError, match="found"):
        ertis.find_sound_sources(None)

"""Grids of directions in which bearings are found."""

import math
import re

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.analysis.direction_spacing import spacing_warning
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive.search_grid import coarse_map_warning, search_changes, search_warning
from ertis_numba.settings import Array, Recording

LINE_M = [[0.0, y, 0.0] for y in (0, 0.004, 0.011, 0.02, 0.031, 0.04)]
COLUMN_M = [[0.0, 0.0, y] for _, y, _ in LINE_M]


def settings_with(directions, **changes):
    return ertis.Settings().replace(**{"processing.directions": directions, **changes})


def suggested(text):
    return text.removesuffix(" directions").split()[-1]


@pytest.mark.parametrize("directions", ["1850", "3000", "3d:2400"])
def test_fine_grids_cause_no_warning_and_no_change(directions):
    settings = settings_with(directions)
    assert search_warning(settings) is None
    assert search_changes(settings) == {}


@pytest.mark.parametrize("directions", ["90", "2d:1", "2d:3000", ((0.0, 5.0),)])
def test_one_elevation_causes_a_warning_with_a_grid_that_is_fine(directions):
    text = search_warning(settings_with(directions))
    assert text.startswith("directions lie at one elevation")
    assert search_warning(settings_with(suggested(text))) is None


@pytest.mark.parametrize(
    ("directions", "words"), [("3d:10", "above 8.9 kHz"), ("3d:100", "above 17.8 kHz"), ("3d:2000", "above 70.8 kHz")]
)
def test_coarse_grids_cause_a_warning_with_a_grid_that_is_fine(directions, words):
    text = search_warning(settings_with(directions))
    assert words in text
    assert search_warning(settings_with(suggested(text))) is None


def test_bands_may_have_any_order():
    bands_hz = ((60e3, 80e3), (20e3, 30e3), (30e3, 40e3))
    texts = [
        search_warning(settings_with("3d:100", **{"passive.bands_hz": each}))
        for each in (bands_hz, bands_hz[::-1], tuple(sorted(bands_hz)))
    ]
    assert "above 20.0 kHz" in texts[0]
    assert texts == texts[:1] * 3


def test_suggested_grids_lie_within_the_limits():
    sector = {"processing.azimuth_limits_deg": (-20.0, 20.0), "processing.elevation_limits_deg": (-10.0, 30.0)}
    text = search_warning(settings_with("3d:20", **sector))
    assert search_warning(settings_with(suggested(text), **sector)) is None
    assert int(suggested(text).removeprefix("3d:")) < 400


def test_default_grid_covers_the_half_space():
    sector = {"processing.azimuth_limits_deg": (-20.0, 20.0), "processing.elevation_limits_deg": (0.0, 10.0)}
    grid = direction_grid(settings_with("2d:90", **sector).replace(**search_changes(settings_with("2d:90"))).processing)
    assert np.ptp(np.degrees(grid.azimuth_rad)) > 170
    assert np.ptp(np.degrees(grid.elevation_rad)) > 160


def test_sources_between_the_directions_of_a_sufficient_grid_lose_less_than_6_db():
    """Compute the beams of the nearest directions for sources at random; coarser grids lose more than 6 dB of some."""
    band_hz = (40e3, 50e3)
    settings = settings_with("90", **{"passive.bands_hz": (band_hz,)})
    sufficient = suggested(search_warning(settings))
    coarser = f"3d:{int(sufficient.removeprefix('3d:')) // 2}"
    places_m = microphones(settings.array).enabled_positions_m
    wave_1_m = 2 * math.pi * math.sqrt((band_hz[0] ** 2 + band_hz[0] * band_hz[1] + band_hz[1] ** 2) / 3) / 343.0
    random = np.random.default_rng(0)
    sources = unit_vectors(random.uniform(-1, 1, 2000), np.arcsin(random.uniform(-0.8, 0.8, 2000)))
    least = {}
    for name in (sufficient, coarser):
        grid = direction_grid(settings_with(name).processing)
        offsets = sources[:, None] - unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        nearest = offsets[np.arange(len(sources)), np.linalg.norm(offsets, axis=2).argmin(axis=1)]
        least[name] = np.abs(np.exp(1j * wave_1_m * nearest @ places_m.T).mean(axis=1)).min()
    assert least[sufficient] >= 0.5 > least[coarser]


def test_horizontal_line_needs_one_elevation_only():
    line = {"array.positions_m": LINE_M}
    assert search_warning(settings_with("2d:181", **line)) is None
    text = search_warning(settings_with("2d:5", **line))
    assert search_warning(settings_with(suggested(text), **line)) is None
    assert search_changes(settings_with("2d:5", **line))["processing.directions"].startswith("2d:")
    column = settings_with("2d:181", **{"array.positions_m": COLUMN_M})
    assert search_changes(column)["processing.directions"].startswith("3d:")


def spread(span_m, n_samples=16_000, **changes):
    """Settings of 16 microphones on a spiral, at 16 kHz."""
    turn, radius_m = np.arange(16) * 2.399963, span_m / 2 * np.sqrt((np.arange(16) + 0.5) / 16)
    places_m = np.stack([0 * turn, radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1)
    return ertis.Settings().replace(
        array=Array(positions_m=tuple(map(tuple, places_m.tolist()))),
        recording=Recording(sample_rate_hz=16e3, n_samples=n_samples, encoding="float32"),
        **{"processing.mode": "passive", "passive.bands_hz": ((1e3, 1.5e3),), **changes},
    )


@pytest.mark.parametrize("span_m", [0.5, 3.0])
def test_blocks_are_long_enough_for_large_arrays(span_m):
    settings = spread(span_m, **{"processing.directions": "3d:2500"})
    places_m = np.array(settings.array.positions_m)
    for seed in range(4):
        random = np.random.default_rng(seed)
        azimuth_rad, elevation_rad = np.radians(random.uniform((-60, -40), (60, 40)))
        (towards,) = unit_vectors(np.array([azimuth_rad]), np.array([elevation_rad]))
        spectrum, frequency_hz = np.fft.rfft(random.normal(0, 0.05, 20_000)), np.fft.rfftfreq(20_000, 1 / 16e3)
        early_s = places_m @ towards / sound_speed_m_s(settings.air)
        sound = [np.fft.irfft(spectrum * np.exp(2j * np.pi * frequency_hz * each)) for each in early_s]
        data = np.stack(sound, axis=1)[2000:18_000] + random.normal(0, 0.005, (16_000, 16))
        with ertis.AcousticCamera(settings, "cpu", 1) as camera:
            assert camera.warning is None
            camera.add(ertis.Measurement(data.astype("f4"), settings, ertis.Stamp(behaviour="passive")))
            (found,) = ertis.find_bearings(camera)
        (direction,) = unit_vectors(np.radians([found.azimuth_deg]), np.radians([found.elevation_deg]))
        assert math.degrees(np.linalg.norm(direction - towards)) < 5 * math.hypot(found.sideways_deg, found.upwards_deg)


@pytest.mark.parametrize(
    ("changes", "remedy"),
    [
        ({"passive.resolution_hz": 200.0}, "use passive.resolution_hz up to 41"),
        ({"n_samples": 320}, "use measurements of at least 24 ms"),
    ],
)
def test_blocks_that_are_too_short_for_an_array_are_warned_of(changes, remedy):
    settings = spread(3.0, **changes)
    for warning in (coarse_map_warning(settings), search_warning(settings)):
        assert re.match(r"blocks last [56] ms, but sound takes up to 8 ms to cross the array", warning)
        assert remedy in warning
    assert "blocks" not in (coarse_map_warning(spread(0.1)) or "")


def test_warnings_of_irregular_lists_state_the_largest_gap():
    listed = settings_with([[0.0, 0.0], [2.0, 0.0], [60.0, 0.0]])
    maps = listed.replace(**{"passive.bands_hz": ((20e3, 40e3),)})
    for warning in (spacing_warning(listed, direction_grid(listed.processing)), coarse_map_warning(maps)):
        assert warning.startswith("directions are up to 58.0° apart")


def test_search_warns_of_side_lobes_as_strong_as_the_main_lobe():
    """Half a wavelength at 20 kHz is 8.6 mm; of microphones in a row 20 mm apart, two directions have equal phases."""
    row = {"array.positions_m": [[0.0, 0.02 * k, 0.0] for k in range(6)], "passive.bands_hz": ((18e3, 20e3),)}
    assert "side lobes of this array are as strong as its main lobe" in search_warning(settings_with("2d:181", **row))
    near = {"array.positions_m": [[0.0, 0.005 * k, 0.0] for k in range(6)], "passive.bands_hz": ((18e3, 20e3),)}
    assert search_warning(settings_with("2d:181", **near)) is None

"""Grids of acoustic maps that are too coarse for an array: decision, named grids, and maps of sources between them."""

import math
import re

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import CoarseGridWarning
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.passive.search_grid import coarse_map_warning
from ertis_numba.settings import Array, Recording

SPEED_M_S = 331.3 * math.sqrt(1 + 20 / 273.15)


def spiral(n_mics, size_m):
    radius_m, turn = size_m / 2 * np.sqrt((np.arange(n_mics) + 0.5) / n_mics), np.arange(n_mics) * 2.399963
    return np.stack([0 * turn, radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1)


def ring(n_mics, size_m):
    turn = np.arange(n_mics) * 2 * math.pi / n_mics
    return size_m / 2 * np.stack([0 * turn, np.cos(turn), np.sin(turn)], axis=1)


def volume(n_mics, size_m):
    return np.random.default_rng(n_mics).uniform(-size_m / 2, size_m / 2, (n_mics, 3))


def line(n_mics, size_m):
    along = size_m * (np.linspace(0, 1, n_mics) ** 1.3 - 0.5)
    return np.stack([0 * along, along, 0 * along], axis=1)


def settings_with(positions_m, band_hz, directions, azimuth=(-90.0, 90.0), elevation=(-90.0, 90.0), **changes):
    return (
        ertis.Settings()
        .replace(array=Array(positions_m=tuple(map(tuple, np.asarray(positions_m).tolist()))))
        .replace("passive.bands_hz", (band_hz,))
        .replace("recording.n_samples", 655_360)  # Blocks last long enough for sound to cross 3 m.
        .replace(
            **{
                "processing.mode": "passive",
                "processing.directions": directions,
                "processing.azimuth_limits_deg": azimuth,
                "processing.elevation_limits_deg": elevation,
                **changes,
            }
        )
    )


def named(text):
    """Return the grid that a warning names."""
    return re.search(r"use at least (\S+) directions", text).group(1)


def random_sources(settings, count):
    """Return directions at random within the limits, or between the azimuths of a planar grid."""
    processing, random = settings.processing, np.random.default_rng(7)
    azimuth = random.uniform(*processing.azimuth_limits_rad, count)
    if processing.directions.startswith("2d:"):
        return unit_vectors(azimuth, np.zeros(count))
    return unit_vectors(azimuth, np.arcsin(random.uniform(*np.sin(processing.elevation_limits_rad), count)))


def losses_db(settings, frequency_hz, count=1500):
    """Return the loss of the loudest direction of each source, and the phase spread to it, from plane waves."""
    grid = direction_grid(settings.processing)
    places_m = microphones(settings.array).enabled_positions_m
    places_m = places_m - places_m.mean(axis=0)
    wave_1_m = 2 * math.pi * frequency_hz / SPEED_M_S
    directions, sources = unit_vectors(grid.azimuth_rad, grid.elevation_rad), random_sources(settings, count)
    beams = np.exp(1j * wave_1_m * directions @ places_m.T)
    amplitude = np.abs(np.exp(1j * wave_1_m * sources @ places_m.T) @ beams.conj().T) / len(places_m)
    loudest = amplitude.argmax(axis=1)
    spread = wave_1_m * np.std((directions[loudest] - sources) @ places_m.T, axis=1)
    return -20 * np.log10(amplitude.max(axis=1)), spread


CASES = [
    (spiral(64, 1.4), (17e3, 19e3), "3d:3000", {"azimuth": (-30.0, 30.0), "elevation": (-20.0, 20.0)}),
    (spiral(64, 0.3), (8e3, 12e3), "3d:500", {}),
    (spiral(32, 0.02), (40e3, 80e3), "3d:100", {}),
    (ring(24, 3.0), (2e3, 3e3), "3d:1000", {"azimuth": (-40.0, 10.0), "elevation": (0.0, 30.0)}),
    (volume(40, 0.5), (10e3, 15e3), "3d:300", {"azimuth": (-20.0, 20.0), "elevation": (-60.0, 60.0)}),
    (volume(16, 0.1), (20e3, 30e3), "3d:50", {"azimuth": (-180.0, 180.0)}),
    (spiral(48, 1.0), (5e3, 20e3), "2d:91", {}),
    (line(24, 0.2), (10e3, 12e3), "2d:20", {}),
    (line(24, 0.2), (10e3, 12e3), "3d:12", {"elevation": (-30.0, 30.0)}),
    (spiral(64, 0.6), (20e3, 25e3), "3d:20", {"azimuth": (-3.0, 3.0), "elevation": (-80.0, 80.0)}),
]


@pytest.mark.parametrize(("positions_m", "band_hz", "directions", "limits"), CASES)
def test_sources_anywhere_between_the_directions_of_a_named_grid_lose_at_most_3_db(
    positions_m, band_hz, directions, limits
):
    settings = settings_with(positions_m, band_hz, directions, **limits)
    text = coarse_map_warning(settings)
    loss_db, _ = losses_db(settings, band_hz[1])
    assert loss_db.max() > 2.5
    fine = settings.replace("processing.directions", named(text))
    assert coarse_map_warning(fine) is None
    loss_db, spread = losses_db(fine, band_hz[1])
    assert loss_db.max() <= 3.0
    assert spread.max() < 1.2, "the loudest direction is a side lobe"


@pytest.mark.parametrize("seed", range(12))
def test_grids_pass_exactly_if_no_source_is_lost(seed):
    random = np.random.default_rng(seed)
    make = (spiral, ring, volume)[seed % 3]
    size_m = 10 ** random.uniform(-1.7, 0.4)
    high_hz = float(random.uniform(3, 14) * SPEED_M_S / size_m)
    if not 500 < high_hz < 90e3:
        high_hz = 60e3 if high_hz > 500 else 1e3
    directions = f"{random.choice(['2d', '3d'])}:{int(10 ** random.uniform(1.5, 3.5))}"
    low_deg = float(random.uniform(-60, 0))
    settings = settings_with(
        make(48, size_m),
        (0.9 * high_hz, high_hz),
        directions,
        elevation=(low_deg, low_deg + float(random.uniform(5, 60))),
    )
    text = coarse_map_warning(settings)
    loss_db, spread = losses_db(settings, high_hz)
    if text is None:
        assert loss_db.max() <= 3.0
        assert spread.max() < 1.2
    else:
        assert loss_db.max() > 2.4  # Sources at random come close to the worst place.


@pytest.mark.parametrize(
    ("directions", "names_a_grid"),
    [
        (tuple((float(a), float(e)) for a in range(-60, 61, 10) for e in (-20, 0, 20)), True),
        (tuple((0.0, float(e)) for e in range(-60, 61, 10)), False),
        (tuple((float(a), 0.0) for a in (-60, -40, 10)), True),
        (((0.0, 0.0), (9.0, 9.0)), False),
    ],
)
def test_listed_directions_are_compared_between_neighbours(directions, names_a_grid):
    settings = settings_with(spiral(32, 0.3), (10e3, 12e3), directions)
    text = coarse_map_warning(settings)
    assert ("use at least" in text) == names_a_grid
    apart_deg = float(re.search(r"at most ([\d.]+)°", text).group(1))
    steps = np.arange(-5, 6) * apart_deg
    if len(directions) > 30:
        fine = tuple((float(a), float(e)) for a in steps for e in steps)
    else:
        fine = tuple((float(a), 0.0) for a in steps)
    assert coarse_map_warning(settings.replace("processing.directions", fine)) is None


@pytest.mark.parametrize("directions", [((3.0, 4.0),), "2d:1", "3d:1"])
def test_single_directions_cause_no_warning(directions):
    assert coarse_map_warning(settings_with(spiral(32, 0.3), (10e3, 12e3), directions)) is None


@pytest.mark.parametrize("directions", ["90", "1850", "3000", "3d:3200"])
@pytest.mark.parametrize("layout", ["eRTIS_v3D1", "xRTIS_v1"])
def test_shipped_grids_resolve_shipped_layouts_in_default_bands(layout, directions):
    settings = ertis.Settings().replace(**{"array.layout": layout, "processing.directions": directions})
    assert coarse_map_warning(settings) is None


def test_narrow_methods_need_finer_grids_or_other_levels():
    settings = settings_with(spiral(32, 0.1), (20e3, 25e3), "3d:2000")
    assert coarse_map_warning(settings) is None
    text = coarse_map_warning(settings.replace("passive.method", "functional"))
    assert "in maps of functional, whose peaks are narrow; use at least 3d:" in text
    fine = settings.replace(**{"passive.method": "functional", "processing.directions": named(text)})
    assert coarse_map_warning(fine) is None
    assert "use method delay_and_sum or clean_sc for levels" in coarse_map_warning(
        settings.replace("passive.method", "capon")
    )
    assert coarse_map_warning(settings.replace("passive.method", "music")) is None


def test_frequencies_are_named_where_no_grid_suffices():
    settings = settings_with(spiral(64, 3.0), (39e3, 40e3), "3d:3000")
    text = coarse_map_warning(settings)
    assert "no grid of up to 200000 directions suffices, so use narrower limits of azimuth and elevation" in text
    high_hz = float(re.search(r"bands_hz up to (\d+) Hz", text).group(1))
    assert coarse_map_warning(settings.replace("passive.bands_hz", ((0.9 * high_hz, high_hz),))) is None
    assert high_hz > 1000


def test_side_lobes_as_strong_as_sources_are_reported_for_any_grid():
    comb_m = [[0.0, 0.02 * k, 0.0] for k in range(8)]
    settings = settings_with(comb_m, (20e3, 21e3), "2d:721")
    text = coarse_map_warning(settings)
    assert "side lobes of this array are as strong as its main lobe" in text
    assert "use at least" not in text
    high_hz = float(re.search(r"bands_hz up to (\d+) Hz", text).group(1))
    assert coarse_map_warning(settings.replace("passive.bands_hz", ((0.9 * high_hz, high_hz),))) is None
    assert SPEED_M_S / 0.045 < high_hz < SPEED_M_S / 0.018


def test_cameras_warn_unless_told_not_to():
    settings = settings_with(spiral(16, 0.2), (17e3, 19e3), "3d:50").replace(
        recording=Recording(sample_rate_hz=51_200.0, n_samples=4096, encoding="float32")
    )
    with pytest.warns(CoarseGridWarning, match="use at least 3d:"), ertis.AcousticCamera(settings) as camera:
        assert "3d:" in camera.warning
    ertis.AcousticCamera(settings, check=False).close()

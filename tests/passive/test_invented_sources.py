"""No listed level exceeds its image or acoustic map by more than 1 dB, and no listed direction leaves its cell.

``ERTIS_RANDOM_CASES=10000 pytest --timeout 0 tests/passive/test_invented_sources.py`` tries more random cases, and
``ERTIS_RANDOM_CASES=2500:5000`` a part of them.
"""

import os

import numpy as np
import pytest
from ertis_bench.passive.sound_signals import NoiseSource, listening, noise
from scipy.spatial import KDTree

import ertis_numba as ertis
from ertis_numba.analysis.detect import find_peaks, neighbours_of, peaks_of_grid
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.analysis.quadric_fits import QuadricFits
from ertis_numba.frames import AcousticMap
from ertis_numba.geometry import Grid, direction_grid, unit_vectors
from ertis_numba.passive import find_sound_sources
from ertis_numba.passive.sound_sources import sources_of_grid
from ertis_numba.settings import MAP_METHODS, Processing
from tests.analysis.test_detect import image_of
from tests.random_sounds import C_M_S, map_power, random_image, random_map, settings_of

MANY = os.environ.get("ERTIS_RANDOM_CASES")
FIRST, _, LAST = MANY.rpartition(":") if MANY else ("", "", "")
MAPS, IMAGES = ([range(int(FIRST or 0), int(LAST))] * 2) if MANY else (range(120), range(80))
LIMIT_DB = 1.0


def is_wide(seed):
    """True for seeds of images with so many ranges that many maxima are listed."""
    return seed % (2 if MANY else 16) == 1


def are_in_cells(grid, level, listed, tolerance=1e-7):
    """True for each listed direction whose nearest direction of the grid is a local maximum; ties count for both."""
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    is_maximum = (level >= level[neighbours_of(directions)].max(axis=1)).reshape(len(directions), -1).any(axis=1)
    tree = KDTree(directions)
    away, _ = tree.query(listed)
    return [
        is_maximum[tree.query_ball_point(each, near + tolerance)].any() for each, near in zip(listed, away, strict=True)
    ]


def test_no_source_is_louder_than_its_map():
    for seed in MAPS:
        found = random_map(seed, most=10_000 if MANY and seed % 10 == 0 else 1000)
        sources = sources_of_grid(found, top=None)
        assert len(sources) == len(find_sound_sources(found, top=None)), seed
        assert sources or found.is_silent.all(), seed
        for each in sources:
            band = [tuple(edges) for edges in found.band_hz.tolist()].index(each.band_hz)
            highest_dbfs = found.level_dbfs[:, band].max()
            if each.level_dbfs is not None and np.isfinite(highest_dbfs):
                assert each.level_dbfs <= highest_dbfs + LIMIT_DB, (seed, each)
            assert each.grid_error_rad >= 0
        if not sources:
            continue
        listed = unit_vectors(*np.transpose([(each.azimuth_rad, each.elevation_rad) for each in sources]))
        is_interpolated = not found.settings.passive.traits.is_sparse
        assert not is_interpolated or all(are_in_cells(found, found.power, listed)), seed


def test_no_peak_is_louder_than_its_image():
    for seed in IMAGES:
        image = random_image(seed, most=200, n_ranges=64 + seed % 7) if is_wide(seed) else random_image(seed)
        highest_dbfs = image.level_dbfs.max()
        peaks = peaks_of_grid(image, top=40)
        assert all(peak.level_dbfs <= highest_dbfs + LIMIT_DB for peak in peaks), (seed, peaks)
        if peaks:
            listed = unit_vectors(*np.transpose([(peak.azimuth_rad, peak.elevation_rad) for peak in peaks]))
            assert all(are_in_cells(image, image.amplitude, listed)), (seed, peaks)
        step_m = float(image.range_m[1] - image.range_m[0]) if len(image.range_m) > 1 else 0.0
        assert all(image.range_m[0] - step_m <= peak.range_m <= image.range_m[-1] + step_m for peak in peaks), seed
        cloud = PointExtractor(image.settings, Grid(image.azimuth_rad, image.elevation_rad))(image)
        assert (cloud.amplitude <= image.amplitude.max() * 10 ** (LIMIT_DB / 20)).all(), seed


@pytest.mark.filterwarnings(
    "ignore::ertis_numba.base.errors.CoarseGridWarning"
)  # Coarse grids must hold the limit, too.
@pytest.mark.parametrize("diagonal_removal", [False, True])
@pytest.mark.parametrize("method", MAP_METHODS)
def test_sources_of_a_camera_stay_within_its_map(method, diagonal_removal):
    if diagonal_removal and method in ("functional", "capon", "music"):
        return  # These methods need the diagonal.
    for seed, directions, limits_deg in ((0, "3d:300", (-30.0, 30.0)), (1, "3d:60", (-90.0, 90.0))):
        changes = {"azimuth_limits_deg": limits_deg, "elevation_limits_deg": (-20.0, 20.0), "directions": directions}
        settings = listening(
            **{f"processing__{name}": value for name, value in changes.items()},
            passive__bands_hz=[[20e3, 24e3], [38e3, 42e3]],
            passive__method=method,
            passive__diagonal_removal=diagonal_removal,
        )
        with ertis.AcousticCamera(settings, "cpu", 1) as camera:
            for sources in ([], [NoiseSource(29.5, 3, 0.05), NoiseSource(-50, 19, 0.02)]):
                found = camera.process(noise(settings, sources, own_rms=0.005, seed=seed))
                listed = find_sound_sources(found, top=None)
                for each in listed if method != "music" else ():
                    band = [tuple(edges) for edges in found.band_hz.tolist()].index(each.band_hz)
                    assert each.level_dbfs <= found.level_dbfs[:, band].max() + LIMIT_DB


def edge_map(azimuth_deg, elevation_deg, directions, **limits):
    """Map of a tone in white noise, heard by a spiral of 1.4 m, as of acoustic cameras."""
    turn = np.arange(64) * 2.399963
    radius_m = 0.7 * np.sqrt((np.arange(64) + 0.5) / 64)
    places_m = np.round(np.stack([0 * turn, radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1), 6)
    settings = settings_of(places_m, {"directions": directions, **limits})
    grid = direction_grid(settings.processing)
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    wave_1_m = 2 * np.pi * 6000 / C_M_S
    places_m -= places_m.mean(axis=0)
    towards = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))[0]
    heard = np.exp(1j * wave_1_m * places_m @ towards)
    waves = np.exp(1j * wave_1_m * directions @ places_m.T)
    power = map_power(waves, np.outer(heard, heard.conj()) + 1e-3 * np.eye(64), "delay_and_sum", 1, removed=False)
    band_hz = np.array([[5999.0, 6001.0]])
    return AcousticMap(power[:, None].astype(np.float32), grid.azimuth_rad, grid.elevation_rad, band_hz, settings)


LIMITS = {"azimuth_limits_deg": (-30.0, 30.0), "elevation_limits_deg": (-20.0, 20.0)}
# Sources in cells at an edge for which samples on one side of a narrow lobe show no maximum within the cell.
UNKNOWN = {(-29.7, -19.6), (0.3, -19.6), (-29.7, 19.9), (0.3, 19.9), (29.2, 19.9)}


@pytest.mark.parametrize("azimuth_deg", [-29.7, 0.3, 29.2])
@pytest.mark.parametrize("elevation_deg", [-19.6, 0.4, 19.9])
def test_source_in_the_cell_at_an_edge_is_listed_there(azimuth_deg, elevation_deg):
    found = edge_map(azimuth_deg, elevation_deg, "3d:3000", **LIMITS)  # directions are 0.9° apart
    (source,) = find_sound_sources(found, top=1)
    apart_deg = [np.degrees(source.azimuth_rad) - azimuth_deg, np.degrees(source.elevation_rad) - elevation_deg]
    is_inner = abs(azimuth_deg) < 29 and abs(elevation_deg) < 19
    assert np.abs(apart_deg).max() < (0.05 if is_inner else 0.5)
    assert source.level_dbfs == pytest.approx(0, abs=0.05 if is_inner else 1.0)
    expected_deg = 0 if is_inner else np.inf if (azimuth_deg, elevation_deg) in UNKNOWN else 0.9 / np.sqrt(12)
    assert np.degrees(source.grid_error_rad) == pytest.approx(expected_deg, abs=0.04)


def test_source_at_an_edge_is_interpolated_along_it():
    spread = {"azimuth_limits_deg": (-30.0, 30.0), "elevation_limits_deg": (0.0, 20.0)}
    grid_deg = np.unique(np.degrees(direction_grid(Processing(directions="3d:300", **spread)).elevation_rad))
    found = edge_map(4.3, grid_deg[0] - 0.5, "3d:300", **spread)  # directions are 2° apart
    (source,) = find_sound_sources(found, top=1)
    assert np.degrees(source.azimuth_rad) == pytest.approx(4.3, abs=0.1)
    assert np.degrees(source.elevation_rad) == pytest.approx(grid_deg[0], abs=0.01)
    assert source.grid_error_rad > 0


@pytest.mark.parametrize(("directions", "error_deg"), [("2d:121", 0.0), ("3d:900", 0.0), ("2d:1", np.inf)])
def test_peak_states_the_error_that_the_grid_causes(directions, error_deg):
    (peak,) = find_peaks(image_of([(12.34, 1, 1.2, 1.0)], directions=directions, range_m=(1.1, 1.3)), top=1)
    assert peak.grid_error_deg == error_deg
    if directions == "3d:900":
        (peak,) = find_peaks(image_of([(91.0, 5.0, 1.2, 1.0)], directions=directions, range_m=(1.1, 1.3)), top=1)
        assert 1 < peak.grid_error_deg < 2  # directions are 4.8° apart


@pytest.mark.parametrize("azimuth_deg", [-180, -179.6, -178.7, 178.7, 179.3, 180])
@pytest.mark.parametrize("limits_deg", [(-180.0, 180.0), (-180.0, 178.0)])
def test_maximum_at_the_seam_of_a_full_circle_is_interpolated_across_it(azimuth_deg, limits_deg):
    n_directions = 181 if limits_deg[1] == 180 else 180  # The first circle ends where it starts.
    azimuth_rad = np.radians(np.linspace(*limits_deg, n_directions))
    level = -(np.degrees(np.angle(np.exp(1j * (azimuth_rad - np.radians(azimuth_deg))))) ** 2)
    directions = unit_vectors(azimuth_rad, 0 * azimuth_rad)
    neighbours, here = neighbours_of(directions), np.array([level.argmax()])
    fits = QuadricFits.of(directions, neighbours, here)
    offset, _ = fits.tops(np.array([0]), level[neighbours[here]] - level[here][:, None])
    offset, width_rad = fits.within_cells(np.array([0]), offset)
    found = np.angle(np.dot(directions[here[0]] + offset[0], [1, 1j, 0]) * np.exp(-1j * np.radians(azimuth_deg)))
    assert np.degrees(found) == pytest.approx(0, abs=0.01)
    assert width_rad == pytest.approx(0)


@pytest.mark.parametrize(
    "azimuth_deg", [np.linspace(-180, 180, 37), np.repeat(np.arange(-30.0, 31, 5), 2), np.tile([5.0, 6, 7], 4)]
)
def test_neighbours_of_equal_directions_are_different_ones(azimuth_deg):
    directions = unit_vectors(np.radians(azimuth_deg), 0 * azimuth_deg)
    for place, row in enumerate(neighbours_of(directions)):
        equal = np.flatnonzero(np.linalg.norm(directions - directions[place], axis=1) < 1e-9)
        assert row[0] == equal[0]
        assert set(equal) <= set(row)
        others = np.linalg.norm(directions[row[1:3]] - directions[place], axis=1)
        assert others[0] > 1e-9
        assert len(np.unique(row[:3])) == 3


@pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CoarseGridWarning")
def test_direction_that_is_listed_twice_is_one_source():
    for copies in (1, 2, 9):
        azimuth_deg = np.repeat(np.arange(-20.0, 21), copies)
        found = edge_map(7.2, 0, tuple((float(each), 0.0) for each in azimuth_deg))
        (source,) = find_sound_sources(found, top=None, min_level_db=-1)
        assert np.degrees(source.azimuth_rad) == pytest.approx(7.2, abs=0.1)


def test_direction_that_is_held_at_its_border_has_the_error_of_what_was_cut():
    directions = unit_vectors(np.radians(np.arange(-6.0, 7, 2)), np.zeros(7))
    fits = QuadricFits.of(directions, neighbours_of(directions), np.array([3]))
    for wanted_deg, error_deg in ((0.9, 0.0), (1.2, 0.2), (1.32, 0.32), (1.6, 2 / np.sqrt(12))):
        offset = unit_vectors(np.radians([wanted_deg]), np.zeros(1)) - directions[3]
        cut, width_rad = fits.within_cells(np.array([0]), offset)
        assert np.degrees(np.linalg.norm(cut)) == pytest.approx(min(wanted_deg, 1.0), abs=0.02)
        assert np.degrees(width_rad[0]) / np.sqrt(12) == pytest.approx(error_deg, abs=0.02)


def angles_of(directions, *, shown):
    """Numbers of axes of the fits of directions, (azimuth, elevation) in degrees."""
    vectors = unit_vectors(*np.radians(directions).T)
    fits = QuadricFits.of(vectors, neighbours_of(vectors), np.arange(len(vectors)))
    return fits.quadrics.n_axes[shown].tolist()


def test_fits_have_the_axes_that_neighbours_determine():
    square = np.array([(azimuth, elevation) for azimuth in range(5) for elevation in range(5)], dtype=float)
    assert angles_of(square, shown=[12, 2, 0]) == [2, 1, 0]  # middle, edge, corner
    row = np.array([(azimuth, 0.0) for azimuth in range(4)])
    assert angles_of(row, shown=slice(None)) == [0, 1, 1, 0]
    column = np.array([(10.0, elevation) for elevation in range(12)])
    assert angles_of(column, shown=[0, 1, 5, 11]) == [0, 1, 1, 0]
    two_rows = np.array([(azimuth, elevation) for azimuth in range(9) for elevation in (0.0, 1.0)])
    assert angles_of(two_rows, shown=[8, 9]) == [1, 1]
    assert angles_of(np.array([(0.0, 0.0)]), shown=[0]) == [0]
    assert angles_of(np.array([(0.0, 0.0)] * 12), shown=[0]) == [0]


def heard_at(seed):
    """A random array, its grid with limits, and the angle of the strongest source to a tone near an edge or beyond."""
    rng = np.random.default_rng([3, seed])
    is_planar, n_mics, half_m = bool(seed % 2), 24, 10 ** rng.uniform(-1.5, 0)
    places_m = rng.uniform(-half_m, half_m, (n_mics, 3))
    wave_1_m = rng.uniform(1.0, 2.0) / half_m
    step_deg = np.degrees(2.5 / (wave_1_m * half_m)) / rng.uniform(3, 6)
    east_deg, low_deg = rng.uniform(20, 60), rng.uniform(-40, -20)
    limits = {"azimuth_limits_deg": (-east_deg, east_deg), "elevation_limits_deg": (low_deg, -low_deg)}
    area = np.radians(2 * east_deg) * 2 * np.sin(np.radians(-low_deg)) / np.radians(step_deg) ** 2
    name = f"2d:{max(8, int(2 * east_deg / step_deg))}" if is_planar else f"3d:{max(50, int(area))}"
    azimuth_deg = east_deg + (0, 0, rng.uniform(0, 25), rng.uniform(-1, 1) * step_deg)[seed // 2 % 4]
    if seed // 2 % 4 == 0:
        azimuth_deg = rng.uniform(-east_deg, east_deg)
    elevation_deg = 0.0 if is_planar else rng.uniform(low_deg, -low_deg)
    settings = settings_of(places_m, {"directions": name, **limits})
    grid = direction_grid(settings.processing)
    directions, towards = (
        unit_vectors(*angles)
        for angles in (
            (grid.azimuth_rad, grid.elevation_rad),
            (np.radians([azimuth_deg]), np.radians([elevation_deg])),
        )
    )
    heard = np.exp(1j * wave_1_m * places_m @ towards[0])
    own = 10 ** rng.uniform(-3, -1) * rng.standard_normal((n_mics, 200, 2)).view(complex)[..., 0]
    matrix = np.outer(heard, heard.conj()) + own @ own.conj().T / 200
    waves = np.exp(1j * wave_1_m * directions @ places_m.T)
    power = map_power(waves, matrix, "delay_and_sum", 1, removed=False)
    frequency_hz = wave_1_m * C_M_S / (2 * np.pi)
    band_hz = frequency_hz * np.array([[0.999, 1.001]])
    found = AcousticMap(power[:, None].astype(np.float32), grid.azimuth_rad, grid.elevation_rad, band_hz, settings)
    (source,) = sources_of_grid(found, top=1)
    listed = unit_vectors(np.array([source.azimuth_rad]), np.array([source.elevation_rad]))[0]
    spacing_rad = KDTree(directions).query(directions, k=2)[0][:, 1].max()
    return (
        source,
        np.arccos(np.clip(listed @ towards[0], -1, 1)),
        spacing_rad,
        azimuth_deg > east_deg + np.degrees(spacing_rad),
    )


def test_error_that_the_grid_causes_covers_the_true_one_at_its_limits():
    draws = [heard_at(seed) for seed in range(120)]
    covered = [
        error_rad <= max(4 * source.grid_error_rad, 0.2 * spacing_rad) for source, error_rad, spacing_rad, _ in draws
    ]
    assert np.mean(covered) > 0.95
    is_known = np.array([np.isfinite(source.grid_error_rad) for source, *_ in draws])
    is_beyond = np.array([beyond for *_, beyond in draws])
    assert is_known[~is_beyond].mean() > 0.6  # An error that is always unknown would be no answer.
    assert is_known[is_beyond].mean() < 0.2

"""Layouts agree with the device's files, grids with areas, and delays with each other."""

import importlib.metadata

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import loadmat
from scipy.spatial import cKDTree

from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.units import sound_pressure_level_db
from ertis_numba.geometry import (
    PAPER_GRIDS,
    Fan,
    azimuth_columns,
    direction_grid,
    far_field_delays,
    is_closed,
    layout_file,
    layout_names,
    load_layout,
    microphones,
    named_grid,
    plan_m,
    reach_rad,
    spacing_rad,
    spherical_delays,
    unit_vectors,
    written_out,
)
from ertis_numba.settings import Array, Processing

NAMES = ("eRTIS_v2", "eRTIS_v2REC", "eRTIS_v3D1", "eRTIS_v3D1REC", "uRTIS_v1", "xRTIS_v1")

# ---- layouts ---------------------------------------------------------------------------------------


def test_six_rtis_layouts_are_included():
    assert layout_names() == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_layouts_equal_those_of_the_device(name):
    """The package of the manufacturer is read as data; it is never imported."""
    files = importlib.metadata.distribution("rtisdev")
    path = files.locate_file(f"rtisdev/config/microphoneLayouts/{name}/mic_coordinates.mat")
    their_m = np.asarray(loadmat(path)["mic_pos_final_pos"], dtype=np.float64)[:, :2] / 1000
    layout = load_layout(name)
    present = np.isfinite(their_m).all(axis=1)
    assert_array_equal(layout.enabled, present)
    centred_m = their_m[present] - their_m[present].mean(axis=0)
    assert_allclose(layout.enabled_positions_m[:, 1:], centred_m, atol=6e-8)  # four decimals of a millimetre
    assert_array_equal(layout.positions_m[:, 0], 0)
    assert (layout.n_words, layout.word_bits) == (1, 32)


def test_two_layouts_have_two_unused_channels():
    disabled = {name: int(np.sum(~load_layout(name).enabled)) for name in NAMES}
    assert {name for name, count in disabled.items() if count} == {"uRTIS_v1", "eRTIS_v3D1REC"}
    assert disabled["uRTIS_v1"] == disabled["eRTIS_v3D1REC"] == 2


def test_layout_v2_is_v3d1_with_reordered_channels():
    order = [*range(0, 32, 2), *range(1, 32, 2)]
    v2, v3d1 = load_layout("eRTIS_v2").positions_m, load_layout("eRTIS_v3D1").positions_m
    assert_allclose(v2[order], v3d1, atol=1e-12)
    assert np.abs(v2 - v3d1).max() > 0.01


@pytest.mark.parametrize("name", NAMES)
def test_written_layouts_depend_on_no_file(name):
    layout = load_layout(name)
    again = microphones(layout.to_array())
    assert_allclose(again.positions_m, layout.positions_m, atol=1e-15)
    assert_array_equal(again.enabled, layout.enabled)
    assert_array_equal(again.gain, layout.gain)
    assert_array_equal(again.delay_s, layout.delay_s)


def test_positions_are_relative_to_the_centroid_of_enabled_microphones():
    array = Array(positions_m=((0.1, 0.2, 0.3), (0.1, 0.4, 0.3), (9.0, 9.0, 9.0)), enabled=(True, True, False))
    layout = microphones(array)
    assert_allclose(layout.enabled_positions_m, [[0, -0.1, 0], [0, 0.1, 0]], atol=1e-15)
    assert_array_equal(layout.positions_m[2], 0)


@pytest.mark.parametrize(
    ("count", "word_bits", "n_words"), [(1, 8, 1), (8, 8, 1), (9, 8, 2), (33, 32, 2), (1024, 64, 16)]
)
def test_words_per_sample_follow_from_channels(count, word_bits, n_words):
    positions_m = tuple((0.0, 0.0, 1e-3 * channel) for channel in range(count))
    assert microphones(Array(positions_m=positions_m, word_bits=word_bits)).n_words == n_words


def test_layout_files_are_read(tmp_path):
    text = 'source = "drawing"\nword_bits = 16\ndisabled = [1]\npositions_mm = [[0, 0], [nan, nan], [4, 2]]\n'
    (tmp_path / "mine.toml").write_text(text)
    layout = load_layout(tmp_path / "mine.toml")
    assert (layout.name, layout.word_bits) == (str(tmp_path / "mine.toml"), 16)
    assert_allclose(layout.enabled_positions_m, [[0, -0.002, -0.001], [0, 0.002, 0.001]])
    (tmp_path / "gains.toml").write_text("gain = [1.0, 0.5]\ndelay_s = [0.0, 1e-6]\npositions_mm = [[0, 0], [4, 2]]")
    calibrated = load_layout(tmp_path / "gains.toml")
    assert (calibrated.gain.tolist(), calibrated.delay_s.tolist()) == ([1.0, 0.5], [0.0, 1e-6])
    (tmp_path / "mine.csv").write_text("# x, y, z in millimetres\n1, 0, 0\n\n1, 4, 2  # the last\n")
    flat = load_layout(tmp_path / "mine.csv")
    assert flat.name == "mine"
    assert_allclose(flat.positions_m, [[0, -0.002, -0.001], [0, 0.002, 0.001]])


def test_sensitivity_of_a_layout_is_kept_unless_the_settings_state_another(tmp_path):
    path = tmp_path / "mems.toml"
    path.write_text("sensitivity_dbfs = -26.0\npositions_mm = [[0, 0], [4, 2]]")
    named = Array(layout=str(path))
    assert load_layout(path).sensitivity_dbfs == microphones(named).sensitivity_dbfs == -26.0
    assert microphones(named.replace(sensitivity_dbfs=-29.5)).sensitivity_dbfs == -29.5
    assert written_out(named).sensitivity_dbfs == written_out(written_out(named)).sensitivity_dbfs == -26.0
    assert layout_file(load_layout(path), name="mine").sensitivity_dbfs == -26.0
    assert microphones(Array()).sensitivity_dbfs is None
    with pytest.raises(ArgumentError, match=r"array.sensitivity_dbfs is 94; use a number from -120 to 20"):
        Array(sensitivity_dbfs=94.0)


def test_emitter_of_a_layout_is_kept_unless_the_settings_state_another(tmp_path):
    path = tmp_path / "wide.toml"
    path.write_text("emitter_diameter_m = 0.02\npositions_mm = [[0, 0], [4, 2]]")
    named = Array(layout=str(path))
    assert load_layout(path).emitter_diameter_m == microphones(named).emitter_diameter_m == 0.02
    assert microphones(named.replace(emitter_diameter_m=0.0)).emitter_diameter_m == 0.0
    assert written_out(named).emitter_diameter_m == written_out(written_out(named)).emitter_diameter_m == 0.02
    assert layout_file(load_layout(path), name="mine").emitter_diameter_m == 0.02
    with pytest.raises(ArgumentError, match=r"array.emitter_diameter_m is 12; use a number from 0 to 0.2"):
        Array(emitter_diameter_m=12.0)


def test_sound_pressure_level_follows_from_the_sensitivity_of_a_data_sheet():
    """A sine of 1 Pa at −26 dBFS has an amplitude of 10^(−26/20); its RMS in this package is 3 dB lower."""
    sine = 10 ** (-26 / 20) * np.sin(2 * np.pi * np.arange(1000) / 10)
    dbfs = 20 * np.log10(np.sqrt(np.mean(sine**2)))
    assert_allclose(sound_pressure_level_db(dbfs, -26.0), 20 * np.log10(1 / 20e-6))
    assert_allclose(sound_pressure_level_db(dbfs - 40.0, -26.0), 20 * np.log10(0.01 / 20e-6))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("eRTIS_v3D", None, r"layout 'eRTIS_v3D' is unknown .did you mean 'eRTIS_v3D1'.*known are eRTIS_v2, "),
        ("none.toml", None, r"layout .*none\.toml: .*; choose a readable file or one of eRTIS_v2, "),
        ("bytes.csv", b"\xff", r"layout .*bytes\.csv: .*; choose a readable file or one of"),
        ("l.toml", b"positions_mm = [", r"layout .*l\.toml: .*; correct it or remove it"),
        ("l.toml", b"", r"layout .*l\.toml: the file is empty; choose a readable file or one of"),
        ("l.toml", b"positions_mm = 3", r"layout .*l\.toml, line 1, positions_mm: Expected `array \| null`, got `int`"),
        (
            "l.toml",
            b"positions_mm = [['a', 'b']]",
            r"layout .*l\.toml, line 1, positions_mm\[0\]\[0\]: Expected `float`, got `str`",
        ),
        (
            "l.toml",
            b"positions_mm = []",
            r"layout .*l\.toml: positions_mm does not consist of rows of 2 or 3 numbers; write y, z",
        ),
        (
            "l.toml",
            b"positions_mm = [[1, 2], [1, 2, 3]]",
            r"layout .*l\.toml: positions_mm does not consist of rows of 2 or 3",
        ),
        (
            "l.toml",
            b"positions_mm = [[1]]",
            r"layout .*l\.toml: positions_mm does not consist of rows of 2 or 3 numbers",
        ),
        ("l.toml", b"positions_mm = [[1, nan]]", r"layout .*l\.toml: positions_mm holds nan at \[0, 2\]; pass finite"),
        (
            "l.toml",
            b"colour = 1\npositions_mm = [[1, 2]]",
            r"layout .*l\.toml, line 1: unknown key `colour`; correct it",
        ),
        ("l.toml", b"word_bits = 9\npositions_mm = [[1, 2]]", r"layout .*l\.toml: array\.word_bits '9' is unknown"),
        ("l.toml", b"disabled = [1]\npositions_mm = [[1, 2]]", r"l\.toml: a disabled channel is 1; use a whole .* 0"),
        ("l.toml", b"disabled = [0]\npositions_mm = [[1, 2]]", r"l\.toml: array\.enabled is false for all channels"),
        (
            "l.csv",
            b"1, 2\n3, x\n",
            r"layout .*l\.csv, line 2: z is 'x'; use a number",
        ),
        (
            "l.toml",
            b"positions_mm = [[1, 2], [3, 4], [1, 2]]",
            r"channels 0 and 2 have the same position; correct one of them, or disable one with the key 'disabled'",
        ),
        ("l.toml", b"gain = [1.0]\npositions_mm = [[1, 2], [3, 4]]", r"l\.toml: array\.gain has shape \(1,\)"),
        ("l.csv", b"# nothing\n", r"layout .*l\.csv: no positions; write one row per channel, y, z or x, y, z"),
        ("l.csv", b"1, nan\n", r"layout .*l\.csv, line 1: z is nan; use a finite number"),
        ("l.csv", b"1, 2\n" * 1025, r"layout .*l\.csv: number of array\.positions_m is 1025; use .* from 1 to 1024"),
    ],
)
def test_bad_layouts_are_refused(tmp_path, name, text, message):
    path = tmp_path / name if "." in name else name
    if text is not None:
        path.write_bytes(text)
    with pytest.raises(ArgumentError, match=message):
        load_layout(path)


# ---- grids -----------------------------------------------------------------------------------------


def limits(low, high):
    return st.tuples(st.floats(low, high), st.floats(low, high)).map(lambda pair: (min(pair), max(pair)))


@pytest.mark.parametrize("name", PAPER_GRIDS)
def test_paper_grids_have_their_number_of_directions(name):
    grid = direction_grid(Processing(directions=name, azimuth_limits_deg=(-1.0, 1.0)))  # its own limits count
    _, azimuth_deg, elevation_deg = PAPER_GRIDS[name]
    assert len(grid) == int(name)
    assert azimuth_deg[0] <= np.degrees(grid.azimuth_rad).min() <= azimuth_deg[0] + 4
    assert azimuth_deg[1] >= np.degrees(grid.azimuth_rad).max() >= azimuth_deg[1] - 4
    assert elevation_deg[0] <= np.degrees(grid.elevation_rad).min() <= elevation_deg[0] + 4
    assert elevation_deg[1] >= np.degrees(grid.elevation_rad).max() >= elevation_deg[1] - 4


def test_planar_grids_include_both_limits():
    grid = direction_grid(Processing(directions="2d:181"))
    assert_allclose(np.degrees(grid.azimuth_rad), np.arange(-90, 91), atol=1e-12)
    assert not grid.elevation_rad.any()
    single = direction_grid(Processing(directions="2d:1", azimuth_limits_deg=(10.0, 30.0)))
    assert_allclose(np.degrees(single.azimuth_rad), [20])


def test_planar_grid_at_an_elevation_is_a_cone():
    grid = direction_grid(Processing(directions="2d:5", elevation_deg=-30.0))
    assert_allclose(grid.azimuth_deg, [-90, -45, 0, 45, 90], atol=1e-12)
    assert_allclose(grid.elevation_deg, [-30] * 5)
    for name in ("90", "3d:50"):  # whose elevations are fixed, or have limits
        own, other = (direction_grid(Processing(directions=name, elevation_deg=each)) for each in (0.0, 20.0))
        assert own.elevation_rad.tobytes() == other.elevation_rad.tobytes()
    with pytest.raises(ArgumentError, match=r"processing.elevation_deg is 91; use a number from -90 to 90"):
        Processing(directions="2d:5", elevation_deg=91.0)


@settings(max_examples=100, deadline=None)
@given(count=st.integers(1, 1000), azimuth_deg=limits(-180, 180), elevation_deg=limits(-90, 90))
def test_solid_grids_have_their_count_and_limits(count, azimuth_deg, elevation_deg):
    processing = Processing(
        directions=f"3d:{count}", azimuth_limits_deg=azimuth_deg, elevation_limits_deg=elevation_deg
    )
    grid = direction_grid(processing)
    assert len(grid) == len(grid.elevation_rad) == count
    slack = 1e-6  # an arc sine near 90° has half of the digits
    assert np.all(np.degrees(grid.azimuth_rad) >= azimuth_deg[0] - slack)
    assert np.all(np.degrees(grid.azimuth_rad) <= azimuth_deg[1] + slack)
    assert np.all(np.degrees(grid.elevation_rad) >= elevation_deg[0] - slack)
    assert np.all(np.degrees(grid.elevation_rad) <= elevation_deg[1] + slack)


@pytest.mark.parametrize(
    ("count", "azimuth_deg", "elevation_deg"),
    [
        (1850, (-45, 45), (-45, 45)),
        (3000, (-90, 90), (-90, 90)),
        (997, (-180, 180), (-90, 90)),
        (50, (0, 90), (60, 90)),
    ],
)
def test_solid_cells_have_equal_area(count, azimuth_deg, elevation_deg):
    """Zones follow from the rows' counts; each row's centre halves its zone's area."""
    grid = direction_grid(
        Processing(directions=f"3d:{count}", azimuth_limits_deg=azimuth_deg, elevation_limits_deg=elevation_deg)
    )
    low, high = np.sin(np.radians(elevation_deg))
    centres, starts, in_row = np.unique(grid.elevation_rad, return_index=True, return_counts=True)
    edges = low + (high - low) * np.concatenate([[0], np.cumsum(in_row)]) / count
    assert_allclose(np.sin(centres), (edges[:-1] + edges[1:]) / 2, atol=1e-12)
    width_rad = np.radians(azimuth_deg[1] - azimuth_deg[0]) / in_row
    assert_allclose(np.diff(edges) * width_rad, (high - low) * np.radians(np.ptp(azimuth_deg)) / count, rtol=1e-9)
    for start, cells, width in zip(starts, in_row, width_rad, strict=True):
        row = grid.azimuth_rad[start : start + cells]
        assert_allclose(row, np.radians(azimuth_deg[0]) + width * (np.arange(cells) + 0.5), atol=1e-12)


@pytest.mark.parametrize("name", ["1850", "3000"])
def test_solid_grids_cover_evenly(name):
    """No direction within the limits is much further from the grid than the corner of a square cell."""
    grid = direction_grid(Processing(directions=name))
    _, azimuth_deg, elevation_deg = PAPER_GRIDS[name]
    random = np.random.default_rng(1)
    azimuth_rad = np.radians(random.uniform(*azimuth_deg, 20_000))
    elevation_rad = np.arcsin(random.uniform(*np.sin(np.radians(elevation_deg)), 20_000))
    points = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    distance, nearest = cKDTree(points).query(unit_vectors(azimuth_rad, elevation_rad))
    area = np.radians(np.ptp(azimuth_deg)) * np.ptp(np.sin(np.radians(elevation_deg))) / len(grid)
    assert distance.max() < 1.5 * np.sqrt(area / 2)
    hits = np.bincount(nearest, minlength=len(grid))
    assert 0.7 < np.var(hits) / np.mean(hits) < 1.5  # as random hits on equal areas scatter: Poisson


def test_grid_of_one_azimuth_repeats_no_direction():
    grid = direction_grid(
        Processing(directions="3d:10", azimuth_limits_deg=(0.0, 0.0), elevation_limits_deg=(-45.0, 45.0))
    )
    assert len(np.unique(grid.elevation_rad)) == 10


def test_grid_is_read_from_csv(tmp_path):
    path = tmp_path / "grid.csv"
    path.write_text("# azimuth, elevation\n-30, 0\n0, 45.5\n")
    grid = direction_grid(Processing(directions=str(path)))
    assert_allclose(np.degrees(grid.azimuth_rad), [-30, 0])
    assert_allclose(np.degrees(grid.elevation_rad), [0, 45.5])


@pytest.mark.parametrize(
    ("directions", "text", "message"),
    [
        ("91", None, r"directions '91' is not a grid; use 90, 1850, 3000, 2d:N, 3d:N or a \.csv file"),
        ("4d:90", None, r"directions '4d:90' is not a grid"),
        ("2d:", None, r"directions '2d:' has no count; use a number after the colon, such as 2d:181"),
        ("3d:-1", None, r"directions '3d:-1' has no count; use a number after the colon, such as 3d:181"),
        ("2d:0", None, r"count of directions '2d:0' is 0; use a whole number from 1 to 1000000"),
        ("3d:1000001", None, r"count of directions '3d:1000001' is 1000001; use a whole number from 1 to 1000000"),
        ("none.csv", None, r"directions .*none\.csv: .*; choose a readable CSV of azimuth, elevation in degrees"),
        (
            "g.csv",
            "",
            r"directions .*g\.csv does not have two numbers in every row; write azimuth, elevation in degrees",
        ),
        ("g.csv", "1, 2, 3\n", r"directions .*g\.csv does not have two numbers in every row"),
        ("g.csv", "1, two\n", r"directions .*g\.csv: could not convert .*; pass rows of numbers"),
        ("g.csv", "1, nan\n", r"directions .*g\.csv holds nan at \[0, 1\]; pass finite numbers"),
        ("g.csv", "1, 2\n0, 91\n", r"directions .*g\.csv: elevation in row 1 is 91; use a number from -90 to 90"),
        ("g.csv", "999, 2\n", r"directions .*g\.csv: azimuth in row 0 is 999; use a number from -360 to 360"),
    ],
)
def test_bad_grids_are_refused(tmp_path, directions, text, message):
    if text is not None:
        (tmp_path / directions).write_text(text)
    path = str(tmp_path / directions) if directions.endswith(".csv") else directions
    with pytest.raises(ArgumentError, match=message):
        direction_grid(Processing(directions=path))


# ---- directions and delays -------------------------------------------------------------------------


@given(st.floats(-np.pi, np.pi), st.floats(-np.pi / 2, np.pi / 2))
def test_unit_vectors_convert_back_to_angles(azimuth_rad, elevation_rad):
    x, y, z = unit_vectors(np.array(azimuth_rad), np.array(elevation_rad))
    assert x**2 + y**2 + z**2 == pytest.approx(1)
    assert np.arcsin(np.clip(z, -1, 1)) == pytest.approx(elevation_rad, abs=1e-7)
    if np.cos(elevation_rad) > 1e-6:
        assert np.cos(np.arctan2(y, x) - azimuth_rad) == pytest.approx(1)


def test_sensor_frame_has_the_documented_axes():
    right = np.pi / 2
    axes = unit_vectors(np.array([0, right, 0]), np.array([0, 0, right]))
    assert_allclose(axes, np.eye(3), atol=1e-15)  # forward is x, azimuth 90° is y, elevation 90° is z


def test_microphone_nearest_the_source_receives_first():
    positions_m = np.array([[0, 0.1, 0], [0, -0.1, 0]])
    delays_s = far_field_delays(positions_m, unit_vectors(np.array([np.pi / 2]), np.zeros(1)), sound_speed_m_s=340.0)
    assert_allclose(delays_s, [[-0.1 / 340, 0.1 / 340]])


def test_spherical_delays_approach_plane_delays_with_distance():
    """The difference falls as p² / 2 r c, the curvature of the wavefront over the array."""
    positions_m = load_layout("eRTIS_v3D1").positions_m
    grid = direction_grid(Processing(directions="3d:100"))
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    plane_s = far_field_delays(positions_m, directions, sound_speed_m_s=343.0)
    across_m2 = np.sum(positions_m**2, axis=1) - (directions @ positions_m.T) ** 2
    for range_m in (1.0, 10.0, 1000.0):
        bent_s = spherical_delays(positions_m, directions, range_m=range_m, sound_speed_m_s=343.0) - plane_s
        assert_allclose(bent_s, across_m2 / (2 * range_m * 343.0), atol=2e-7 / range_m**2 + 1e-14)


def test_spherical_delays_are_finite_at_origin_and_microphones():
    positions_m = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0]])
    ahead = unit_vectors(np.zeros(1), np.zeros(1))
    at_origin = spherical_delays(positions_m, ahead, range_m=0.0, sound_speed_m_s=300.0)
    assert_allclose(at_origin, [[0, 1e-4]])
    on_microphone = spherical_delays(positions_m, ahead, range_m=0.03, sound_speed_m_s=300.0)
    assert_allclose(on_microphone, [[0, -1e-4]], atol=1e-15)


def test_grid_spacing_is_correct():
    for name, spacing_deg in (("2d:91", 2.0), ("2d:1", 180.0)):
        grid = direction_grid(Processing(directions=name))
        assert np.degrees(spacing_rad(unit_vectors(grid.azimuth_rad, grid.elevation_rad))) == pytest.approx(spacing_deg)


@pytest.mark.parametrize("name", ["2d:7", "3d:10", "3d:500", "3d:4000", "3d:1"])
def test_azimuth_columns_contain_nearby_directions(name):
    grid = direction_grid(Processing(directions=name))
    shuffled = np.random.default_rng(1).permutation(len(grid))
    azimuth_rad, elevation_rad = grid.azimuth_rad[shuffled], grid.elevation_rad[shuffled]
    spacing = spacing_rad(unit_vectors(azimuth_rad, elevation_rad))
    columns = azimuth_columns(azimuth_rad, elevation_rad)
    assert (np.diff(columns.azimuth_rad) > 0).all()
    shown = columns.strongest(np.eye(len(grid), dtype=np.float32))  # each direction by itself
    for direction in range(len(grid)):
        at = columns.azimuth_rad[shown[:, direction] > 0]
        assert np.abs(at - azimuth_rad[direction]).max() <= (0 if name == "2d:7" else spacing / 2 + 1e-9)
        inner = np.abs(azimuth_rad[direction]) < np.abs(azimuth_rad).max() - spacing
        assert not inner or len(at) < 3 or abs(at.mean() - azimuth_rad[direction]) <= spacing / 8 + 1e-9
        assert np.abs(at - azimuth_rad[direction]).min() <= spacing / 8 + 1e-9


def test_azimuth_columns_of_few_directions_are_their_azimuths():
    azimuth_rad, elevation_rad = np.radians([[-45.0, 45.0, 0.0], [-19.0, -19.0, 41.0]])
    columns = azimuth_columns(azimuth_rad, elevation_rad)
    assert_allclose(np.degrees(columns.azimuth_rad), [-45.0, 0.0, 45.0])
    assert columns.strongest(np.array([1.0, 2.0, 3.0])).tolist() == [1.0, 3.0, 2.0]


@pytest.mark.parametrize(
    ("gaps_deg", "wanted_deg"),
    [
        ([], []),
        ([5], [1]),
        ([2, 2, 2], [2.6, 2.6, 2.6]),
        ([30, 30, 30], [39, 39, 39]),
        ([2, 2, 20, 2, 2], [2.6, 10, 2.6, 10, 2.6]),
        ([6, 6, 1, 1, 1], [7.8, 7.8, 7.8, 1.3, 1.3]),
        ([9, 9, 2, 2, 2, 2, 2, 9, 9], [10, 10, 10, 2.6, 2.6, 2.6, 10, 10, 10]),
    ],
    ids=["none", "one", "even", "even and wide", "gap", "coarser part", "coarser by far"],
)
def test_image_extends_to_the_usual_spacing_of_directions(gaps_deg, wanted_deg):
    """The limit is 1.3 times the spacing, and 10° at most."""
    assert_allclose(np.degrees(reach_rad(np.radians(gaps_deg))), wanted_deg)


@pytest.mark.parametrize(
    ("azimuth_deg", "wanted"),
    [
        (np.arange(-180, 180, 2), True),
        (np.linspace(-180, 180, 181), False),  # the last is the first
        (np.arange(0, 357, 3), False),
        (3.1 * np.arange(116), True),
        ([0, 120, 240], True),
        ([0, 180], False),
        (np.linspace(-90, 90, 37), False),
        ([*range(-173, -30, 10), *range(-27, 30, 2), *range(33, 174, 10)], True),
        ([*range(-173, -30, 10), *range(-27, 30, 2), *range(33, 164, 10)], False),
    ],
    ids=["even", "turn", "one missing", "a little more", "three", "two", "ahead", "finer ahead", "finer, one missing"],
)
def test_full_circle_is_recognised_by_its_largest_gap(azimuth_deg, wanted):
    assert is_closed(np.radians(azimuth_deg)) == wanted


def fan(azimuth_deg, range_m=(0.5, 5.0)):
    azimuth_rad = np.radians(np.asarray(azimuth_deg, float))
    return Fan.of(azimuth_rad, np.zeros(len(azimuth_rad)), np.asarray(range_m))


@pytest.mark.parametrize(
    ("azimuth_deg", "wanted_m"),
    [
        (np.linspace(-90, 90, 37), (-5, 5, 0, 5)),
        (np.arange(-180, 180, 5), (-5, 5, -5, 5)),
        (np.linspace(0, 90, 19), (-5, 0, 0, 5)),
        ([30.0], (-5 * np.sin(np.radians(31)), 0, 0, 5 * np.cos(np.radians(29)))),
    ],
    ids=["half disc", "circle", "left", "one direction"],
)
def test_fan_extent_includes_sensor_and_arc(azimuth_deg, wanted_m):
    assert fan(azimuth_deg).extent_m() == pytest.approx(wanted_m, abs=0.01)


@pytest.mark.parametrize(
    ("range_m", "wanted_m"),
    [
        ((0.5, 5.0), [1, 2, 3, 4, 5]),
        ((0.0, 0.3), [0.05, 0.1, 0.15, 0.2, 0.25, 0.3]),
        ((3.0, 3.004), [3, 3.001, 3.002]),
        ((1.0, 1.0), [1]),
    ],
)
def test_fan_has_rings_at_round_ranges(range_m, wanted_m):
    rings_m = fan([-10, 0, 10], range_m).rings_m(range_m[0], largest=6, spare_m=1e-6)
    assert rings_m[: len(wanted_m)] == pytest.approx(wanted_m)


def test_fan_finds_directions_and_gaps():
    right_m, ahead_m = plan_m(np.radians([-30.0, -29.5, 0.0, 12.5, 30.0, 40.0]), 2.0)
    place, near = fan([*range(-30, -9, 5), *range(10, 31, 5)]).directions(right_m, ahead_m)
    assert near.tolist() == [True, True, False, True, True, False]
    assert place[near] == pytest.approx([0, 0.1, 5.5, 9])


def test_fan_of_a_full_circle_has_each_ray_once():
    assert fan(np.arange(0, 360, 2)).rays_deg() == [*range(-150, 181, 30)]


def test_named_grid_has_the_limits_of_named_directions_only():
    assert named_grid(Processing(directions="1850")) == ("3d", (-45.0, 45.0), (-45.0, 45.0))
    assert named_grid(Processing(directions="grid.csv")) is None

"""Occupancy maps as map_server and the static layer of Nav2 read them."""

import itertools

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError

yaml = pytest.importorskip("yaml")  # a requirement of the extra cluster

TIME_NS = 1_700_000_000_000_000_000
FREE, LETHAL, NO_INFORMATION = 0, 254, 255  # costs of nav2_costmap_2d
LOG_ODDS = np.array([
    # free, barely free, barely not free, decayed
    [-4.0, -1.42, -1.40, -1e-6],
    # unknown, weakly occupied, barely not occupied, barely occupied
    [0.0, 0.4, 0.61, 0.63],
    # occupied, and a row that no flip of the picture maps to itself
    [4.0, 50.0, 0.0, -50.0],
])  # fmt: skip
TRINARY = [[0, 0, -1, -1], [-1, -1, -1, 100], [100, 100, -1, 0]]
PERCENT = [[2, 19, 20, 50], [-1, 60, 65, 65], [98, 100, -1, 0]]
UTM_M = (458_071.15, 5_429_375.5)


def asymmetric(origin_m=(-1.0, 2.0), cell_m=0.5):
    return ertis.OccupancyMap(LOG_ODDS, origin_m, cell_m, n_groups=7, time_ns=TIME_NS)


def map_server(path, **changes):
    """Return the message that map_server publishes: values by row from below, origin and resolution."""
    stated = yaml.safe_load(path.read_text("utf-8")) | changes
    assert all(isinstance(each, float) for each in (stated["resolution"], *stated["origin"]))
    head, size, highest, pixels = (path.parent / stated["image"]).read_bytes().split(b"\n", 3)
    assert (head, highest) == (b"P5", b"255")
    n_columns, n_rows = map(int, size.split())
    shade = np.frombuffer(pixels, np.uint8).reshape(n_rows, n_columns)[::-1] / 255
    share = shade if stated["negate"] else 1 - shade
    occupied, free = share > stated["occupied_thresh"], share < stated["free_thresh"]
    if stated["mode"] == "raw":
        raw = np.round(shade * 255)
        values = np.where(raw <= 100, raw, -1)
    else:
        between = np.full(share.shape, -1.0)
        if stated["mode"] == "scale":
            width = stated["occupied_thresh"] - stated["free_thresh"]
            between = np.rint(100 * (share - stated["free_thresh"]) / width)
        values = np.where(occupied, 100, np.where(free, 0, between))
    return values.astype(int), stated["origin"], stated["resolution"]


def recorded(path):
    """Return the message in a file: values by row, origin and resolution."""
    reader = pytest.importorskip("mcap_ros2.reader")
    (message,) = reader.read_ros2_messages(path)
    assert message.channel.topic == "/map"
    grid = message.ros_msg
    assert (grid.header.frame_id, grid.header.stamp.sec) == ("map", TIME_NS // 10**9)
    place, turn = grid.info.origin.position, grid.info.origin.orientation
    assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0)
    values = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    return values, [place.x, place.y, place.z], grid.info.resolution


def static_layer(values, *, threshold=100, is_trinary=True, tracks_unknown=True):
    """Return the costs that the static layer of Nav2 derives from the values of a map."""
    scaled = (values / threshold * LETHAL).astype(int)
    known = np.where(values >= threshold, LETHAL, FREE if is_trinary else scaled)
    return np.where(values == -1, NO_INFORMATION if tracks_unknown else FREE, known)


@pytest.mark.parametrize("suffix", ["mcap", "pgm"])
@pytest.mark.parametrize("origin_m", [(-1.0, 2.0), UTM_M, (1e-5, -1e-7)])
def test_maps_for_ros_have_the_values_and_the_place_of_their_cells(tmp_path, suffix, origin_m):
    occupancy = asymmetric(origin_m, cell_m=0.05)
    (path, *others) = ertis.write_map(tmp_path / f"m.{suffix}", occupancy)
    values, origin, cell_m = recorded(path) if suffix == "mcap" else map_server(*others)
    assert values.tolist() == TRINARY
    assert origin == [*origin_m, 0.0]
    assert cell_m == pytest.approx(0.05, rel=1e-7)
    costs = static_layer(values)
    assert np.array_equal(costs == LETHAL, occupancy.is_occupied)
    assert np.array_equal(costs == FREE, occupancy.is_free)
    rows, columns = np.nonzero(costs == LETHAL)
    places_m = np.stack([columns, rows], axis=1) * cell_m + np.array(origin[:2]) + cell_m / 2
    assert np.abs(places_m - occupancy.occupied_m).max() < 1e-6


@pytest.mark.parametrize("free_thresh", [0.196, 0.25])
def test_picture_of_a_map_has_the_same_cells_for_the_thresholds_of_all_versions(tmp_path, free_thresh):
    _, path = ertis.write_map(tmp_path / "m.pgm", asymmetric())
    assert map_server(path, free_thresh=free_thresh)[0].tolist() == TRINARY


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_picture_of_a_map_shows_no_unknown_cell_as_free(tmp_path, mode):
    """In the mode scale, only transparent pixels are unknown, which PGM does not have."""
    _, path = ertis.write_map(tmp_path / "m.pgm", asymmetric())
    values, *_ = map_server(path, mode=mode)
    known = np.array(TRINARY) != -1
    assert values[known].tolist() == np.array(TRINARY)[known].tolist()
    assert (values[~known] != 0).all()


@pytest.mark.parametrize("suffix", ["mcap", "pgm"])
def test_maps_for_ros_have_probabilities_if_asked(tmp_path, suffix):
    (path, *others) = ertis.write_map(tmp_path / f"m.{suffix}", asymmetric(), probabilities=True)
    values, *_ = recorded(path) if suffix == "mcap" else map_server(*others)
    assert values.tolist() == PERCENT
    costs = static_layer(values, threshold=65, is_trinary=False)
    assert (costs[asymmetric().is_occupied] == LETHAL).all()
    assert (costs[LOG_ODDS == 0] == NO_INFORMATION).all()


def test_cells_of_maps_for_ros_follow_the_map_for_all_log_odds(tmp_path):
    pytest.importorskip("mcap_ros2")
    occupancy = ertis.OccupancyMap(np.linspace(-5, 5, 2003).reshape(1, -1), (0.0, 0.0), 0.05, time_ns=TIME_NS)
    _, description = ertis.write_map(tmp_path / "m.pgm", occupancy)
    (message,) = ertis.write_map(tmp_path / "m.mcap", occupancy)
    for values, *_ in (map_server(description), recorded(message)):
        for tracks_unknown, is_trinary in itertools.product((False, True), repeat=2):
            costs = static_layer(values, tracks_unknown=tracks_unknown, is_trinary=is_trinary)
            assert np.array_equal(costs == LETHAL, occupancy.is_occupied)
        assert np.array_equal(values == 0, occupancy.is_free)


@pytest.mark.parametrize("suffix", ["h5", "ply"])
def test_probabilities_are_an_option_of_maps_for_ros_only(tmp_path, suffix):
    with pytest.raises(ArgumentError, match=r"holds probabilities in any case; leave out probabilities, or choose a"):
        ertis.write_map(tmp_path / f"m.{suffix}", asymmetric(), probabilities=True)
    assert not any(tmp_path.iterdir())

"""The scene in three dimensions: camera, labels on the ground, and fading of points."""

from types import SimpleNamespace

import numpy as np
import pytest

from ertis_numba.geometry import round_step
from ertis_numba.viewer import Choices, Pose, Viewer
from tests.views import Source, acked_through, spot, taken

PLACES = {"left": Pose((0.0, 3.0, 0.0)), "front": Pose((2.0, 0.0, 0.0)), "right": Pose((0.0, -1.0, 0.0))}


def of(name):
    return taken(spot(0, 2.0, sensor=name), PLACES[name], 100.0, 1.0)


def ground(view):
    """Position and target of the camera, and the labelled distances on the ground."""
    space = view._page._space  # noqa: SLF001
    camera = space._server.initial_camera  # noqa: SLF001
    names = [label.text for label in space._labels]  # noqa: SLF001
    return np.concatenate([camera.position, camera.look_at]).tolist(), names


def joined(*groups, **choices):
    """Ground after sensors have joined in groups."""
    source = Source()
    with Viewer(source, port=0, choices=Choices(**choices)) as view:
        for group in groups:
            source.waiting = [of(name) for name in group]
            acked_through(view)
        return ground(view)


def test_camera_does_not_depend_on_the_order_of_sensors():
    wanted = joined(list(PLACES))
    assert wanted == joined(["left"], ["front"], ["right"]) == joined(["right"], ["left", "front"])
    assert wanted != joined(["left"])
    assert joined(["left"])[1] == ["1 m", "2 m", "3 m", "4 m", "5 m"]
    assert wanted[1] == ["2 m", "3 m", "4 m", "5 m"]


@pytest.mark.parametrize("names", [["front"], list(PLACES)])
def test_widened_window_moves_the_camera(names):
    source = Source()
    with Viewer(source, port=0, choices=Choices(range_m=(0.6, 1.0))) as view:
        source.waiting = [of(name) for name in names]
        acked_through(view)
        narrow, distances = ground(view)
        assert distances == ["0.2 m", "0.4 m", "0.6 m", "0.8 m", "1 m"][len(names) > 1 :]
        view.choices, view._changed = Choices(), True  # noqa: SLF001  as if somebody moved the slider
        acked_through(view)
        assert ground(view) == joined(names)
        assert ground(view)[0][2] > 4 * narrow[2]
        view.choices, view._changed = Choices(range_m=(0.6, 1.0)), True  # noqa: SLF001
        acked_through(view)
        assert ground(view) == joined(names)  # who looks closer goes there


def test_moved_camera_stays():
    source = Source()

    def client():
        return SimpleNamespace(camera=SimpleNamespace(position=np.ones(3), look_at=np.zeros(3)))

    mine, other = client(), client()
    with Viewer(source, port=0) as view:
        server = view._page._server  # noqa: SLF001
        server.get_clients = lambda: {0: mine, 1: other}
        source.waiting = [of("left")]
        acked_through(view)
        first = np.asarray(mine.camera.position)
        assert first.tolist() == np.asarray(other.camera.position).tolist() == ground(view)[0][:3]
        other.camera.position = (9.0, 9.0, 9.0)
        source.waiting = [of("front")]
        acked_through(view)
        assert [*mine.camera.position, *mine.camera.look_at] == ground(view)[0]
        assert np.asarray(mine.camera.position).tolist() != first.tolist()
        assert other.camera.position == (9.0, 9.0, 9.0)


def test_fading_points_become_small():
    source = Source()
    source.waiting = [taken(spot(0, 2.0), time_s=100.0)]
    with Viewer(source, port=0, choices=Choices(decay_s=1.0)) as view:
        sizes = []
        for clock_s in (100.0, 100.4, 100.6, 100.9, 101.0):
            source.clock_s = clock_s
            acked_through(view)
            clouds = view._page._space._nodes["front"]._points  # noqa: SLF001
            seen = [cloud for cloud in clouds if cloud.visible]
            assert sum(len(cloud.points) for cloud in seen) == (clock_s < 101)
            sizes += [cloud.point_size for cloud in seen]
    assert sizes == pytest.approx([0.06, 0.045, 0.03, 0.018])


def test_overdue_sensor_hides_no_other_points():
    source = Source()
    with Viewer(source, port=0) as view:
        source.waiting = [of("left")]
        acked_through(view)
        node = view._page._space._nodes["left"]  # noqa: SLF001
        timely_m = node._shape.position[2]  # noqa: SLF001
        source.clock_s = 110.0
        acked_through(view)
        assert node._shape.position[2] < timely_m < 0  # noqa: SLF001


@pytest.mark.parametrize(
    ("scale", "distances"),
    [
        (0.01, ["0.01 m", "0.02 m", "0.03 m", "0.04 m", "0.05 m"]),
        (1, ["1 m", "2 m", "3 m", "4 m", "5 m"]),
        (3.4, ["5 m", "10 m", "15 m", "20 m"]),
        (260, ["200 m", "400 m", "600 m", "800 m", "1000 m", "1200 m", "1400 m"]),
    ],
)
def test_the_ground_suits_the_range(scale, distances):
    source = Source()
    made = spot(0, 2.0)
    with Viewer(source, port=0) as view:
        source.waiting = [taken(made.replace(range_m=made.range_m * scale))]
        acked_through(view)
        space = view._page._space  # noqa: SLF001
        camera, (node,) = space._server.initial_camera, space._nodes.values()  # noqa: SLF001
        assert ground(view)[1] == distances
        assert space._grid.section_size == 2 * space._grid.cell_size == pytest.approx(float(distances[0].split()[0]))  # noqa: SLF001
        away_m = np.linalg.norm(camera.position - camera.look_at)
        assert 100 * camera.near < away_m < camera.far / 10
        assert node._frame.axes_length == pytest.approx(0.12 * scale)  # noqa: SLF001


def test_grid_steps_are_round():
    assert [round_step(length, 7) for length in (7, 7.01, 0.7, 14, 35, 36)] == pytest.approx([1, 2, 0.1, 2, 5, 10])

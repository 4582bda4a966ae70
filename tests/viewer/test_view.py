"""Content of the live view without a browser: pictures, points and fusion."""

import io
import itertools
import math
from dataclasses import replace

import numpy as np
import plyfile
import pytest
from PIL import Image

from ertis_numba.analysis.side_lobes import without_side_lobes
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import Fan, direction_grid
from ertis_numba.settings import Call, Processing
from ertis_numba.viewer import COLOURS, Choices, Dome, Polar, Pose, ReceivedImage, Sector, ViewedScene, _axes
from ertis_numba.viewer._axes import PAGE
from ertis_numba.viewer._choices import colour_table
from ertis_numba.viewer._polar import cropped
from ertis_numba.viewer._saving import picture_png, points_ply
from tests.files import image
from tests.views import TABLE, brightest, spot, taken

TURNED = Pose((1.0, 2.0, 0.5), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))  # to the left


def solid():
    grid = direction_grid(Processing(directions="3d:300"))
    return image(np.degrees(grid.azimuth_rad), np.degrees(grid.elevation_rad))


IMAGES = {
    "half disc": image(),
    "narrow": image(np.linspace(-20, 20, 9)),
    "full circle": image(np.linspace(-180, 180, 73)),
    "unsorted": image([40.0, -10.0, 0.0, 25.0]),
    "one direction": image([12.0]),
    "hemisphere": solid(),
    "from the sensor on": image(range_m=np.linspace(0.0, 0.3, 50)),
    "far": image(range_m=np.linspace(2.0, 3.0, 200)),
    "many ranges": image(range_m=np.linspace(0.2, 40.0, 4001)),
    "one range": image(range_m=[1.0]),
}


@pytest.mark.parametrize("name", IMAGES)
def test_every_kind_of_axes_is_drawn(name):
    polar = Polar(IMAGES[name])
    picture = polar.picture(polar.levels(IMAGES[name].amplitude), TABLE)
    assert picture.shape == (*polar.shape, 3)
    assert (picture == TABLE[255]).all(axis=2).sum() >= (1 if name == "many ranges" else 4)
    assert polar.levels(np.zeros_like(IMAGES[name].amplitude)).max() == 0
    assert (picture[[0, -1]] == PAGE).all()


@pytest.mark.parametrize("place", [(7.0, 2.2), (-38.0, 1.15), (61.5, 3.333), (-80.0, 4.7)])
@pytest.mark.parametrize("window_m", [None, (1.0, 4.8)])
def test_reflector_is_drawn_at_its_position(place, window_m):
    made = cropped(spot(*place), window_m)
    polar = Polar(made)
    x, y = brightest(polar.picture(polar.levels(made.amplitude), TABLE)[:-66])
    azimuth_deg, range_m = polar.place_of(x, y)
    assert azimuth_deg == pytest.approx(place[0], abs=0.8)
    assert range_m == pytest.approx(place[1], abs=0.015)
    assert polar.pixel_of(azimuth_deg, range_m) == pytest.approx((x, y))


def test_rings_and_rays_match_their_labels():
    polar = Polar(image())
    lit = (polar.picture(np.zeros((37, 400), np.uint8), TABLE) != TABLE[0]).any(axis=2)

    def is_lit(azimuth_deg, range_m):
        x, y = polar.pixel_of(azimuth_deg, range_m)
        return lit[int(y), int(x)]

    for azimuth_deg in (-75, -50, -10, 20, 70):
        assert [is_lit(azimuth_deg, range_m) for range_m in (1, 1.5, 2, 2.5, 3, 3.5, 4)] == [True, False] * 3 + [True]
    for range_m in (1.3, 2.6, 3.4):
        assert [is_lit(ray, range_m) for ray in (-60, -45, -30, -15, 0, 15, 30, 45, 60)] == [True, False] * 4 + [True]


@pytest.mark.parametrize("half_deg", [5, 45, 60, 90, 135, 180])
@pytest.mark.parametrize("range_m", [(0.0, 0.3), (0.5, 5.0), (2.0, 2.5), (3.0, 3.004), (4.9995, 5.0), (12.0, 12.0006)])
def test_labels_do_not_overlap(half_deg, range_m, monkeypatch):
    drawn = []
    monkeypatch.setattr(_axes, "ink_of", drawn.append)
    fan = Fan.of(np.radians([-half_deg, 0, half_deg]), np.zeros(3), np.array(range_m))
    place = _axes.Place.of(fan, 640)
    _axes.draw_axes(place, fan, 40.0)
    names = [text for text in drawn[0].axes[0].texts if text.get_text()]
    assert sum(text.get_text().endswith(" m") for text in names) >= 1
    boxes = [text.get_window_extent() for text in names]
    for one, other in itertools.combinations(range(len(boxes)), 2):
        assert not boxes[one].overlaps(boxes[other]), (names[one].get_text(), names[other].get_text())
    assert all(box.x0 >= 0 and box.x1 <= place.width_px for box in boxes)


def test_levels_are_relative_to_the_strongest():
    made = spot(0, 2.0)
    levels = Polar(made, dynamic_range_db=40).levels(made.amplitude)
    half = made.replace(amplitude=np.where(made.amplitude == made.amplitude.max(), made.amplitude, made.amplitude / 10))
    assert levels.max() == 255
    there = Polar(half, dynamic_range_db=40).levels(half.amplitude)
    seen = (levels > 140) & (levels < 255)
    np.testing.assert_allclose(levels[seen].astype(int) - there[seen], 255 * 20 / 40, atol=1)


def test_window_outside_the_image_shows_its_end():
    assert len(cropped(image(), (7.0, 9.0)).range_m) == 1
    assert cropped(image(), (0.0, 9.0)).range_m is image().range_m or len(cropped(image(), (0.0, 9.0)).range_m) == 400


def test_points_follow_threshold_and_window():
    scene = ViewedScene()
    made = spot(-40, 1.5)
    weak = spot(30, 3.0, level=0.5 * 10 ** (-15 / 20))
    scene.take(taken(made.replace(amplitude=np.maximum(made.amplitude, weak.amplitude)), TURNED))

    def points(**choices):
        drawn = scene.draw(Choices(**choices)).sensors["front"]
        assert len(drawn.position_m) == len(drawn.colours) == drawn.n_points
        return drawn.position_m

    strong, faint = points(threshold_db=-18)
    for place, (azimuth_deg, range_m) in ((strong, (-40, 1.5)), (faint, (30, 3.0))):
        angle = math.radians(azimuth_deg + 90)  # as the sensor is turned
        wanted = (1 + range_m * math.cos(angle), 2 + range_m * math.sin(angle), 0.5)
        np.testing.assert_allclose(place, wanted, atol=0.02)
    assert len(points(threshold_db=-10)) == 1
    np.testing.assert_array_equal(points(range_m=(2.0, 4.0), threshold_db=-5), [faint])
    assert len(points(threshold_db=-60)) > 2


def test_points_persist_and_fade():
    scene = ViewedScene()
    for number in range(4):
        scene.take(taken(spot(10 * number, 2.0), time_s=0.1 * number))
    latest = scene.draw(Choices()).sensors["front"]
    assert (len(latest.position_m), latest.n_points) == (1, 1)
    fading = scene.draw(Choices(decay_s=0.25)).sensors["front"]
    assert (len(fading.position_m), fading.n_points) == (3, 1)
    np.testing.assert_allclose(fading.share_left, [0.2, 0.6, 1.0], atol=0.02)
    assert len(np.unique(fading.colours, axis=0)) == 1  # a point that was dark would hide what it lies on
    scene.take(taken(spot(50, 2.0), time_s=0.1))  # the film begins anew
    assert len(scene.draw(Choices(decay_s=10)).sensors["front"].position_m) == 2


def test_images_of_two_sensors_are_combined():
    scene = ViewedScene()
    left = Pose((0.0, 1.0, 0.3))
    right = Pose((0.0, -1.0, 0.3), (0.0, 0.0, math.sin(math.radians(15)), math.cos(math.radians(15))))
    for name, pose, turned_deg in (("left", left, 0), ("right", right, 30)):
        x, y = 2.0 - pose.translation_m[0], 0.4 - pose.translation_m[1]
        scene.take(taken(spot(math.degrees(math.atan2(y, x)) - turned_deg, math.hypot(x, y), sensor=name), pose))
    frame = scene.draw(Choices())
    assert frame.height_m == 0.3
    assert all(drawn.shape is None for drawn in frame.sensors.values())
    west, east, low, high = frame.fused.extent_m
    rows, columns, _ = frame.fused.colours.shape
    x, y = brightest(frame.fused.colours[..., :3])
    assert (high - y / rows * (high - low), -(west + x / columns * (east - west))) == pytest.approx(
        (2.0, 0.4), abs=0.04
    )
    scene.take(taken(spot(0, 2.0, sensor="right"), replace(right, rotation_xyzw=(0.0, 0.1, 0.0, math.sqrt(0.99)))))
    tilted = scene.draw(Choices())
    assert tilted.fused is None
    assert all(isinstance(drawn.shape, Sector) for drawn in tilted.sensors.values())


@pytest.mark.parametrize("threshold_db", [-20.0, -3.0])
def test_image_with_elevations_is_drawn_as_a_dome(threshold_db):
    scene = ViewedScene()
    speckle = solid()
    made = speckle.replace(amplitude=speckle.amplitude + np.float32(0.1))
    scene.take(taken(made))
    frame = scene.draw(Choices(colours="viridis", threshold_db=threshold_db))
    (drawn,) = frame.sensors.values()
    assert isinstance(drawn.shape, Dome)
    highest = without_side_lobes(made).amplitude.max(axis=1)
    seen = highest >= highest.max() * 10 ** (threshold_db / 20)
    assert 0 < np.count_nonzero(seen) <= len(seen)
    azimuth_rad = np.arctan2(drawn.shape.position_m[:, 1], drawn.shape.position_m[:, 0])
    np.testing.assert_allclose(azimuth_rad, made.azimuth_rad[seen], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(drawn.shape.position_m, axis=1), 5.0 / 4, rtol=1e-6)
    strongest = int(highest[seen].argmax())
    np.testing.assert_array_equal(drawn.shape.colours[strongest], colour_table("viridis")[255])


def test_colour_maps_rise_in_brightness():
    for name in COLOURS:
        luminance = colour_table(name) @ [0.2126, 0.7152, 0.0722]
        assert np.diff(luminance[::8]).min() > 0, name


def test_saved_files_contain_the_drawn_view():
    scene = ViewedScene()
    choices = Choices(threshold_db=-30, range_m=(0.8, 4.0))
    scene.take(taken(spot(-40, 1.5, timestamp_ns=1_700_000_000_123_000_000), TURNED))
    scene.take(taken(spot(20, 3.5, sensor="other"), Pose((0.0, 0.0, 0.1))))
    frame = scene.draw(choices)
    picture = np.asarray(Image.open(io.BytesIO(picture_png(frame))).convert("RGB"))
    last = frame.sensors["other"].picture
    np.testing.assert_array_equal(picture[-last.shape[0] :, : last.shape[1]], last)
    assert len(picture) > sum(each.picture.shape[0] for each in frame.sensors.values())
    vertex = plyfile.PlyData.read(io.BytesIO(points_ply(scene.latest(choices))))["vertex"]
    stored = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    drawn = np.concatenate([each.position_m for each in frame.sensors.values()])
    np.testing.assert_allclose(stored, drawn, atol=1e-5)


def test_saved_points_are_the_drawn_points():
    """This includes maxima beyond the window and between directions."""
    rng = np.random.default_rng(5)
    noisy = image(np.linspace(-90, 90, 91))
    places = (11.3, 1.507), (-41.7, 2.263), (37.2, 3.11), (-15.5, 3.737), (63.9, 1.222)
    amplitude = rng.rayleigh(0.005, noisy.amplitude.shape) + sum(spot(*place).amplitude for place in places)
    amplitude = amplitude.astype(np.float32)
    scene = ViewedScene()
    scene.take(taken(noisy.replace(amplitude=amplitude), TURNED))
    for choices in (Choices(threshold_db=-12), Choices(threshold_db=-18, range_m=(1.5, 4.0))):
        drawn = scene.draw(choices).sensors["sensor"]
        vertex = plyfile.PlyData.read(io.BytesIO(points_ply(scene.latest(choices))))["vertex"]
        stored = np.stack([vertex[axis] for axis in "xyz"], axis=1)
        assert len(stored) == drawn.n_points > 3
        np.testing.assert_allclose(stored, drawn.position_m, atol=1e-5)
        assert np.isfinite(vertex["uncertainty_range"]).all()


def test_points_have_the_uncertainty_of_their_own_call():
    """The call of a sensor may change from one image to the next."""
    first = spot(10, 1.5)
    wider = first.settings.replace(call=Call(start_frequency_hz=90e3, stop_frequency_hz=20e3))
    second = first.replace(settings=wider)
    scenes = ViewedScene(), ViewedScene()
    scenes[0].take(taken(first, TURNED))
    for scene in scenes:
        scene.take(taken(second, TURNED, time_s=1.0))
    (_, found, _), (_, wanted, _) = (scene.latest(Choices())[0] for scene in scenes)
    assert np.isfinite(wanted.uncertainty_m).all()
    np.testing.assert_array_equal(found.uncertainty_m, wanted.uncertainty_m)


def test_nothing_is_drawn_beyond_the_image():
    scene = ViewedScene()
    poses = {"a": Pose((0.0, 0.3, 0.0)), "b": Pose((0.0, -0.3, 0.0))}
    for name, pose in poses.items():
        scene.take(taken(spot(0, 2.0, sensor=name), pose))
    whole, beyond = scene.draw(Choices()), scene.draw(Choices(range_m=(100.0, 200.0)))
    assert beyond.fused is None
    assert beyond.range_m == whole.range_m == 5.0
    for name, drawn in beyond.sensors.items():
        assert (drawn.shape, drawn.n_points, len(drawn.position_m)) == (None, 0, 0)
        assert drawn.picture.shape == whole.sensors[name].picture.shape
        assert (drawn.picture == PAGE).all(axis=2).mean() > 0.95
        assert (drawn.picture != PAGE).any()  # it says why
    other = scene.draw(Choices(range_m=(300.0, 400.0))).sensors["a"].picture
    assert not np.array_equal(other, beyond.sensors["a"].picture)
    np.testing.assert_array_equal(scene.draw(Choices()).sensors["a"].picture, whole.sensors["a"].picture)


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"threshold_db": 3.0}, "threshold_db is 3; use a number from -60 to 0"),
        ({"dynamic_range_db": 5.0}, "dynamic_range_db is 5"),
        ({"range_m": (3.0, 1.0)}, "range_m runs from 3 to 1"),
        ({"decay_s": -1.0}, "decay_s is -1"),
        ({"colours": "jet"}, "colours 'jet' is unknown"),
    ],
)
def test_invalid_choices_are_refused(changes, reported):
    with pytest.raises(ArgumentError, match=reported):
        Choices(**changes)


def test_invalid_picture_sizes_are_refused():
    with pytest.raises(ArgumentError, match="width_px is 50; use at least"):
        Polar(image(), width_px=50)
    with pytest.raises(ArgumentError, match="the image ends at range 0"):
        Polar(image(range_m=[0.0]))


def seen(frame, name):
    drawn = frame.sensors[name]
    return len(drawn.position_m), drawn.overdue


def test_points_fade_with_time_instead_of_images():
    scene = ViewedScene()
    scene.take(taken(spot(0, 2.0), time_s=10.0))
    bright = scene.draw(Choices(decay_s=0.5), 10.0)
    dim = scene.draw(Choices(decay_s=0.5), 10.25)
    assert (bright.sensors["front"].share_left.tolist(), dim.sensors["front"].share_left.tolist()) == ([1.0], [0.5])
    assert dim.until_s <= 10.25  # it is not right for any longer
    gone = scene.draw(Choices(decay_s=0.5), 10.5)
    assert (len(gone.sensors["front"].position_m), gone.sensors["front"].n_points) == (0, 0)
    assert gone.until_s == 20.0  # when the sensor is overdue
    assert len(scene.draw(Choices(), 10.5).sensors["front"].position_m) == 1


@pytest.mark.parametrize(("interval_s", "due_s"), [(None, 10.0), (0.05, 1.0), (2.0, 6.0)])
def test_silent_sensor_is_overdue_after_its_typical_interval(interval_s, due_s):
    scene = ViewedScene()
    scene.take(taken(spot(0, 2.0), time_s=10.0, interval_s=interval_s))
    timely = scene.draw(Choices(), 10.0 + due_s - 0.01)
    assert (timely.sensors["front"].overdue, timely.until_s) == (False, 10.0 + due_s)
    late = scene.draw(Choices(), 10.0 + due_s)
    assert (late.sensors["front"].overdue, late.until_s) == (True, math.inf)
    before, after = timely.sensors["front"], late.sensors["front"]
    assert (before.picture == TABLE[255]).all(axis=2).any()
    assert not (after.picture == TABLE[255]).all(axis=2).any()
    assert after.picture.sum(dtype=int) < before.picture.sum(dtype=int)
    assert 2 * after.colours.astype(int).max() < before.colours.max()


def test_overdue_sensor_is_excluded_from_the_combined_image():
    scene = ViewedScene()
    places = {"front": Pose((0.3, 0.0, 0.0)), "left": Pose((0.0, 0.3, 0.0)), "right": Pose((0.0, -0.3, 0.0))}
    for name, pose in places.items():
        scene.take(taken(spot(0, 2.0, sensor=name), pose))
    whole = scene.draw(Choices())
    for name in ("front", "right"):
        scene.take(taken(spot(0, 2.0, sensor=name, level=1e-9), places[name], time_s=3600.0))
    frame = scene.draw(Choices())
    assert [seen(frame, name)[1] for name in sorted(places)] == [False, True, False]
    assert frame.fused is not None
    assert not np.array_equal(whole.fused.colours, frame.fused.colours)  # only of the two that are there
    assert [drawn.shape is None for _, drawn in sorted(frame.sensors.items())] == [True, False, True]
    assert frame.sensors["left"].shape.colours[..., :3].max() < 100
    scene.take(taken(spot(0, 2.0, sensor="right"), places["right"], time_s=7200.0))
    assert scene.draw(Choices()).fused is None  # of one alone
    scene.take(taken(spot(0, 2.0, sensor="left"), places["left"], time_s=7200.0))
    assert scene.draw(Choices()).fused is not None


def test_unchanged_view_is_not_drawn_again():
    scene = ViewedScene()
    for name in ("front", "left"):
        scene.take(taken(spot(0, 2.0, sensor=name)))
    choices = Choices(decay_s=1.0)
    first, second = scene.draw(choices, 0.1), scene.draw(choices, 0.2)
    assert first.fused is second.fused
    assert first.sensors["left"].picture is second.sensors["left"].picture
    assert first.sensors["front"].share_left.sum() > second.sensors["front"].share_left.sum()  # all fused points
    other = scene.draw(Choices(decay_s=1.0, colours="viridis"), 0.2)
    assert other.fused is not first.fused
    assert not np.array_equal(other.sensors["left"].picture, first.sensors["left"].picture)


def test_sensors_with_unknown_mounting_have_no_platform_view():
    scene = ViewedScene()
    scene.take(ReceivedImage(spot(-40, 1.5), None, 0.0))
    alone = scene.draw(Choices()).sensors["front"]
    assert (alone.pose, len(alone.position_m)) == (Pose(), 1)
    assert isinstance(alone.shape, Sector)
    comments = plyfile.PlyData.read(io.BytesIO(points_ply(scene.latest(Choices())))).comments
    assert "frame front" in comments
    scene.take(ReceivedImage(spot(20, 3.5, sensor="left"), None, 0.0))
    frame = scene.draw(Choices())
    assert frame.fused is None
    for drawn in frame.sensors.values():
        assert (drawn.pose, drawn.shape, len(drawn.position_m), drawn.n_points) == (None, None, 0, 1)
        assert (drawn.picture == TABLE[255]).all(axis=2).any()
    with pytest.raises(
        ArgumentError,
        match="the mountings of sensors front, left on their platform are unknown, but all points need one frame",
    ):
        points_ply(scene.latest(Choices()))

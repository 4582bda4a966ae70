"""What the live view draws, without a browser: pictures, points, what is fused, and what comes of a file or a node."""

import io
import json
import math
import re
import socket
import sys
import time
from dataclasses import replace

import numpy as np
import plyfile
import pytest
import viser
from click.testing import CliRunner
from ertis_cli.main import cli
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ertis_numba.errors import ArgumentError, NetworkError
from ertis_numba.frames import Stamp
from ertis_numba.geometry import direction_grid
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air, Processing
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from ertis_numba.viewer import COLOURS, Choices, Dome, Film, Live, Polar, Pose, Scene, Sector, Taken, View
from ertis_numba.viewer._axes import PAGE
from ertis_numba.viewer._choices import colour_table
from ertis_numba.viewer._page import Order
from ertis_numba.viewer._polar import cropped
from ertis_numba.viewer._saving import picture_png, points_ply
from tests.files import SMALL, image, noise
from tests.pages import ROOT, commands_in, run, run_here
from tests.publishing import Publisher
from tests.publishing import image as published

TABLE = colour_table("inferno")
TURNED = Pose((1.0, 2.0, 0.5), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))  # to the left
PATIENCE_S = 20.0


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


def spot(azimuth_deg, range_m, *, sensor="front", sequence=0, level=0.5, **stamp):
    """An image with one reflector, soft enough to lie between directions and ranges."""
    made = image(np.linspace(-90, 90, 91))
    across = (np.degrees(made.azimuth_rad) - azimuth_deg) / 4
    along = (made.range_m - range_m) / 0.03
    energy = made.energy * 0.01 + (level * np.exp(-0.5 * (across[:, None] ** 2 + along**2))).astype(np.float32)
    return made.replace(energy=energy.astype(np.float32), stamp=Stamp(sensor=sensor, sequence=sequence, **stamp))


def taken(made, pose=None, time_s=0.0):
    return Taken(made, pose or Pose(), time_s)


def brightest(picture):
    """The middle of the pixels of the highest level, but for those of the scale below: x, y."""
    away = np.abs(picture.astype(int) - TABLE[255].astype(int)).sum(axis=2)
    rows, columns = np.nonzero(away <= away.min() + 6)
    return columns.mean() + 0.5, rows.mean() + 0.5


def wait_for(reached):
    end_s = time.monotonic() + PATIENCE_S
    while not (found := reached()):
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0)
    return found


@pytest.mark.parametrize("name", IMAGES)
def test_pictures_of_all_kinds_of_axes(name):
    polar = Polar(IMAGES[name])
    picture = polar.picture(polar.levels(IMAGES[name].energy), TABLE)
    assert picture.shape == (*polar.shape, 3)
    assert (picture == TABLE[255]).all(axis=2).sum() >= (1 if name == "many ranges" else 4)
    assert polar.levels(np.zeros_like(IMAGES[name].energy)).max() == 0
    assert (picture[[0, -1]] == PAGE).all()


@pytest.mark.parametrize("place", [(7.0, 2.2), (-38.0, 1.15), (61.5, 3.333), (-80.0, 4.7)])
@pytest.mark.parametrize("window_m", [None, (1.0, 4.8)])
def test_a_reflector_is_drawn_where_it_is(place, window_m):
    made = cropped(spot(*place), window_m)
    polar = Polar(made)
    x, y = brightest(polar.picture(polar.levels(made.energy), TABLE)[:-66])
    azimuth_deg, range_m = polar.place_of(x, y)
    assert azimuth_deg == pytest.approx(place[0], abs=0.8)
    assert range_m == pytest.approx(place[1], abs=0.015)
    assert polar.pixel_of(azimuth_deg, range_m) == pytest.approx((x, y))


def test_rings_and_rays_are_where_they_say():
    polar = Polar(image())
    lit = (polar.picture(np.zeros((37, 400), np.uint8), TABLE) != TABLE[0]).any(axis=2)

    def is_lit(azimuth_deg, range_m):
        x, y = polar.pixel_of(azimuth_deg, range_m)
        return lit[int(y), int(x)]

    for azimuth_deg in (-75, -50, -10, 20, 70):
        assert [is_lit(azimuth_deg, range_m) for range_m in (1, 1.5, 2, 2.5, 3, 3.5, 4)] == [True, False] * 3 + [True]
    for range_m in (1.3, 2.6, 3.4):
        assert [is_lit(ray, range_m) for ray in (-60, -45, -30, -15, 0, 15, 30, 45, 60)] == [True, False] * 4 + [True]


def test_levels_are_those_below_the_strongest():
    made = spot(0, 2.0)
    levels = Polar(made, dynamic_range_db=40).levels(made.energy)
    half = made.replace(energy=np.where(made.energy == made.energy.max(), made.energy, made.energy / 10))
    assert levels.max() == 255
    there = Polar(half, dynamic_range_db=40).levels(half.energy)
    seen = (levels > 140) & (levels < 255)
    np.testing.assert_allclose(levels[seen].astype(int) - there[seen], 255 * 20 / 40, atol=1)


def test_a_window_outside_of_the_image_shows_its_end():
    assert len(cropped(image(), (7.0, 9.0)).range_m) == 1
    assert cropped(image(), (0.0, 9.0)).range_m is image().range_m or len(cropped(image(), (0.0, 9.0)).range_m) == 400


def test_points_follow_threshold_and_window():
    scene = Scene()
    made = spot(-40, 1.5)
    weak = spot(30, 3.0, level=0.5 * 10 ** (-15 / 20))
    scene.take(taken(made.replace(energy=np.maximum(made.energy, weak.energy)), TURNED))

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


def test_points_stay_and_fade():
    scene = Scene()
    for number in range(4):
        scene.take(taken(spot(10 * number, 2.0), time_s=0.1 * number))
    latest = scene.draw(Choices()).sensors["front"]
    assert (len(latest.position_m), latest.n_points) == (1, 1)
    fading = scene.draw(Choices(decay_s=0.25)).sensors["front"]
    assert (len(fading.position_m), fading.n_points) == (3, 1)
    brightness = fading.colours.astype(int).sum(axis=1)
    np.testing.assert_allclose(brightness / brightness[-1], [0.2, 0.6, 1.0], atol=0.02)
    scene.take(taken(spot(50, 2.0), time_s=0.1))  # the film begins anew
    assert len(scene.draw(Choices(decay_s=10)).sensors["front"].position_m) == 2


def test_what_two_sensors_see_becomes_one_image():
    scene = Scene()
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


def test_an_image_with_elevations_is_a_dome():
    scene = Scene()
    made = solid()
    scene.take(taken(made))
    frame = scene.draw(Choices(colours="viridis"))
    (drawn,) = frame.sensors.values()
    assert isinstance(drawn.shape, Dome)
    strongest = int(made.energy.max(axis=1).argmax())
    np.testing.assert_array_equal(drawn.shape.colours[strongest], colour_table("viridis")[255])
    np.testing.assert_allclose(np.linalg.norm(drawn.shape.position_m, axis=1), 5.0 / 4, rtol=1e-6)
    azimuth_rad = np.arctan2(drawn.shape.position_m[:, 1], drawn.shape.position_m[:, 0])
    np.testing.assert_allclose(azimuth_rad, made.azimuth_rad, atol=1e-5)


def test_maps_of_colours_rise_in_brightness():
    for name in COLOURS:
        luminance = colour_table(name) @ [0.2126, 0.7152, 0.0722]
        assert np.diff(luminance[::8]).min() > 0, name


def test_files_hold_what_is_drawn():
    scene = Scene()
    choices = Choices(threshold_db=-30, range_m=(0.8, 4.0))
    scene.take(taken(spot(-40, 1.5, timestamp_ns=1_700_000_000_123_000_000), TURNED))
    scene.take(taken(spot(20, 3.5, sensor="other"), Pose((0.0, 0.0, 0.1))))
    frame = scene.draw(choices)
    picture = np.asarray(Image.open(io.BytesIO(picture_png(frame))).convert("RGB"))
    last = frame.sensors["other"].picture
    np.testing.assert_array_equal(picture[-last.shape[0] :, : last.shape[1]], last)
    assert len(picture) > sum(each.picture.shape[0] for each in frame.sensors.values())
    vertex = plyfile.PlyData.read(io.BytesIO(points_ply(scene.latest(choices), choices)))["vertex"]
    stored = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    drawn = np.concatenate([each.position_m for each in frame.sensors.values()])
    np.testing.assert_allclose(stored, drawn, atol=1e-5)


def stamped(count, *, sensors=("front",), step_s=0.05):
    return [
        spot(0, 1.0 + number, sensor=name, sequence=number, timestamp_ns=round(1e18 + number * step_s * 1e9) + index)
        for number in range(count)
        for index, name in enumerate(sensors)
    ]


def test_a_film_shows_all_sensors_of_a_moment_together(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3, sensors=("front", "left")))
    with Film(path) as film:
        assert [moment.time_s for moment in film.moments] == pytest.approx([0, 0.05, 0.1])
        assert film.moments[1].measurements == (("front", 1), ("left", 1))
        assert [each.image.stamp.sensor for each in film.at(2)] == ["front", "left"]
    with Film(path, sensors=["left"]) as film:
        assert film.moments[2].measurements == (("left", 2),)


def test_a_film_plays_pauses_and_steps(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(4))
    with Film(path) as film:
        film.play(playing=False)
        film.seek(2)
        (shown,) = wait_for(film.take)
        assert (shown.image.stamp.sequence, film.shown, film.playing) == (2, 2, False)
        film.play(playing=True)
        seen = [shown]
        begun_s = time.monotonic()
        while film.playing or seen[-1].image.stamp.sequence != 3:
            seen += film.take()
            assert time.monotonic() - begun_s < PATIENCE_S
        assert time.monotonic() - begun_s > 0.045
        film.play(playing=True)
        assert wait_for(film.take)[0].image.stamp.sequence == 0
        film.seek(99)
        assert wait_for(lambda: film.take() and film.shown == 3)


def test_a_film_without_times_has_its_own(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", [each.replace(stamp=Stamp()) for each in stamped(3)])
    with Film(path) as film:
        assert [moment.time_s for moment in film.moments] == pytest.approx([0, 0.1, 0.2])


def test_recordings_are_processed_with_their_own_settings_and_air(tmp_path):
    first, second, _ = noise(SMALL)
    second = replace(second, settings=SMALL.replace(air=Air(temperature_c=5.0)))
    mounting = {"eRTIS-7": (TURNED.translation_m, TURNED.rotation_xyzw)}
    path = write_recording(tmp_path / "rec.h5", [first, second], mounting=mounting)
    with open_recording(path) as recording:
        wanted = [Pipeline(each.settings, device="cpu").process(each) for each in recording]
    with Film(path, device="cpu") as film:
        for place, each in enumerate(wanted):
            (shown,) = film.at(place)
            np.testing.assert_array_equal(shown.image.energy, each.energy)
            np.testing.assert_array_equal(shown.image.range_m, each.range_m)
            assert shown.pose.translation_m == TURNED.translation_m


def test_the_latest_of_each_sensor_is_shown_and_others_are_counted():
    sent = [published(number, sensor=name) for number in range(5) for name in ("front", "left")]
    with Publisher() as publisher, publisher.playing(sent), Live(publisher.address) as live:
        wait_for(lambda: live.received == len(sent))
        shown = wait_for(live.take)
        assert sorted((each.image.stamp.sensor, each.image.stamp.sequence) for each in shown) == [
            ("front", 4),
            ("left", 4),
        ]
        assert (live.skipped, live.dropped, live.take()) == (8, 0, [])
        assert shown[0].pose.translation_m == Publisher.translation_m
        assert live.latency_s(shown) == pytest.approx(time.time() - 1_700_000_000.4, abs=5)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"threshold_db": 3.0}, "threshold_db is 3; give a number from -60 to 0"),
        ({"dynamic_range_db": 5.0}, "dynamic_range_db is 5"),
        ({"range_m": (3.0, 1.0)}, "range_m runs from 3 to 1"),
        ({"decay_s": -1.0}, "decay_s is -1"),
        ({"colours": "jet"}, "colours 'jet' is unknown"),
    ],
)
def test_choices_that_cannot_be(changes, told):
    with pytest.raises(ArgumentError, match=told):
        Choices(**changes)


def test_pictures_that_cannot_be():
    with pytest.raises(ArgumentError, match="width_px is 50; give at least"):
        Polar(image(), width_px=50)
    with pytest.raises(ArgumentError, match="the image ends at range 0"):
        Polar(image(range_m=[0.0]))


def test_a_port_that_is_taken_is_refused(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    with socket.socket() as other, Film(path) as film:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(NetworkError, match=r"nothing can be served at 127.0.0.1:\d+ .*; give another host or port"):
            View(film, port=other.getsockname()[1])
    with Film(path) as film, pytest.raises(NetworkError, match=r"nothing can be served at 203\.0\.113\.1"):
        View(film, host="203.0.113.1", port=0)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("missing.h5",), "missing.h5"),
        (("IMG", "--sensor", "back"), "back"),
        (("IMG", "--key", "viewer"), "--key is for an address, and a file is given"),
        (("IMG", "--threshold", "5"), "threshold_db is 5"),
        (("IMG", "--save-html", "IMG"), "exists"),
        (("IMG", "--duration", "0"), "--duration is 0; give a number above 0"),
        (("tcp://0.0.0.0:5602",), "keys"),
    ],
)
def test_what_cannot_be_viewed_is_refused_in_a_line(tmp_path, arguments, told):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    done = CliRunner().invoke(cli, ["view", *(str(path) if word == "IMG" else word for word in arguments)])
    assert done.exit_code != 0
    assert told in f"{done.stderr} {done.exception}"


def test_pages_of_other_sites_are_refused(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    with Film(path) as film, View(film, port=0) as view:
        address = view.url.replace("http", "ws", 1)

        def ask(origin):
            return connect(address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"])

        for origin in ("http://example.org", "http://127.0.0.1.example.org:8080", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                ask(origin)
        for origin in (view.url.rstrip("/"), "http://localhost:9", None):
            with ask(origin) as connection:
                assert connection.recv(timeout=PATIENCE_S)


class Client:
    """A browser that asks for a file."""

    def __init__(self):
        self.files, self.notices = [], []

    def send_file_download(self, name, content, *, save_immediately):
        assert save_immediately
        self.files.append((name, content))

    def add_notification(self, title, body, **_):
        self.notices.append((title, body))


def test_what_cannot_be_saved_or_chosen_is_told_and_the_view_goes_on(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", [spot(0, 2.0, timestamp_ns=3 * 10**18)])
    client = Client()
    with Film(path) as film, View(film, port=0) as view:
        orders = [Order("threshold_db", 7.0), Order("points", client=client), Order("picture", client=client)]
        wait_for(lambda: view.run(duration_s=0.05) or view.shown)
        for order in orders:
            view._orders.put(order)  # noqa: SLF001  as a browser does
        view.run(duration_s=0.2)
        assert view.choices == Choices()
    ((title, body),) = client.notices
    assert title == "Nothing is saved"
    assert "wanted one from 1970 to 2038" in body
    ((name, content),) = client.files
    assert (name, content[:4]) == ("img.png", b"\x89PNG")


def test_without_viser_there_is_a_line_that_says_what_to_install(tmp_path, monkeypatch):
    for name in ("_view", "_page", "_space"):
        monkeypatch.delitem(sys.modules, f"ertis_numba.viewer.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    done = CliRunner().invoke(cli, ["view", str(path)])
    assert done.exit_code == 1
    assert done.stderr.splitlines() == ["ertis: error: viser is not installed; pip install 'ertis-numba[view]'"]


def test_a_recording_as_a_page_of_its_own(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3))
    page = tmp_path / "page.html"
    done = CliRunner().invoke(cli, ["view", str(path), "--save-html", str(page)])
    assert done.exit_code == 0, (done.stderr, done.exception)
    assert done.stderr.splitlines() == [f"{page}: 3 frames of {path}"]
    text = page.read_text()
    assert "__VISER_EMBED_DATA__" in text
    assert len(text) > 500_000


def test_the_page_on_the_view(tmp_path):
    (tmp_path / "data").symlink_to(ROOT / "data")
    write_energyscapes(tmp_path / "IMG.h5", stamped(3))
    text = (ROOT / "docs" / "view.md").read_text()
    commands = [command for command in commands_in(text) if command.startswith("view ")]
    assert len(commands) == 4
    with Publisher() as publisher, publisher.playing([]):
        for command in commands:
            words = command.replace("tcp://127.0.0.1:5602", publisher.address)
            if "--save-html" in words:
                run_here(tmp_path, words)
            else:
                told = json.loads(run_here(tmp_path, f"{words} --port 0 --no-open --json --duration 0.2"))
                assert told["source"] == words.split()[1]
    assert (tmp_path / "PAGE.html").stat().st_size > 500_000
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    done = run(tmp_path, sys.executable, "-W", "error", "-c", code)
    assert done.stdout.startswith("http://127.0.0.1:")

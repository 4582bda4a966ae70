"""Playback of files: first image, playing, seeking and skipping."""

import atexit
import re
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.base.errors import DeviceError
from ertis_numba.frames import Stamp
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from ertis_numba.viewer import Choices, Playback, Pose, ViewedScene, Viewer
from ertis_numba.viewer._page import ControlRequest
from tests.files import SMALL, noise
from tests.viewer.test_view import TURNED
from tests.views import PATIENCE_S, acked_through, spot, stamped, wait_for


def test_time_step_shows_all_sensors_together(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3, sensors=("front", "left")))
    with Playback(path) as playback:
        assert [moment.time_s for moment in playback.time_steps] == pytest.approx([0, 0.05, 0.1])
        assert playback.time_steps[1].measurements == (("front", 1), ("left", 1))
        assert [each.image.stamp.sensor for each in playback.at(2)] == ["front", "left"]
    with Playback(path, sensors=["left"]) as playback:
        assert playback.time_steps[2].measurements == (("left", 2),)


def test_playback_selects_one_sensor_by_name(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(2, sensors=("front", "left")))
    for named in ("left", ["left"]):
        with Playback(path, sensors=named) as playback:
            assert [moment.measurements for moment in playback.time_steps] == [(("left", 0),), (("left", 1),)]


@pytest.mark.parametrize("is_level", [False, True])
def test_level_images_have_no_place_on_the_platform(tmp_path, is_level):
    """A mounting applies to directions in the frame of the sensor."""
    images = [
        each.replace(settings=each.settings.replace("processing.level_directions", is_level)) for each in stamped(1)
    ]
    mounting = {images[0].stamp.sensor: (TURNED.translation_m, TURNED.rotation_xyzw)}
    path = write_energyscapes(tmp_path / "img.h5", images, mounting=mounting)
    with Playback(path) as playback:
        assert [each.pose for each in playback.at(0)] == [None if is_level else TURNED]


def test_playback_plays_pauses_and_steps(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(4))
    with Playback(path) as playback:
        playback.play(playing=False)
        playback.seek(2)
        (shown,) = wait_for(playback.take)
        assert (shown.image.stamp.sequence, playback.shown, playback.playing) == (2, 2, False)
        seen, begun_s = [shown], time.monotonic()
        playback.play(playing=True)
        while playback.playing or seen[-1].image.stamp.sequence != 3:
            seen += playback.take()
            assert time.monotonic() - begun_s < PATIENCE_S
        assert time.monotonic() - begun_s > 0.045
        playback.play(playing=True)
        assert wait_for(playback.take)[0].image.stamp.sequence == 0
        playback.seek(99)
        assert wait_for(lambda: playback.take() and playback.shown == 3)


def test_playback_without_timestamps_uses_an_interval(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", [each.replace(stamp=Stamp()) for each in stamped(3)])
    with Playback(path) as playback:
        assert [moment.time_s for moment in playback.time_steps] == pytest.approx([0, 0.1, 0.2])


def test_recordings_are_processed_with_their_own_settings_and_air(tmp_path):
    first, second, _ = noise(SMALL)
    second = replace(second, settings=SMALL.replace(air=Air(temperature_c=5.0)))
    mounting = {"eRTIS-7": (TURNED.translation_m, TURNED.rotation_xyzw)}
    path = write_recording(tmp_path / "rec.h5", [first, second], mounting=mounting)
    with open_recording(path) as recording:
        wanted = [Pipeline(each.settings, device="cpu").process(each) for each in recording]
    with Playback(path, device="cpu") as playback:
        for place, each in enumerate(wanted):
            (shown,) = playback.at(place)
            np.testing.assert_array_equal(shown.image.amplitude, each.amplitude)
            np.testing.assert_array_equal(shown.image.range_m, each.range_m)
            assert shown.pose.translation_m == TURNED.translation_m


def test_missing_device_is_reported_before_the_first_image(tmp_path, monkeypatch):
    path = write_recording(tmp_path / "rec.h5", noise(SMALL, 1))

    def load(device):
        raise DeviceError(f"{device} is not there")

    monkeypatch.setattr(kernels, "load", load)
    with pytest.raises(DeviceError, match="cuda is not there"):
        Playback(path, device="cuda")
    Playback(
        write_energyscapes(tmp_path / "img.h5", stamped(1)), device="cuda"
    ).__exit__()  # which has nothing to compute


def alternating(count, *, step_s=0.05):
    """Alternating images of two sensors: time step 2 n is image n of a, and 2 n + 1 that of b."""
    return [
        spot(
            0, 1 + number / 10, sensor=name, sequence=number, timestamp_ns=round(1e18 + (2 * number + k) * step_s * 1e9)
        )
        for number in range(count)
        for k, name in enumerate("ab")
    ]


def sequences(taken):
    return {each.image.stamp.sensor: each.image.stamp.sequence for each in taken}


def come(playback):
    return sequences(wait_for(playback.take))


def test_seek_discards_images_of_other_times(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", alternating(6))
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        playback.play(playing=False)

        def shown_at(place):
            view._orders.put(ControlRequest("seek", place))  # noqa: SLF001  as a browser does
            wait_for(lambda: view.run(duration_s=0.02) or playback.shown == place)
            return {name: drawn.stamp.sequence for name, drawn in view._frame.sensors.items()}  # noqa: SLF001

        assert shown_at(10) == {"a": 5, "b": 4}
        assert shown_at(2) == {"a": 1, "b": 0}
        assert shown_at(9) == {"a": 4, "b": 4}
        assert shown_at(0) == {"a": 0}  # b comes later
        assert view._frame.fused is None  # noqa: SLF001


def test_restarted_playback_forgets_its_end(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", alternating(2, step_s=0.03))
    with Playback(path, loop=True) as playback:
        assert come(playback) == {"a": 0}
        wait_for(lambda: playback.take() and playback.shown == 3)
        assert not playback.anew
        taken = wait_for(lambda: [each for each in playback.take() if playback.shown < 3])
        assert playback.anew
        assert sequences(taken)["a"] == 0


def test_skipped_time_steps_keep_the_latest_of_each_sensor(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", alternating(6))
    with Playback(path) as playback:
        playback._advance = lambda _: None  # noqa: SLF001  as if no time passed
        assert come(playback) == {"a": 0}
        playback.place = 6
        assert come(playback) == {"a": 3, "b": 2}
        assert (playback.shown, playback.skipped, playback.anew) == (6, 4, False)
        playback.place = 7
        assert come(playback) == {"b": 3}
        assert playback.skipped == 4


def test_late_images_are_skipped(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(4))
    with Playback(path) as playback:
        playback._advance = lambda _: None  # noqa: SLF001  as if no time passed
        come(playback)
        for place in (1, 2, 3):
            playback.place = place
            wait_for(lambda place=place: playback.received == place + 1)
        assert come(playback) == {"front": 3}
        assert playback.skipped == 2


def test_seek_counts_no_skipped_images(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(10, step_s=100.0))
    with Playback(path) as playback:
        come(playback)
        playback.seek(7)
        assert come(playback) == {"front": 7}
        playback.play(playing=False)
        playback.play(playing=True)
        playback.seek(9)
        assert come(playback) == {"front": 9}
        playback.play(playing=True)  # from the beginning
        assert come(playback) == {"front": 0}
        assert (playback.skipped, playback.received) == (0, 4)


def test_paused_playback_stops_its_clock(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3, step_s=100.0))
    with Playback(path) as playback:
        assert playback.clock_s == 0
        come(playback)
        assert 0 < wait_for(lambda: playback.clock_s) < PATIENCE_S
        playback.play(playing=False)
        assert playback.clock_s == 0
        playback.seek(1)
        come(playback)
        assert playback.clock_s == pytest.approx(100)
        playback._begun = (time.monotonic() - 1e6, 0)  # noqa: SLF001  as if what is due took very long to make
        playback.playing = True
        assert playback.clock_s == pytest.approx(200)


def test_typical_interval_is_computed_per_sensor(tmp_path):
    rare = [spot(0, 1.0, sensor="rare", timestamp_ns=round(1e18 + s * 1e9)) for s in (0, 4, 8)]
    path = write_energyscapes(tmp_path / "img.h5", stamped(9, step_s=1.0) + rare)
    with Playback(path) as playback:
        assert {each.image.stamp.sensor: each.interval_s for each in playback.at(0)} == {"front": 1.0, "rare": 4.0}
        assert playback.at(8)[0].time_s == 8.0


def test_recorded_view_fades_without_new_images(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(2, step_s=2.0))
    drawn = []
    with Playback(path) as playback, Viewer(playback, port=0, choices=Choices(decay_s=0.5)) as view:
        show = view._page.show  # noqa: SLF001

        def shown(frame, place):
            drawn.append((place, len(frame.sensors["front"].position_m), frame.sensors["front"].overdue))
            show(frame, place)

        view._page.show = shown  # noqa: SLF001
        view.record(tmp_path / "page.html")
        assert view.recorded == 2
    assert drawn[:5] == [(0, 1, False), (0, 1, False), (0, 1, False), (0, 0, False), (1, 1, False)]


@pytest.mark.parametrize("kind", ["recording", "energyscape"])
def test_files_contain_mountings(tmp_path, kind):
    given = noise(SMALL, 1)[0]
    several = [replace(given, stamp=replace(given.stamp, sensor=name)) for name in "ab"]
    places = {"a": TURNED, "b": replace(TURNED, translation_m=(1.0, 1.0, 0.5))}
    mounting = {name: (pose.translation_m, pose.rotation_xyzw) for name, pose in places.items()}
    path = write_recording(tmp_path / "rec.h5", several, mounting=mounting)
    if kind == "energyscape":
        with open_recording(path, sensor="a") as a, open_recording(path, sensor="b") as b, Pipeline(a.settings) as made:
            images = [made.process(each) for each in several]
            path = write_energyscapes(tmp_path / "img.h5", images, recording=[a, b])
    with Playback(path, device="cpu") as playback:
        scene = ViewedScene()
        for each in playback.at(0):
            assert each.pose == places[each.image.stamp.sensor]
            scene.take(each)
        assert scene.draw(Choices()).fused is not None


def test_saved_page_has_a_title_and_a_picture_per_sensor(tmp_path):
    path = write_energyscapes(tmp_path / "a <b>.h5", stamped(1, sensors=("front", "left")))
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        view.record(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert page.count("<title>a &lt;b&gt;.h5</title>") == 1
    assert re.findall(r"<div>(\w+), latest image: dB re strongest</div><img[^>]*data:image/png;base64,", page) == [
        "front",
        "left",
    ]


def test_a_given_mounting_places_sensors_whose_own_is_unknown(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1, sensors=("front", "left")))
    mounting = {"front": (TURNED.translation_m, TURNED.rotation_xyzw), "left": ([0, 1, 0], [0, 0, 0, 1])}
    with Playback(path, mounting=mounting) as playback:
        scene = ViewedScene()
        for each in playback.at(0):
            assert each.pose == Pose.of(*mounting[each.image.stamp.sensor])
            scene.take(each)
        assert scene.draw(Choices()).fused is not None


def test_files_without_mountings_are_not_combined(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1, sensors=("front", "left")))
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        wait_for(lambda: view.run(duration_s=0.02) or view.shown)
        assert [each.pose for each in playback.at(0)] == [None, None]
        assert view._frame.fused is None  # noqa: SLF001
        assert acked_through(view)["unplaced"] == "front, left: not on the platform"


def test_closing_waits_for_the_compiler(tmp_path, monkeypatch):
    """An interpreter that ends while a thread compiles crashes."""
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    at_exit, compiling, compiled = [], threading.Event(), threading.Event()
    monkeypatch.setattr(atexit, "register", at_exit.append)
    monkeypatch.setattr(atexit, "unregister", at_exit.remove)
    with Playback(path) as playback:
        playback._taken = lambda *_: compiling.set() or compiled.wait(PATIENCE_S)  # noqa: SLF001
        playback.take()
        assert at_exit == [playback._end]  # noqa: SLF001  where nobody closes it
        assert compiling.wait(PATIENCE_S)
        ending = threading.Thread(target=playback.__exit__)
        ending.start()
        ending.join(0.01)
        assert ending.is_alive()
        compiled.set()
        ending.join(PATIENCE_S)
        assert not playback._thread.is_alive()  # noqa: SLF001
        assert at_exit == []
        monkeypatch.undo()


def test_playback_starts_with_the_first_browser(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(4, step_s=0.01))
    with Playback(path) as playback, Viewer(playback, port=0) as view:
        wait_for(lambda: view.run(duration_s=0.02) or view.shown)
        view.run(duration_s=0.1)
        assert (playback.shown, playback.received, playback.playing) == (0, 1, True)
        view._page._greet(SimpleNamespace(client_id=0, gui=MagicMock()))  # noqa: SLF001  as a browser comes
        wait_for(lambda: view.run(duration_s=0.02) or not playback.playing)
        assert playback.received > 1


def test_sensors_that_observe_no_common_reflector_are_drawn_alone(tmp_path):
    given = noise(SMALL, 1)[0]
    several = [replace(given, stamp=replace(given.stamp, sensor=name)) for name in "ab"]
    mounting = {"a": ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0)), "b": ((0.0, 9.0, 0.5), (0.0, 0.0, 0.0, 1.0))}
    path = write_recording(tmp_path / "rec.h5", several, mounting=mounting)
    with Playback(path, device="cpu") as playback:
        scene = ViewedScene()
        for each in playback.at(0):
            scene.take(each)
        frame = scene.draw(Choices())
    assert frame.fused is None
    assert all(drawn.shape is not None for drawn in frame.sensors.values())

"""Files along their time: what is shown at once, what is played, sought and skipped."""

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
from ertis_numba.errors import DeviceError
from ertis_numba.frames import Stamp
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from ertis_numba.viewer import Choices, Film, Pose, Scene, View
from ertis_numba.viewer._page import Order
from tests.files import SMALL, noise
from tests.test_view import TURNED
from tests.views import PATIENCE_S, settled, spot, stamped, wait_for


def test_a_film_shows_all_sensors_of_a_moment_together(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3, sensors=("front", "left")))
    with Film(path) as film:
        assert [moment.time_s for moment in film.moments] == pytest.approx([0, 0.05, 0.1])
        assert film.moments[1].measurements == (("front", 1), ("left", 1))
        assert [each.image.stamp.sensor for each in film.at(2)] == ["front", "left"]
    with Film(path, sensors=["left"]) as film:
        assert film.moments[2].measurements == (("left", 2),)


def test_a_film_of_one_sensor_takes_its_name(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(2, sensors=("front", "left")))
    for named in ("left", ["left"]):
        with Film(path, sensors=named) as film:
            assert [moment.measurements for moment in film.moments] == [(("left", 0),), (("left", 1),)]


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


def test_a_device_that_is_not_there_is_told_before_anything_is_shown(tmp_path, monkeypatch):
    path = write_recording(tmp_path / "rec.h5", noise(SMALL, 1))

    def load(device):
        raise DeviceError(f"{device} is not there")

    monkeypatch.setattr(kernels, "load", load)
    with pytest.raises(DeviceError, match="cuda is not there"):
        Film(path, device="cuda")
    Film(write_energyscapes(tmp_path / "img.h5", stamped(1)), device="cuda").__exit__()  # which has nothing to compute


def alternating(count, *, step_s=0.05):
    """Images of two sensors by turns: in moment 2 n is the n-th of a, in moment 2 n + 1 that of b."""
    return [
        spot(
            0, 1 + number / 10, sensor=name, sequence=number, timestamp_ns=round(1e18 + (2 * number + k) * step_s * 1e9)
        )
        for number in range(count)
        for k, name in enumerate("ab")
    ]


def sequences(taken):
    return {each.image.stamp.sensor: each.image.stamp.sequence for each in taken}


def come(film):
    return sequences(wait_for(film.take))


def test_after_a_seek_nothing_of_another_time_is_shown(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", alternating(6))
    with Film(path) as film, View(film, port=0) as view:
        film.play(playing=False)

        def shown_at(place):
            view._orders.put(Order("seek", place))  # noqa: SLF001  as a browser does
            wait_for(lambda: view.run(duration_s=0.02) or film.shown == place)
            return {name: drawn.stamp.sequence for name, drawn in view._frame.sensors.items()}  # noqa: SLF001

        assert shown_at(10) == {"a": 5, "b": 4}
        assert shown_at(2) == {"a": 1, "b": 0}
        assert shown_at(9) == {"a": 4, "b": 4}
        assert shown_at(0) == {"a": 0}  # b comes later
        assert view._frame.fused is None  # noqa: SLF001


def test_a_film_that_begins_anew_forgets_its_end(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", alternating(2, step_s=0.03))
    with Film(path, loop=True) as film:
        assert come(film) == {"a": 0}
        wait_for(lambda: film.take() and film.shown == 3)
        assert not film.anew
        taken = wait_for(lambda: [each for each in film.take() if film.shown < 3])
        assert film.anew
        assert sequences(taken)["a"] == 0


def test_a_film_shows_the_last_of_each_sensor_though_moments_are_skipped(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", alternating(6))
    with Film(path) as film:
        film._advance = lambda _: None  # noqa: SLF001  as if no time passed
        assert come(film) == {"a": 0}
        film.place = 6
        assert come(film) == {"a": 3, "b": 2}
        assert (film.shown, film.skipped, film.anew) == (6, 4, False)
        film.place = 7
        assert come(film) == {"b": 3}
        assert film.skipped == 4


def test_what_nobody_took_in_time_is_skipped(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(4))
    with Film(path) as film:
        film._advance = lambda _: None  # noqa: SLF001  as if no time passed
        come(film)
        for place in (1, 2, 3):
            film.place = place
            wait_for(lambda place=place: film.received == place + 1)
        assert come(film) == {"front": 3}
        assert film.skipped == 2


def test_who_goes_elsewhere_skips_nothing(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(10, step_s=100.0))
    with Film(path) as film:
        come(film)
        film.seek(7)
        assert come(film) == {"front": 7}
        film.play(playing=False)
        film.play(playing=True)
        film.seek(9)
        assert come(film) == {"front": 9}
        film.play(playing=True)  # from the beginning
        assert come(film) == {"front": 0}
        assert (film.skipped, film.received) == (0, 4)


def test_the_clock_of_a_film_stands_still_when_it_does(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(3, step_s=100.0))
    with Film(path) as film:
        assert film.clock_s == 0
        come(film)
        assert 0 < wait_for(lambda: film.clock_s) < PATIENCE_S
        film.play(playing=False)
        assert film.clock_s == 0
        film.seek(1)
        come(film)
        assert film.clock_s == pytest.approx(100)
        film._begun = (time.monotonic() - 1e6, 0)  # noqa: SLF001  as if what is due took very long to make
        film.playing = True
        assert film.clock_s == pytest.approx(200)


def test_the_usual_interval_is_that_of_each_sensor(tmp_path):
    rare = [spot(0, 1.0, sensor="rare", timestamp_ns=round(1e18 + s * 1e9)) for s in (0, 4, 8)]
    path = write_energyscapes(tmp_path / "img.h5", stamped(9, step_s=1.0) + rare)
    with Film(path) as film:
        assert {each.image.stamp.sensor: each.interval_s for each in film.at(0)} == {"front": 1.0, "rare": 4.0}
        assert film.at(8)[0].time_s == 8.0


def test_a_recorded_film_fades_where_nothing_comes(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(2, step_s=2.0))
    drawn = []
    with Film(path) as film, View(film, port=0, choices=Choices(decay_s=0.5)) as view:
        show = view._page.show  # noqa: SLF001

        def shown(frame, place):
            drawn.append((place, len(frame.sensors["front"].position_m), frame.sensors["front"].overdue))
            show(frame, place)

        view._page.show = shown  # noqa: SLF001
        view.record(tmp_path / "page.html")
        assert view.recorded == 2
    assert drawn[:5] == [(0, 1, False), (0, 1, False), (0, 1, False), (0, 0, False), (1, 1, False)]


@pytest.mark.parametrize("kind", ["recording", "energyscape"])
def test_files_know_where_their_sensors_are(tmp_path, kind):
    given = noise(SMALL, 1)[0]
    several = [replace(given, stamp=replace(given.stamp, sensor=name)) for name in "ab"]
    places = {"a": TURNED, "b": replace(TURNED, translation_m=(0.0, -1.0, 0.5))}
    mounting = {name: (pose.translation_m, pose.rotation_xyzw) for name, pose in places.items()}
    path = write_recording(tmp_path / "rec.h5", several, mounting=mounting)
    if kind == "energyscape":
        with open_recording(path, sensor="a") as a, open_recording(path, sensor="b") as b, Pipeline(a.settings) as made:
            images = [made.process(each) for each in several]
            path = write_energyscapes(tmp_path / "img.h5", images, recording=[a, b])
    with Film(path, device="cpu") as film:
        scene = Scene()
        for each in film.at(0):
            assert each.pose == places[each.image.stamp.sensor]
            scene.take(each)
        assert scene.draw(Choices()).fused is not None


def test_a_saved_page_has_a_title_and_the_picture_of_each_sensor(tmp_path):
    path = write_energyscapes(tmp_path / "a <b>.h5", stamped(1, sensors=("front", "left")))
    with Film(path) as film, View(film, port=0) as view:
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
    with Film(path, mounting=mounting) as film:
        scene = Scene()
        for each in film.at(0):
            assert each.pose == Pose.of(*mounting[each.image.stamp.sensor])
            scene.take(each)
        assert scene.draw(Choices()).fused is not None


def test_files_that_do_not_know_it_fuse_nothing(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1, sensors=("front", "left")))
    with Film(path) as film, View(film, port=0) as view:
        wait_for(lambda: view.run(duration_s=0.02) or view.shown)
        assert [each.pose for each in film.at(0)] == [None, None]
        assert view._frame.fused is None  # noqa: SLF001
        assert settled(view)["unplaced"] == "front, left: not on the platform"


def test_who_ends_waits_for_the_compiler(tmp_path, monkeypatch):
    """An interpreter that ends while a thread is in it crashes."""
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    at_exit, compiling, compiled = [], threading.Event(), threading.Event()
    monkeypatch.setattr(atexit, "register", at_exit.append)
    monkeypatch.setattr(atexit, "unregister", at_exit.remove)
    with Film(path) as film:
        film._taken = lambda *_: compiling.set() or compiled.wait(PATIENCE_S)  # noqa: SLF001
        film.take()
        assert at_exit == [film._end]  # noqa: SLF001  where nobody closes it
        assert compiling.wait(PATIENCE_S)
        ending = threading.Thread(target=film.__exit__)
        ending.start()
        ending.join(0.01)
        assert ending.is_alive()
        compiled.set()
        ending.join(PATIENCE_S)
        assert not film._thread.is_alive()  # noqa: SLF001
        assert at_exit == []
        monkeypatch.undo()


def test_a_film_begins_when_somebody_sees_it(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(4, step_s=0.01))
    with Film(path) as film, View(film, port=0) as view:
        wait_for(lambda: view.run(duration_s=0.02) or view.shown)
        view.run(duration_s=0.1)
        assert (film.shown, film.received, film.playing) == (0, 1, True)
        view._page._greet(SimpleNamespace(client_id=0, gui=MagicMock()))  # noqa: SLF001  as a browser comes
        wait_for(lambda: view.run(duration_s=0.02) or not film.playing)
        assert film.received > 1

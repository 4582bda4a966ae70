"""Acoustic maps of the live view: pictures, bands, levels, spheres, and maps of recordings and central nodes."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import AcousticMap, Measurement, Stamp
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.passive import AcousticCamera
from ertis_numba.settings import Processing
from ertis_numba.storage import open_recording, write_acoustic_maps, write_energyscapes, write_recording
from ertis_numba.viewer import Choices, Dome, Live, Playback, Pose, ReceivedImage, Sector, ViewedMaps, Viewer
from ertis_numba.viewer._axes import PAGE
from ertis_numba.viewer._level_plane import LevelPlane
from ertis_numba.viewer._page import ControlRequest
from ertis_numba.viewer._result_notes import ResultNotes
from tests.files import SMALL, noise
from tests.publishing import Publisher, measurement
from tests.views import TABLE, Source, acked_through, brightest, spot, stamped, taken, wait_for

BAND_HZ = np.array([[20e3, 25e3], [25e3, 40e3]])
TURNED = Pose((1.0, 2.0, 0.5), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))  # to the left
MAPS = replace(Choices(), dynamic_range_db=20.0)


def sounds(*places, directions="2d:181", sensor="front", band_hz=BAND_HZ, **stamp):
    """Map with sources, each given by azimuth and elevation in degrees, band, and level in dBFS."""
    grid = direction_grid(Processing(directions=directions))
    looks = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    power = np.full((len(grid), len(band_hz)), 1e-9)
    for azimuth_deg, elevation_deg, band, level_db in places:
        (towards,) = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))
        away_rad = np.arccos(np.clip(looks @ towards, -1, 1))
        power[:, band] += 10 ** (level_db / 10) * np.exp(-0.5 * (away_rad / np.radians(4)) ** 2)
    stamp = Stamp(sensor=sensor, **stamp)
    return AcousticMap(power.astype(np.float32), grid.azimuth_rad, grid.elevation_rad, band_hz, SMALL, stamp)


def drawn(*maps, choices=MAPS, pose=None):
    scene = ViewedMaps()
    for each in maps:
        scene.take(taken(each, pose))
    return scene.draw(choices)


@pytest.mark.parametrize("place", [(30, 20), (-60, -45), (0, 75)])
def test_plane_shows_a_source_at_its_azimuth_and_elevation(place):
    frame = drawn(sounds((*place, 0, -40.0), directions="3d:4000"))
    picture = frame.sensors["front"].picture
    rows, columns = np.nonzero((picture[:-66] != PAGE).any(axis=2) & (picture[:-66] <= TABLE[60]).all(axis=2))
    x, y = brightest(picture[:-66])
    west, east, top, bottom = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    # The plane covers the hemisphere ahead: 180° of azimuth from the left to the right, and of elevation.
    assert 90 - 180 * (x - west) / (east - west) == pytest.approx(place[0], abs=4)
    assert 90 - 180 * (y - top) / (bottom - top) == pytest.approx(place[1], abs=4)


@pytest.mark.parametrize(("azimuth_deg", "level_db"), [(30, -41.0), (-70, -46.0), (0, -55.0)])
def test_polar_plot_reaches_the_level_in_the_direction(azimuth_deg, level_db):
    choices = replace(MAPS, max_level_db=-40.0)
    (front,) = drawn(sounds((azimuth_deg, 0, 1, level_db)), choices=choices).sensors.values()
    west, east, low, high = front.shape.extent_m
    rows, columns = np.nonzero(front.shape.colours[..., 3] == 255)
    right = west + (columns + 0.5) / front.shape.colours.shape[1] * (east - west)
    ahead = high - (rows + 0.5) / front.shape.colours.shape[0] * (high - low)
    farthest = np.hypot(right, ahead).argmax()
    assert np.hypot(right, ahead).max() == pytest.approx((level_db + 60) / 20, abs=0.02)
    assert math.degrees(math.atan2(-right[farthest], ahead[farthest])) == pytest.approx(azimuth_deg, abs=2)
    assert front.position_m[0] == pytest.approx(
        (level_db + 60) / 20 * unit_vectors(np.radians([azimuth_deg]), np.zeros(1))[0], abs=0.01
    )


@pytest.mark.parametrize("directions", ["2d:3", "2d:90", "3d:30", "3d:1000", [(12.0, 0.0)], [(12.0, 5.0)]])
def test_every_grid_is_drawn(directions):
    grid = direction_grid(Processing(directions=directions))
    plane = LevelPlane(grid.azimuth_rad, grid.elevation_rad)
    frame = drawn(sounds((10, 0, 0, -40.0), directions=directions), choices=replace(MAPS, dynamic_range_db=80.0))
    picture = frame.sensors["front"].picture
    assert picture.shape == (*plane.shape, 3)
    assert ((picture[:-66] != PAGE).any(axis=2) & (picture[:-66] != 255).any(axis=2)).sum() > 1000
    assert (picture[[0, -1]] == PAGE).all()


def test_levels_of_bands_are_the_loudest_of_each():
    maps = [sounds((10, 0, 0, -50.0), (20, 0, 1, -42.0)), sounds((-30, 0, 0, -45.0), sensor="left")]
    bands = drawn(*maps, pose=Pose()).scale.bands
    assert [each.band_hz for each in bands] == [None, (20e3, 25e3), (25e3, 40e3)]
    assert [(each.sensor, round(each.azimuth_deg)) for each in bands] == [("front", 20), ("left", -30), ("front", 20)]
    for number, sensor in ((0, 1), (1, 0)):
        loudest = maps[sensor].loudest()[number]
        assert bands[1 + number].level_db == pytest.approx(loudest.level_dbfs, abs=1e-4)
    assert bands[0].level_db == pytest.approx(10 * math.log10(maps[0].power.sum(axis=1).max()), abs=1e-4)
    assert bands[1].centre_hz == pytest.approx(math.sqrt(20e3 * 25e3))


def test_chosen_band_is_shown():
    found = sounds((10, 0, 0, -50.0), (20, 0, 1, -42.0))
    towards = {}
    for band_hz in (None, 22e3, 30e3, 25e3 - 1):
        frame = drawn(found, choices=replace(MAPS, band_hz=band_hz))
        towards[band_hz] = round(math.degrees(math.atan2(*frame.sensors["front"].position_m[0, 1::-1])))
    assert towards == {None: 20, 22e3: 10, 30e3: 20, 25e3 - 1: 10}
    beyond = drawn(found, choices=replace(MAPS, band_hz=60e3))
    assert beyond.sensors["front"].shape is None
    assert not any(each.is_shown for each in beyond.scale.bands)
    assert len(beyond.sensors["front"].position_m) == 0


def test_of_overlapping_bands_the_nearest_centre_is_chosen():
    found = sounds((10, 0, 0, -50.0), (20, 0, 1, -42.0), band_hz=np.array([[20e3, 40e3], [24e3, 34e3]]))
    for number, band_hz in enumerate(np.sqrt(found.band_hz.prod(axis=1))):
        shown = [each.is_shown for each in drawn(found, choices=replace(MAPS, band_hz=band_hz)).scale.bands]
        assert shown == [False, number == 0, number == 1]


def test_scale_follows_the_loudest_unless_it_is_fixed():
    found = sounds((10, 0, 0, -51.3), (20, 0, 1, -57.0))
    scales = [
        drawn(found, choices=choices).scale
        for choices in (MAPS, replace(MAPS, band_hz=30e3), replace(MAPS, max_level_db=-12.5, dynamic_range_db=33.0))
    ]
    assert [(each.low_db, each.high_db) for each in scales] == [(-70, -50), (-75, -55), (-45.5, -12.5)]
    assert {each.unit for each in scales} == {"dBFS"}
    silence = drawn(found.replace(power=np.zeros_like(found.power)))
    assert (silence.scale.high_db, silence.scale.bands[0].level_db) == (0.0, -math.inf)
    music = found.replace(settings=SMALL.replace(**{"passive.method": "music"}))
    assert drawn(music).unit == "dB"


def test_levels_are_sound_pressures_if_all_microphones_are_calibrated():
    found = sounds((10, 0, 0, -51.3))
    settings = SMALL.replace(**{"array.sensitivity_dbfs": -26.0})
    calibrated = found.replace(settings=settings, stamp=Stamp(sensor="left"))
    scale = drawn(calibrated).scale
    assert scale.unit == "dB re 20 µPa"
    assert scale.bands[1].level_db == pytest.approx(calibrated.level_db[:, 0].max(), abs=1e-4)
    both = drawn(calibrated, found, pose=Pose())
    assert both.unit == "dBFS"
    assert both.scale.bands[1].level_db == pytest.approx(found.level_dbfs[:, 0].max(), abs=1e-4)


def test_levels_are_source_levels_if_all_distances_are_known():
    settings = SMALL.replace(**{"array.sensitivity_dbfs": -26.0})
    at_array = sounds((10, 0, 0, -51.3), (20, 0, 1, -42.0)).replace(settings=settings)
    near = at_array.replace(settings=settings.replace("passive.focus_m", 2.0), stamp=Stamp(sensor="left"))
    scale = drawn(near).scale
    assert scale.unit == "dB re 20 µPa at 1 m"
    assert [each.level_db for each in scale.bands[1:]] == pytest.approx(near.source_level_db.max(axis=0), abs=1e-3)
    total = (10 ** (near.source_level_db / 10)).sum(axis=1).max()
    assert scale.bands[0].level_db == pytest.approx(10 * math.log10(total), abs=1e-3)
    assert drawn(near, at_array, pose=Pose()).unit == "dB re 20 µPa"


def test_sphere_surrounds_its_sensor():
    found = sounds((30, 20, 0, -40.0), directions="3d:1000")
    (front,) = drawn(found, pose=TURNED).sensors.values()
    assert isinstance(front.shape, Dome)
    assert np.linalg.norm(front.shape.position_m, axis=1) == pytest.approx(1.0, abs=1e-6)
    level_db = 10 * np.log10(found.power.sum(axis=1))
    assert len(front.shape.position_m) == pytest.approx(np.count_nonzero(level_db > level_db.max() - 20), rel=0.2)
    away_m = front.position_m[0] - TURNED.translation_m
    azimuth_deg = math.degrees(math.atan2(away_m[1], away_m[0]))
    assert azimuth_deg == pytest.approx(30 + 90, abs=3)
    assert math.degrees(math.asin(away_m[2] / np.linalg.norm(away_m))) == pytest.approx(20, abs=3)


def test_spheres_of_a_platform_do_not_overlap():
    scene = ViewedMaps()
    for sensor, x in (("front", 0.2), ("back", -0.2)):
        scene.take(taken(sounds((0, 0, 0, -40.0), sensor=sensor, directions="3d:300"), Pose((x, 0.0, 0.0))))
    frame = scene.draw(MAPS)
    assert {round(float(np.linalg.norm(each.shape.position_m[0])), 6) for each in frame.sensors.values()} == {0.2}
    assert 0.4 <= frame.range_m < 0.6
    scene.take(ReceivedImage(sounds(sensor="lost"), None, 0.0))
    assert len(scene.draw(MAPS).sensors["lost"].position_m) == 0  # it has no place on the platform


def test_overdue_map_is_dim_and_does_not_set_the_scale():
    scene = ViewedMaps()
    scene.take(taken(sounds((0, 0, 0, -21.0), sensor="a"), Pose(), 0.0, 0.1))
    scene.take(taken(sounds((0, 0, 0, -41.0), sensor="b"), Pose((0.0, 1.0, 0.0)), 9.9, 0.1))
    assert scene.draw(MAPS, 0.5).scale.high_db == -20
    frame = scene.draw(MAPS, 10.0)
    assert (frame.sensors["a"].overdue, frame.sensors["b"].overdue) == (True, False)
    assert frame.scale.high_db == -40
    assert frame.sensors["a"].shape.colours[..., :3].max() < 100
    assert frame.until_s == pytest.approx(10.9)


def test_unchanged_maps_are_not_drawn_again():
    scene = ViewedMaps()
    scene.take(taken(sounds((0, 0, 0, -40.0))))
    first, second = scene.draw(MAPS), scene.draw(MAPS)
    assert first.sensors["front"].picture is second.sensors["front"].picture
    assert first.sensors["front"].shape is second.sensors["front"].shape
    scene.clear()
    assert scene.draw(MAPS).sensors == {}


class MapSource(Source):
    shows_maps = True


def test_page_has_controls_of_maps():
    source = MapSource()
    source.waiting = [taken(sounds((10, 0, 0, -51.3), (20, 0, 1, -57.0)), time_s=100.0)]
    with Viewer(source, port=0, choices=MAPS) as view:
        assert "points" not in acked_through(view)
        controls = view._page._level_controls  # noqa: SLF001  what the page shows
        assert (controls._slider.max, controls._slider.value, controls._highest.value) == (2, 0, -50)  # noqa: SLF001
        assert re.findall(r"data-band='([^']+)'", controls._levels.content) == [  # noqa: SLF001
            "all bands",
            "22.4 kHz",
            "31.6 kHz",
        ]
        for request in (("band_hz", 30e3), ("max_level_db", -30.0), ("max_level_db", 199.0)):
            view._orders.put(ControlRequest(*request))  # noqa: SLF001  as a browser does
        acked_through(view)
        assert (view.choices.band_hz, view.choices.max_level_db) == (30e3, -30.0)
        assert view._frame.scale.bands[2].is_shown  # noqa: SLF001
        source.waiting = [taken(sounds(band_hz=np.array([[1e3, 2e3]])), time_s=100.1)]
        acked_through(view)
        assert controls._slider.max == 1  # noqa: SLF001


def test_camera_does_not_depend_on_the_order_of_sensors():
    maps = [
        taken(sounds((0, 0, 0, -40.0), sensor=name), Pose((x, 0.0, 0.0)), 100.0)
        for name, x in (("front", 0.2), ("back", -0.2))
    ]
    cameras = []
    for groups in ([maps], [maps[:1], maps[1:]]):
        source = MapSource()
        with Viewer(source, port=0) as view:
            for group in groups:
                source.waiting = group
                acked_through(view)
            cameras.append(view._page._server.initial_camera)  # noqa: SLF001  where the page puts it
    np.testing.assert_array_equal(cameras[0].position, cameras[1].position)
    assert cameras[0].far == cameras[1].far


def passive_noise(count, *, behaviour="passive", averages=1):
    settings = SMALL.replace(**{"passive.averages": averages})
    return [
        Measurement(each.data, settings, replace(each.stamp, behaviour=behaviour)) for each in noise(settings, count)
    ]


def test_passive_recording_is_played_as_maps(tmp_path):
    path = write_recording(tmp_path / "rec.h5", passive_noise(3))
    with open_recording(path) as recording, AcousticCamera(recording.settings, "cpu", check=False) as camera:
        wanted = list(camera.process_many(recording))
    with Playback(path, device="cpu") as playback:
        assert playback.shows_maps
        assert playback.notes() == []
        for place, each in enumerate(wanted):
            (shown,) = playback.at(place)
            np.testing.assert_array_equal(shown.image.power, each.power)
            assert shown.image.stamp == each.stamp
        view = Viewer(playback, port=0)
        with view:
            wait_for(lambda: view.run(duration_s=0.05) or view.shown)
            assert isinstance(view._frame.sensors["eRTIS-7"].shape, Sector)  # noqa: SLF001
    with Playback(path, device="cpu", acoustic_maps=False) as playback:
        assert not playback.shows_maps


def test_averages_of_a_recording_do_not_depend_on_the_order(tmp_path):
    path = write_recording(tmp_path / "rec.h5", passive_noise(5, averages=3))
    with open_recording(path) as recording, AcousticCamera(recording.settings, "cpu", check=False) as camera:
        wanted = []
        for last in range(5):
            camera.reset()
            for each in range(last - last % 3, last + 1):
                camera.add(recording[each])
            wanted.append(camera.map())
    with Playback(path, device="cpu") as playback:
        for place in (0, 1, 2, 3, 4, 1, 1, 2, 4, 0):
            (shown,) = playback.at(place)
            np.testing.assert_array_equal(shown.image.power, wanted[place].power)
            assert shown.image.n_measurements == place % 3 + 1


def test_maps_of_measurements_with_a_call_are_noted(tmp_path):
    path = write_recording(tmp_path / "rec.h5", passive_noise(1, behaviour="active"))
    with Playback(path, device="cpu") as playback:
        assert not playback.shows_maps
    with Playback(path, device="cpu", acoustic_maps=True) as playback:
        assert playback.notes() == ["sensor eRTIS-7 emits its call; acoustic maps leave out the time of the call"]
        assert playback.at(0)[0].image.masked_s > SMALL.call.duration_s


def test_file_of_acoustic_maps_is_played(tmp_path):
    maps = [sounds((10, 0, 0, -40.0 - number), sequence=number) for number in range(2)]
    path = write_acoustic_maps(tmp_path / "maps.h5", maps)
    with Playback(path) as playback:
        assert playback.shows_maps
        np.testing.assert_array_equal(playback.at(1)[0].image.power, maps[1].power)


def test_other_content_than_that_of_the_file_is_refused(tmp_path):
    images = write_energyscapes(tmp_path / "img.h5", stamped(1))
    with pytest.raises(ArgumentError, match=r"img\.h5 holds images only; choose a recording for others"):
        Playback(images, acoustic_maps=True)
    maps = write_acoustic_maps(tmp_path / "maps.h5", [sounds()])
    with pytest.raises(ArgumentError, match=r"maps\.h5 holds acoustic maps only; choose a recording for others"):
        Playback(maps, acoustic_maps=False)


def test_live_maps_are_those_of_the_camera():
    sent = [measurement(number, sensor=name) for number in range(3) for name in ("front", "left")]
    sent = [Measurement(each.data, each.settings, replace(each.stamp, behaviour="active")) for each in sent]
    seen = {}
    with Publisher() as publisher, publisher.playing(sent), Live(publisher.address, acoustic_maps=True) as live:

        def come():
            seen.update({each.image.stamp.sensor: each for each in live.take()})
            return {each.image.stamp.sequence for each in seen.values()} == {2} and len(seen) == 2

        wait_for(come)
        assert live.dropped == 0
        notes = wait_for(lambda: [*live.notes()])
    assert sum("emits its call" in note for note in notes) >= 1
    for each in seen.values():
        (original,) = (one for one in sent if one.stamp.sensor == each.image.stamp.sensor and one.stamp.sequence == 2)
        with AcousticCamera(original.settings.replace(**{"processing.mode": "passive"}), check=False) as camera:
            np.testing.assert_allclose(each.image.power, camera.process(measured(camera, original)).power, rtol=1e-5)
        assert each.pose.translation_m == Publisher.translation_m


def measured(camera, original):
    return Measurement(original.data, camera.settings, original.stamp)


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("IMG", "--acoustic-maps"), "holds images only; choose a recording for others"),
        (("REC", "--range", "1:2"), "--range is for images; remove it with acoustic maps"),
        (("REC", "--threshold", "-3"), "--threshold is for images; remove it with acoustic maps"),
        (("REC", "--images", "--band", "30000"), "--band is for acoustic maps; remove it with images"),
        (("IMG", "--max-level", "-30"), "--max-level is for acoustic maps; remove it with images"),
        (("tcp://127.0.0.1:5602", "--band", "30000"), "--band is for acoustic maps; remove it with images"),
        (("REC", "--band", "0"), "--band is 0; use a number from 1 to"),
        (("REC", "--max-level", "199"), "--max-level is 199; use a number from -160 to 160"),
    ],
)
def test_options_without_effect_are_refused(tmp_path, arguments, reported):
    named = {
        "IMG": write_energyscapes(tmp_path / "img.h5", [spot(0, 1.0)]),
        "REC": write_recording(tmp_path / "rec.h5", passive_noise(1)),
    }
    words = [str(named.get(word, word)) for word in arguments]
    done = CliRunner().invoke(cli, ["view", *words, "--port", "0", "--no-open", "--duration", "0.1"])
    assert done.exit_code != 0
    assert reported in f"{done.stderr} {done.exception}"


def test_maps_of_a_recording_are_saved_as_a_page(tmp_path):
    path = write_recording(tmp_path / "rec.h5", passive_noise(2))
    page = tmp_path / "page.html"
    command = ["view", str(path), "--save-html", str(page), "--device", "cpu", "--band", "40000", "--max-level", "-20"]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 0, (done.stderr, done.exception)
    assert "latest image: dBFS" in page.read_text()


def test_view_notes_directions_that_a_map_cannot_show():
    notes, found = ResultNotes(), sounds((0, 0, 0, -20.0))
    assert any("front has directions at one elevation, 0°" in text for text in notes.of(found))
    assert not list(notes.of(found))

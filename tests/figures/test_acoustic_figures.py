"""Plots of acoustic maps, spectra and spectrograms show levels where they are, and in the right unit."""

import dataclasses
import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from PIL import Image
from scipy.signal import welch

import ertis_numba as ertis
from ertis_numba import figures
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.figures import _acoustic_signals
from ertis_numba.figures.style import angle
from ertis_numba.frames import Bearing, Stamp
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.geometry.air import absorption_db_m, transmission_loss_db
from ertis_numba.settings import Settings
from tests.passive.test_acoustic_camera import settings_of, sound
from tests.publishing import image

BANDS_HZ = np.array([[20e3, 25e3], [25e3, 31.5e3]])
LOUD_DEG = (24.0, 12.0)
OTHER_KIND = "does not support maps.h5, a file of acoustic maps; use --kind acoustic_map or spectrum, or its recording"


def acoustic_map(directions="3d:800", *, sensitivity_dbfs=None, method="delay_and_sum"):
    """Return a map with a lobe at 24, 12 degrees in its first band, and one at -40, 0 degrees in its second."""
    settings = Settings().replace(**{"processing.directions": directions, "passive.method": method})
    settings = settings.replace("array.sensitivity_dbfs", sensitivity_dbfs)
    grid = direction_grid(settings.processing)
    looks = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    power = []
    for place_deg, peak in ((LOUD_DEG, 1e-4), ((-40.0, 0.0), 1e-5)):
        place = unit_vectors(*np.radians(place_deg).reshape(2, 1))[0]
        power.append(peak * np.exp(60 * (looks @ place - 1)) + 1e-12)
    stamp = Stamp(sensor="eRTIS-7", sequence=3, behaviour="passive")
    return ertis.AcousticMap(
        np.stack(power, axis=1).astype(np.float32), grid.azimuth_rad, grid.elevation_rad, BANDS_HZ, settings, stamp
    )


def brightest(axes):
    """Return the position of the highest level of a raster in the coordinates of its axes."""
    raster = axes.images[-1]
    row, column = np.unravel_index(np.nanargmax(raster.get_array().filled(np.nan)), raster.get_array().shape)
    left, right, bottom, top = raster.get_extent()
    n_rows, n_columns = raster.get_array().shape
    return left + (column + 0.5) / n_columns * (right - left), bottom + (row + 0.5) / n_rows * (top - bottom)


def texts(figure):
    return " ".join(text.get_text() for text in figure.texts)


@pytest.mark.parametrize(("band_hz", "place_deg", "level"), [(None, LOUD_DEG, -40), ((25e3, 30e3), (-40, 0), -50)])
def test_map_shows_the_level_of_a_band_in_each_direction(band_hz, place_deg, level):
    figure = figures.acoustic_map(acoustic_map(), band_hz=band_hz, dynamic_range_db=30)
    axes, bar = figure.axes
    assert brightest(axes) == pytest.approx(place_deg, abs=4.0)  # directions are about 5 degrees apart
    assert axes.images[-1].get_clim() == pytest.approx((level - 30, level), abs=0.5)
    assert bar.get_ylabel() == "dBFS"
    assert "eRTIS-7" in texts(figure)
    assert ("25–31.5 kHz" if band_hz else "20–31.5 kHz") in texts(figure)


def bearing(azimuth_deg, elevation_deg, band_hz, level_dbfs, **other):
    known = {"sideways_deg": 0.2, "upwards_deg": 0.3, "correlation": 0.0, "snr_db": 5.0} | other
    places = {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg, "band_hz": tuple(band_hz)}
    return Bearing(**places, level_dbfs=level_dbfs, **known)


def test_rings_and_caption_of_a_map_are_those_of_its_bearings():
    heard = (bearing(24.3, 12.2, BANDS_HZ[0], -41.2), bearing(-30.0, 2.0, BANDS_HZ[0], -50.0))
    other = bearing(-40.0, 0.5, BANDS_HZ[1], -51.0, may_be_crosstalk=True)
    found = acoustic_map().replace(bearings=(*heard, other), false_alarm=1e-3)
    figure = figures.acoustic_map(found, band_hz=(20e3, 25e3))
    assert "loudest source at azimuth +24.3°, elevation +12.2°: −41.2 dBFS" in texts(figure)
    rings = [(ring.get_xdata()[0], ring.get_ydata()[0]) for ring in figure.axes[0].lines]
    assert np.array(rings) == pytest.approx(np.array([(24.3, 12.2), (-30.0, 2.0)]), abs=1e-6)
    assert len(figures.acoustic_map(found).axes[0].lines) == 3
    assert "−51.0 dBFS, may be crosstalk" in texts(figures.acoustic_map(found, band_hz=(25e3, 30e3)))


def test_map_without_sources_has_no_ring():
    figure = figures.acoustic_map(acoustic_map().replace(false_alarm=1e-3))
    assert not figure.axes[0].lines
    assert "no source found" in texts(figure)


@pytest.mark.parametrize("directions", ["3d:800", "2d:361"])
def test_caption_of_a_map_without_bearings_states_its_loudest_direction(directions):
    found = acoustic_map(directions)
    (loudest, _) = found.loudest()
    figure = figures.acoustic_map(found, band_hz=(20e3, 25e3))
    towards = f"azimuth {angle(np.degrees(loudest.azimuth_rad))}, elevation {angle(np.degrees(loudest.elevation_rad))}"
    assert f"loudest direction: {towards}: −{-loudest.level_dbfs:.1f} dBFS" in texts(figure)


def test_labels_of_maps_keep_clear_of_the_edges():
    figure = figures.acoustic_map(acoustic_map())
    around = figure.axes[0].get_tightbbox(figure.canvas.get_renderer())
    margin = 0.008 * figure.bbox.width
    assert around.x0 > margin
    assert around.y0 > margin


def test_maps_of_several_measurements_name_the_last():
    assert "eRTIS-7 · measurement 3" in texts(figures.acoustic_map(acoustic_map()))
    averaged = texts(figures.acoustic_map(acoustic_map().replace(n_measurements=3)))
    assert "eRTIS-7 · up to measurement 3" in averaged
    assert "mean of 3 measurements" in averaged


def test_levels_are_sound_pressures_if_the_sensitivity_is_known():
    figure = figures.acoustic_map(acoustic_map(sensitivity_dbfs=-26.0))
    assert figure.axes[1].get_ylabel() == "dB re 20 µPa"
    assert figure.axes[0].images[-1].get_clim()[1] == pytest.approx(-40 + 94 + 26 + 3, abs=0.5)


def test_source_levels_are_shown_if_the_distance_is_known():
    found = acoustic_map(sensitivity_dbfs=-26.0)
    found = found.replace(settings=found.settings.replace("passive.focus_m", 3.0))
    loss_db = transmission_loss_db(found.settings.air, 3.0, found.centre_hz)
    figure = figures.acoustic_map(found, band_hz=(25e3, 30e3))
    assert figure.axes[1].get_ylabel() == "dB re 20 µPa at 1 m"
    assert figure.axes[0].images[-1].get_clim()[1] == pytest.approx(-50 + 94 + 26 + 3 + loss_db[1], abs=0.5)
    (axes,) = figures.spectrum(found, direction_deg=LOUD_DEG).axes
    assert axes.get_ylabel() == "level of a band (dB re 20 µPa at 1 m)"
    first = axes.patches[0]
    assert first.get_y() + first.get_height() == pytest.approx(-40 + 94 + 26 + 3 + loss_db[0], abs=0.5)


def test_spectra_of_a_direction_have_source_levels():
    heard = sound(settings_of(array__sensitivity_dbfs=-26.0, passive__focus_m=2.0), [(20, 0.1)])
    (mean,) = figures.spectrum(heard).axes
    (beam,) = figures.spectrum(heard, direction_deg=(20.0, 0.0)).axes
    assert mean.get_ylabel() == "level of a bin (dB re 20 µPa)"
    assert beam.get_ylabel() == "level of a bin (dB re 20 µPa at 1 m)"
    frequency_khz, level_db = beam.lines[0].get_data()
    loudest = level_db.argmax()
    loss_db = transmission_loss_db(heard.settings.air, 2.0, 1e3 * frequency_khz[[loudest]])[0]
    assert level_db[loudest] - mean.lines[0].get_ydata()[loudest] == pytest.approx(loss_db, abs=0.5)


def test_plots_leave_out_source_levels_that_absorption_hides():
    found = acoustic_map(sensitivity_dbfs=-26.0)
    absorbed_db_m = absorption_db_m(found.settings.air, found.centre_hz)
    between_m = 60 / absorbed_db_m.mean()  # The air absorbs less than 60 dB in the lower band, and more in the upper.
    found = found.replace(settings=found.settings.replace("passive.focus_m", float(between_m)))
    assert figures.acoustic_map(found).axes[1].get_ylabel() == "dB re 20 µPa"
    assert figures.acoustic_map(found, band_hz=(20e3, 25e3)).axes[1].get_ylabel() == "dB re 20 µPa at 1 m"
    (axes,) = (figure := figures.spectrum(found)).axes
    assert axes.get_ylabel() == "level of a band (dB re 20 µPa at 1 m)"
    assert "without frequencies of which the air absorbs over 60 dB" in texts(figure)
    assert [np.isfinite(bar.get_height()) for bar in axes.patches] == [True, False]
    far = found.replace(settings=found.settings.replace("passive.focus_m", 10_000.0))
    assert figures.acoustic_map(far).axes[1].get_ylabel() == "dB re 20 µPa"
    assert figures.spectrum(far).axes[0].get_ylabel() == "level of a band (dB re 20 µPa)"


def test_spectra_leave_out_source_levels_that_absorption_hides():
    settings = settings_of(array__sensitivity_dbfs=-26.0, passive__focus_m=50.0)
    heard = sound(settings, [(20, 0.1)])
    (beam,) = figures.spectrum(heard, direction_deg=(20.0, 0.0)).axes
    frequency_khz, level_db = beam.lines[0].get_data()
    is_heard = 50.0 * absorption_db_m(settings.air, 1e3 * frequency_khz) <= 60
    np.testing.assert_array_equal(np.isfinite(level_db), is_heard)
    assert 0 < np.count_nonzero(is_heard) < len(is_heard)
    for figure in (figures.spectrum, figures.spectrogram):
        beam, mean = texts(figure(heard, direction_deg=(20.0, 0.0))), texts(figure(heard))
        assert ["without frequencies of which" in each for each in (beam, mean)] == [True, False]


def test_maps_of_music_do_not_depend_on_the_distance():
    """Their numbers have no reference, so a transmission loss must not weight the bands."""
    near = acoustic_map("2d:91", sensitivity_dbfs=-26.0, method="music")
    far = near.replace(settings=near.settings.replace("passive.focus_m", 10.0))
    near_db, far_db = (figures.acoustic_map(each).axes[0].lines[0].get_ydata() for each in (near, far))
    np.testing.assert_array_equal(near_db, far_db)


def test_maps_of_music_are_relative():
    figure = figures.acoustic_map(acoustic_map(method="music"))
    assert figure.axes[1].get_ylabel() == "dB re strongest"
    assert figure.axes[0].images[-1].get_clim() == (-20, 0)


def test_map_of_one_elevation_is_a_line():
    found = acoustic_map("2d:91")
    (axes,) = figures.acoustic_map(found, band_hz=(20e3, 25e3)).axes
    azimuth_deg, level_db = axes.lines[0].get_data()
    assert np.all(np.diff(azimuth_deg) > 0)
    assert axes.get_xlim()[0] > axes.get_xlim()[1]  # positive azimuths are on the left
    expected_db = 10 * np.log10(found.power[np.argsort(found.azimuth_rad), 0])
    assert level_db == pytest.approx(np.maximum(expected_db, expected_db.max() - 20), abs=1e-3)
    assert axes.get_ylabel() == "level (dBFS)"


@pytest.fixture
def photo(tmp_path):
    """Picture that is red in its upper left quarter."""
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:20, :30, 0] = 255
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    return tmp_path / "photo.png"


def test_map_lies_over_a_photo_as_a_pinhole_camera_sees_it(photo):
    figure = figures.acoustic_map(acoustic_map(), photo=photo, photo_fov_deg=(90, 60), dynamic_range_db=20)
    axes = figure.axes[0]
    azimuth_rad, elevation_rad = np.radians(LOUD_DEG)
    seen = math.tan(azimuth_rad), math.tan(elevation_rad) / math.cos(azimuth_rad)
    assert brightest(axes) == pytest.approx(seen, abs=0.09)  # about 5 degrees
    background, raster = axes.images
    assert (
        tuple(background.get_extent())
        == tuple(raster.get_extent())
        == pytest.approx((1.0, -1.0, -math.tan(math.radians(30)), math.tan(math.radians(30))))
    )
    assert axes.get_xlim() == pytest.approx((1.0, -1.0))
    alpha = raster.get_alpha()
    assert 0.3 < alpha.max() < 0.8
    floor_db = raster.get_clim()[0]
    assert alpha[raster.get_array().filled(-1e3) < floor_db + 0.01].max() == pytest.approx(0, abs=0.01)
    figure.canvas.draw()
    page = np.asarray(figure.canvas.buffer_rgba()).astype(int)
    box = axes.get_window_extent()
    top = page.shape[0] - int(box.y1)
    corner = page[top + 12, int(box.x0) + 12]
    assert corner[0] > 150 > corner[2]  # the upper left of the picture


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"band_hz": "x"}, ArgumentError, "band_hz is 'x'; use two numbers, the smaller one first"),
        ({"band_hz": (30e3, "x")}, ArgumentError, r"band_hz is 'x'; use a number"),
        ({"band_hz": (30e3, 20e3)}, ArgumentError, "band_hz runs from 30000 to 20000"),
        (
            {"photo": "x.png", "photo_fov_deg": 60},
            ArgumentError,
            "photo_fov_deg is 60; pass the angles of width",
        ),
        ({"band_hz": (1e3, 2e3)}, ArgumentError, "no band lies within 1000 to 2000 Hz"),
        ({"photo_fov_deg": (60, 40)}, ArgumentError, "photo and photo_fov_deg belong together; use"),
        ({"photo": "none.png", "photo_fov_deg": (60, 180)}, ArgumentError, r"photo_fov_deg\[1\] is 180"),
        ({"photo": "none.png", "photo_fov_deg": (60, 40)}, DataError, "none.png: No such file or directory; choose"),
        (
            {"photo": __file__, "photo_fov_deg": (60, 40)},
            DataError,
            "not a readable picture; open it in another program, and save it",
        ),
        ({"dynamic_range_db": 0}, ArgumentError, "dynamic_range_db"),
    ],
)
def test_arguments_of_maps_that_cannot_be_drawn_are_refused(changes, error, words):
    with pytest.raises(error, match=words):
        figures.acoustic_map(acoustic_map(), **changes)


def test_flat_maps_have_no_photo_and_single_directions_no_map(photo):
    with pytest.raises(ArgumentError, match="have one elevation, which a photo cannot show"):
        figures.acoustic_map(acoustic_map("2d:31"), photo=photo, photo_fov_deg=(60, 40))
    with pytest.raises(ArgumentError, match="has one direction; draw its spectrum"):
        figures.acoustic_map(acoustic_map([[0.0, 0.0]]))
    for draw in (figures.acoustic_map, figures.spectrum, figures.spectrogram):
        with pytest.raises(ArgumentError, match="is of type int"):
            draw(3)


@pytest.mark.parametrize(("direction_deg", "place_deg"), [(None, LOUD_DEG), ((-40.0, 0.0), (-40.0, 0.0))])
def test_spectrum_of_a_map_has_the_level_of_each_band(direction_deg, place_deg):
    found = acoustic_map()
    figure = figures.spectrum(found, direction_deg=direction_deg, dynamic_range_db=60)
    (axes,) = figure.axes
    looks = unit_vectors(found.azimuth_rad, found.elevation_rad)
    place = np.argmax(looks @ unit_vectors(*np.radians(place_deg).reshape(2, 1))[0])
    top_db = 10 * np.log10(found.power[place].max())
    bars = axes.patches
    expected = np.maximum(10 * np.log10(found.power[place]), top_db - 60)
    assert [bar.get_y() + bar.get_height() for bar in bars] == pytest.approx(expected, abs=1e-3)
    assert [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars] == [(20, 25), (25, 31.5)]


def test_power_spectra_are_those_of_scipy():
    random = np.random.default_rng(3)
    values, rate_hz = random.standard_normal((2, 5000)).astype(np.float32), 90e3
    power, frequency_hz, time_s = _acoustic_signals.power_spectra(values, rate_hz)
    expected_hz, density = welch(
        values.astype(float), rate_hz, "hann", nperseg=90, noverlap=90 - 22, detrend=False, scaling="density"
    )
    assert frequency_hz == pytest.approx(expected_hz)
    assert power.mean(axis=1) == pytest.approx(density.mean(axis=0) * frequency_hz[1], rel=1e-4)
    assert power.sum(axis=0).mean() == pytest.approx(float((values**2).mean()), rel=0.02)
    assert (time_s[0], time_s[-1]) == pytest.approx((45 / rate_hz, (5000 - 45) / rate_hz), abs=22 / rate_hz)
    with pytest.raises(ArgumentError, match="has 50 samples, but a spectrum needs 90; record longer"):
        _acoustic_signals.power_spectra(values[:, :50], rate_hz)


def test_spectra_of_long_records_are_means():
    values = np.random.default_rng(4).standard_normal((1, 100_000)).astype(np.float32)
    power, _, time_s = _acoustic_signals.power_spectra(values, 90e3)
    assert len(time_s) <= 1000
    assert np.all(np.diff(time_s) > 0)
    assert power.sum(axis=0).mean() == pytest.approx(float((values**2).mean()), rel=0.02)


def test_spectrum_and_spectrogram_show_a_source():
    settings = settings_of()
    measurement = sound(settings, [(20, 0.1)], noise=0.02)
    rate_hz = settings.recording.sample_rate_hz
    density = (0.1**2 + 0.02**2) / (rate_hz / 2)
    (axes,) = figures.spectrum(measurement).axes
    frequency_khz, level_db = axes.lines[0].get_data()
    inside = (frequency_khz > 20) & (frequency_khz < 40)
    expected_db = 10 * np.log10(density * 1e3 * (frequency_khz[1] - frequency_khz[0]))
    assert level_db[inside].mean() == pytest.approx(expected_db, abs=0.5)
    levels = {}
    for azimuth_deg in (20, -50):
        figure = figures.spectrogram(measurement, direction_deg=(azimuth_deg, 0.0), dynamic_range_db=60)
        raster = figure.axes[0].images[-1].get_array()
        rows = slice(*(round(edge_khz / frequency_khz[1]) for edge_khz in (20, 40)))
        levels[azimuth_deg] = float(raster[rows].mean())
        assert figure.axes[1].get_ylabel() == "dBFS in a bin"
        assert f"beam to azimuth {'+20°' if azimuth_deg > 0 else '−50°'}" in texts(figure)
    assert levels[20] > levels[-50] + 3


@pytest.mark.parametrize(
    ("method", "name"),
    [
        ("delay_and_sum", "delay-and-sum"),
        ("functional", "functional beamforming"),
        ("capon", "Capon"),
        ("music", "MUSIC"),
        ("clean_sc", "CLEAN-SC"),
        ("hr_clean_sc", "HR-CLEAN-SC"),
    ],
)
def test_captions_name_methods_as_the_field_does(method, name):
    assert f"method {name}" in texts(figures.acoustic_map(acoustic_map(method=method)))


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"beamformer": "dmas"}, "method fast, DMAS"),
        ({"beamformer": "capon", "weighting": "coherence_factor"}, "method fast, Capon, coherence factor"),
    ],
)
def test_captions_of_images_name_beamformers_as_the_field_does(changes, name):
    found = image(1)
    processing = found.settings.processing.replace(**changes)
    assert name in texts(figures.polar(found.replace(settings=found.settings.replace(processing=processing))))


@pytest.mark.parametrize(("behaviour", "is_named"), [("passive", False), ("active", True), ("unknown", True)])
def test_captions_name_the_call_unless_none_was_emitted(behaviour, is_named):
    heard = sound(settings_of(), [(20, 0.1)])
    heard = dataclasses.replace(heard, stamp=Stamp(sensor="ring", behaviour=behaviour))
    for figure in (figures.spectrum(heard), figures.spectrogram(heard), figures.signals(heard)):
        assert ("· call 25" in texts(figure)) == is_named
        assert ("· no call" in texts(figure)) != is_named


def test_spectra_leave_out_the_time_of_a_call():
    settings = settings_of()
    measurement = sound(settings, [(20, 0.01)])
    loud = measurement.data.copy()
    n_call = int((settings.call.end_s + 0.0005) * settings.recording.sample_rate_hz)
    loud[:n_call] += np.sin(np.arange(n_call) * 0.8)[:, None].astype(np.float32)
    highest, begins_ms = {}, {}
    for behaviour in ("passive", "active"):
        heard = ertis.Measurement(loud, settings, ertis.Stamp(behaviour=behaviour))
        (axes,) = figures.spectrum(heard).axes
        highest[behaviour] = axes.lines[0].get_ydata().max()
        figure = figures.spectrogram(heard)
        begins_ms[behaviour] = figure.axes[0].get_xlim()[0]
        assert ("ms are left out" in texts(figure)) == (behaviour == "active")
    assert highest["active"] < highest["passive"] - 10
    assert begins_ms["passive"] < 1 < 1e3 * settings.call.end_s < begins_ms["active"]


def run(line, *, code=0):
    done = CliRunner().invoke(cli, line.split())
    assert done.exit_code == code, (done.output, done.exception)
    return done


@pytest.fixture
def folder(tmp_path, monkeypatch, photo):
    assert photo.exists()
    monkeypatch.chdir(tmp_path)
    heard = [
        dataclasses.replace(sound(settings_of(), [(20, 0.1)]), stamp=Stamp(sequence=number, behaviour=behaviour))
        for number, behaviour in enumerate(("passive", "active"))
    ]
    ertis.write_recording("rec.h5", heard)
    ertis.write_acoustic_maps("maps.h5", [acoustic_map()])
    return tmp_path


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("maps.h5", "acoustic_map"),
        ("maps.h5 --band 20000:26000 --photo photo.png --photo-fov 60,40 --dynamic-range 20", "acoustic_map"),
        ("rec.h5", "acoustic_map"),
        ("rec.h5 -m 1 --kind acoustic_map", "acoustic_map"),
        ("rec.h5 -m 1 --kind spectrum", "spectrum"),
        ("maps.h5 --kind spectrum --steer 24:12 --theme paper", "spectrum"),
        ("rec.h5 --kind spectrogram --steer 20:0", "spectrogram"),
    ],
)
def test_kinds_of_sound_are_plotted(line, kind):
    done = run(f"plot {line} -o plot.png --json")
    report = json.loads(done.stdout)
    counted = "map" if line.startswith("maps.h5") else "measurement"
    assert (report["kind"], report[counted]) == (kind, int("-m 1" in line))
    assert f"plot.png: {counted} " in done.stderr
    with Image.open("plot.png") as picture:
        assert len(picture.convert("RGB").resize((200, 200)).getcolors(40_000)) > 20


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("line", "message", "code"),
    [
        ("maps.h5 --kind spectrum --band 1:2", "--band is for --kind acoustic_map; remove it with spectrum", 2),
        ("maps.h5 --peaks 3", "--peaks is for --kind image", 2),
        ("maps.h5 --photo photo.png --photo-fov 60", "'60' is not a field of view; use two angles", 2),
        ("maps.h5 --photo photo.png", "--photo needs --photo-fov AZ,EL", 2),
        ("maps.h5 --photo-fov 60,40", "--photo-fov needs --photo PICTURE", 2),
        ("maps.h5 --band 1:2", "no band lies within 1 to 2 Hz", 1),
        ("maps.h5 --kind spectrogram", f"--kind spectrogram {OTHER_KIND}", 2),
        ("maps.h5 --kind polar", f"--kind polar {OTHER_KIND}", 2),
        ("maps.h5 -m 5", "--measurement is 5; use", 1),
    ],
)
def test_plots_of_sound_that_cannot_be_drawn_are_refused(line, message, code):
    done = CliRunner().invoke(cli, f"plot {line} -o plot.png".split())
    assert message in done.stderr
    assert done.exit_code == code

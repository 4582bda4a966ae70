"""Objects as HTML in notebooks: complete, valid, escaped, and without numbers that are not known."""

import dataclasses
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.frames import doubt_notes
from ertis_numba.notebook import html_of
from tests.figures.test_acoustic_figures import acoustic_map, bearing
from tests.pages import ROOT
from tests.publishing import image

HOSTILE = "<script>alert('x')</script>&\""
VOID = {"img", "meta", "br", "hr"}


class Page(HTMLParser):
    """The elements and texts of a page, which must be closed in order."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.images, self.cells = [], [], [], []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attrs))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in {"td", "th", "p", "b", "pre"}:
            self.cells.append(data)

    @property
    def text(self):
        return " | ".join(self.cells)


def shown(thing):
    return Page(thing._repr_html_())


@pytest.fixture
def recording():
    with ertis.open_recording(ROOT / "data" / "synthetic" / "reflectors.h5") as opened:
        yield opened


@pytest.fixture
def without_figures(monkeypatch):
    """Matplotlib cannot be imported, so the room of figures cannot either."""
    monkeypatch.setitem(sys.modules, "ertis_numba.figures", None)
    monkeypatch.delattr(ertis, "figures", raising=False)


def test_image_has_a_picture_axes_and_its_reflectors():
    page = shown(image(3, reflectors=[(20.0, 1.5, 0.1), (-30.0, 2.0, 0.05)]))
    (drawn,) = page.images
    assert drawn["src"].startswith("data:image/png;base64,")
    assert drawn["alt"] == "Energyscape · front · measurement 3 · 2023-11-14 22:13:20.300 UTC"
    assert "σ range (mm)" in page.cells
    assert {"(direction, range)", "31 × 625", "-90 to 90 °", "0.5 to 2.996 m"} <= {*page.cells}
    first = page.cells.index("1")
    azimuth_deg, range_m = float(page.cells[first + 1]), float(page.cells[first + 3])
    assert azimuth_deg == pytest.approx(20.0, abs=0.5)
    assert range_m == pytest.approx(1.5, abs=1e-3)


def test_image_lists_the_reflectors_of_the_peaks_command():
    two = image(reflectors=[(20.0, 1.5, 0.1), (-30.0, 2.0, 0.05)])
    rows = [f"{peak.range_m:.3f}" for peak in ertis.find_peaks(two, top=10, false_alarm=1e-3)]
    assert len(rows) == 2
    assert [cell for cell in shown(two).cells if cell in rows] == rows


def test_image_of_noise_has_no_reflectors():
    rng = np.random.default_rng(1)
    empty = image()
    noise = rng.normal(size=(2, *empty.amplitude.shape)).astype(np.float32)
    page = shown(empty.replace(amplitude=1e-4 * np.hypot(*noise)))
    assert "no echo above the noise" in page.cells
    assert page.images


def test_silent_image_has_no_reflectors():
    assert "no echo above the noise" in shown(image().replace(amplitude=0 * image().amplitude)).cells


def test_image_with_nan_has_neither_reflectors_nor_a_picture():
    amplitude = image().amplitude.copy()
    amplitude[3, 4] = np.nan
    page = shown(image().replace(amplitude=amplitude))
    assert "Reflectors are unknown" in page.text
    assert "no echo" not in page.text
    assert not page.images
    assert "with NaN or infinity" in page.cells


def test_empty_image_has_neither_reflectors_nor_a_picture():
    empty = image().replace(amplitude=image().amplitude[:, :0], range_m=image().range_m[:0])
    page = shown(empty)
    assert "Reflectors are unknown: there are no values" in page.cells
    assert not page.images


def test_points_with_nan_are_not_listed():
    cloud = ertis.PointExtractor(image().settings)(image(reflectors=[(20.0, 1.5, 0.1)]))
    for name in ("position_m", "amplitude"):
        page = shown(cloud.replace(**{name: np.nan * getattr(cloud, name)}))
        assert "Points are unknown: values contain NaN or infinity" in page.cells
        assert not page.images
        assert "x (m)" not in page.cells


def test_map_with_nan_has_no_picture():
    page = shown(acoustic_map().replace(power=np.nan * acoustic_map().power))
    assert "Note: no picture: values contain NaN or infinity" in page.cells
    assert not page.images


def test_angles_that_an_array_cannot_observe_are_unknown():
    single = image(reflectors=[(0.0, 1.5, 0.1)])
    array = single.settings.array.replace(disabled=tuple(range(1, 32)))
    page = shown(single.replace(settings=single.settings.replace(array=array)))
    first = page.cells.index("1")
    assert page.cells[first + 1 : first + 3] == ["–", "–"]
    assert "its images show ranges but no directions" in page.text


def test_points_have_a_picture_and_their_deviations():
    page = shown(ertis.PointExtractor(image().settings)(image(reflectors=[(20.0, 1.5, 0.1)])))
    assert page.images
    assert {"x (m)", "σ across (mm)", "(point, axis)"} <= {*page.cells}


def test_points_of_the_network_say_that_deviations_are_unknown():
    cloud = ertis.PointExtractor(image().settings)(image(reflectors=[(20.0, 1.5, 0.1)]))
    page = shown(cloud.replace(uncertainty_m=None))
    assert "standard deviations are unknown" in page.text
    assert "σ across (mm)" not in page.cells


def test_no_points_have_no_picture():
    cloud = ertis.PointExtractor(image().settings)(image().replace(amplitude=0 * image().amplitude))
    page = shown(cloud)
    assert not len(cloud)
    assert not page.images
    assert "no point" in page.cells


def test_map_has_a_picture_and_says_that_sources_were_not_searched():
    page = shown(acoustic_map())
    assert page.images
    assert "sources were not searched; ertis.BearingFinder finds them" in page.cells
    assert "20000 to 31500 Hz" in page.cells


def test_map_lists_its_sources():
    source = {"azimuth_deg": 24.0, "elevation_deg": 12.0, "sideways_deg": 0.123, "correlation": 0.0, "snr_db": 9.0}
    found = ertis.Bearing(**source, upwards_deg=np.inf, band_hz=(20e3, 25e3), level_dbfs=-40.0)
    page = shown(acoustic_map().replace(bearings=(found,), false_alarm=1e-3))
    first = page.cells.index("1")
    assert page.cells[first : first + 9] == ["1", "20.0", "25.0", "+24.00", "0.12", "–", "–", "-40.0", "9.0"]


def test_doubtful_source_is_marked_and_noted_as_by_the_command():
    sources = [
        bearing(24.0, 12.0, (20e3, 25e3), -40.0, may_be_crosstalk=True),
        bearing(0.0, 0.0, (25e3, 31e3), -50.0, sideways_deg=np.inf, upwards_deg=np.inf),
    ]
    page = shown(acoustic_map().replace(bearings=tuple(sources), false_alarm=1e-3))
    assert page.cells.count("crosstalk?") == 1
    assert {f"Note: {text}" for text in doubt_notes(sources)} <= {*page.cells}
    assert len(doubt_notes(sources)) == 2


def test_map_without_sources_has_none():
    assert "no source found" in shown(acoustic_map().replace(false_alarm=1e-3)).cells


def test_recording_has_a_picture_and_its_contents(recording):
    page = shown(recording)
    assert page.images
    assert {"measurements", "163840 samples at 4500 kHz, 36.4089 ms", "50 to 25 kHz in 2.5 ms"} <= {*page.cells}


def test_closed_recording_has_no_picture(recording):
    recording.close()
    page = shown(recording)
    assert not page.images
    assert "measurements cannot be read" in page.text


def test_settings_have_a_picture_and_every_key():
    page = shown(ertis.Settings())
    assert page.images
    assert "[processing]" in page.text


def test_settings_without_their_layout_file_have_no_picture():
    page = shown(ertis.Settings().replace("array.layout", f"{HOSTILE}.toml"))
    assert not page.images
    assert "No picture" in page.text


def test_texts_are_escaped(recording):
    stamp = ertis.Stamp(sensor=HOSTILE)
    hostile = image(reflectors=[(20.0, 1.5, 0.1)]).replace(stamp=stamp)
    recording.sensor = HOSTILE
    things = (
        hostile,
        ertis.PointExtractor(hostile.settings)(hostile),
        acoustic_map().replace(stamp=stamp),
        recording,
        ertis.Settings().replace("array.layout", HOSTILE),
    )
    for thing in things:
        page = shown(thing)
        assert "script" not in page.tags
        assert HOSTILE in page.text


@pytest.mark.usefixtures("without_figures")
def test_without_matplotlib_the_rest_is_shown(recording):
    for thing in (image(reflectors=[(20.0, 1.5, 0.1)]), acoustic_map(), recording, ertis.Settings()):
        page = shown(thing)
        assert not page.images
        assert "No picture" in page.text
        assert len(page.cells) > 10


def test_other_types_have_no_view():
    with pytest.raises(TypeError, match="ndarray has no view"):
        html_of(np.zeros(3))


def test_unconfirmed_points_are_named():
    cloud = ertis.PointExtractor(image().settings)(image(reflectors=[(20.0, 1.5, 0.1), (-30.0, 2.0, 0.05)]))
    fused = cloud.replace(confirmed=np.zeros(len(cloud), np.bool_))
    assert "1 point left out because too few pairs" in shown(fused).text
    assert "1 point left out because too few pairs" in shown(dataclasses.replace(image(), points=fused)).text

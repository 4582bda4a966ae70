"""Each kind of plot shows its content in place, in each theme, with one microphone and with many."""

import functools
import io
import itertools

import matplotlib.text
import matplotlib.transforms
import numpy as np
import pytest

from ertis_numba import figures
from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _images, _slices
from ertis_numba.figures._captions import of_image, of_measurement
from ertis_numba.frames import Measurement, Peak, Stamp
from ertis_numba.geometry import direction_grid
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Array, Processing, Recording, Settings
from tests.cases import words_of
from tests.files import image
from tests.promises import best_ratio

STAMP = Stamp(sensor="eRTIS-7", sequence=12, timestamp_ns=1_700_000_000_123_456_789)
SETTINGS = Settings(recording=Recording(n_samples=81_920), processing=Processing(range_m=(0.5, 2.4)))
ONE = Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=32)
ARRAYS = {1: ONE, 32: Array()}
LOOKS = {
    "dark": {},
    "one column": {"theme": "paper", "columns": 1},
    "two columns": {"theme": "paper", "font": "serif"},
}
PEAKS = [
    Peak(azimuth_deg=20.0 + turn, elevation_deg=3.0, range_m=2.5 + turn / 50, level_db=-2.0 * turn) for turn in range(7)
]


def heard(n_mics=32, delay_s=9e-3, *, settings=SETTINGS):
    """Measurement of one call that reaches all microphones simultaneously."""
    settings = settings.replace(array=ARRAYS[n_mics])
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    signal = 0.5 * call_at(settings.call, time_s - delay_s)
    return Measurement(words_of(np.broadcast_to(signal, (n_mics, len(signal)))), settings, STAMP)


def solid(count=300, settings=None, **more):
    """Hemisphere of speckle."""
    grid = direction_grid(Processing(directions=f"3d:{count}", azimuth_limits_deg=(-80.0, 80.0)))
    more = {"settings": settings} if settings else more
    return image(np.degrees(grid.azimuth_rad), np.degrees(grid.elevation_rad), **more).replace(stamp=STAMP)


@functools.cache
def pictures(n_mics):
    """Each kind of plot by its name."""
    settings = SETTINGS.replace(array=ARRAYS[n_mics])
    planar, hemisphere = image().replace(stamp=STAMP, settings=settings), solid(settings=settings)
    measurement = heard(n_mics)
    marks = {"peaks": PEAKS}
    return {
        "plot": lambda **look: figures.plot(planar, **marks, **look),
        "plot, hemisphere": lambda **look: figures.plot(hemisphere, **marks, **look),
        "plot, one direction": lambda **look: figures.plot(image([12.0]), **look),
        "polar": lambda **look: figures.polar(hemisphere, **look),
        "polar, narrow": lambda **look: figures.polar(image(np.linspace(-40, 40, 9)), **marks, **look),
        "polar, all around": lambda **look: figures.polar(image(np.linspace(-180, 180, 73)), **look),
        "projection": lambda **look: figures.projection(hemisphere, **marks, **look),
        "slices": lambda **look: figures.slices(hemisphere, **marks, **look),
        "slices, planar": lambda **look: figures.slices(planar, **marks, **look),
        "slices, upright": lambda **look: figures.slices(image(np.zeros(26), np.linspace(-60, 90, 26)), **look),
        "polar, behind": lambda **look: figures.polar(image(np.arange(100, 261, 10)), **look),
        "polar, 5 mm": lambda **look: figures.polar(image(range_m=np.linspace(5e-4, 5e-3, 50)), **look),
        "signals": lambda **look: figures.signals(measurement, **look),
        "matched filter": lambda **look: figures.matched_filter(measurement, **look),
        "array": lambda **look: figures.array(settings, **look),
        "array, steered": lambda **look: figures.array(
            settings, frequencies_hz=[20e3, 40e3, 80e3, 90e3], azimuth_deg=-30, elevation_deg=20, **look
        ),
    }


KINDS = {
    "plot": {32: LOOKS},
    "plot, hemisphere": {32: LOOKS},
    "plot, one direction": {32: ("dark", "one column")},
    "polar": {32: LOOKS},
    "polar, narrow": {32: ("one column",)},
    "polar, all around": {32: ("one column",)},
    "projection": {32: LOOKS},
    "slices": {32: LOOKS},
    "slices, planar": {32: ("dark", "one column")},
    "slices, upright": {32: ("one column", "two columns")},
    "polar, behind": {32: ("one column",)},
    "polar, 5 mm": {32: ("one column",)},
    "signals": {1: ("one column",), 32: LOOKS},
    "matched filter": {1: ("one column",), 32: LOOKS},
    "array": {1: ("one column", "two columns"), 32: LOOKS},
    "array, steered": {32: LOOKS},
}
"""Numbers of microphones, and looks. Variants of a kind have one look on a narrow page, and one on a wide page if they
have panels beside each other there."""


def texts_of(figure):
    """All texts of a figure with their boxes in points."""
    for axes in figure.axes:
        for drawn in (*axes.images, *axes.collections):
            drawn.set_visible(False)  # takes most of the time
    figure.draw_without_rendering()
    found = [*figure.texts]
    for axes in figure.axes:
        found += [*axes.texts, axes.title]
        if axes.get_legend():
            found += [*axes.get_legend().get_texts(), axes.get_legend().get_title()]
        if axes.axison:
            for axis in (axes.xaxis, axes.yaxis):
                low, high = sorted(axis.get_view_interval())
                found += [axis.label]
                found += [
                    tick.label2 if tick.label2.get_visible() else tick.label1
                    for tick in axis.get_major_ticks()
                    if low - 1e-9 <= tick.get_loc() <= high + 1e-9
                ]
    shown = [text for text in found if text.get_visible() and text.get_text().strip()]
    scale = 72 / figure.dpi
    boxes = [matplotlib.text.Text.get_window_extent(text) for text in shown]  # of a note without its arrow
    return [
        (text.get_text(), matplotlib.transforms.Bbox(box.get_points() * scale))
        for text, box in zip(shown, boxes, strict=True)
    ]


@pytest.mark.parametrize(
    ("kind", "n_mics", "look"),
    [(kind, count, look) for kind, counts in KINDS.items() for count, looks in counts.items() for look in looks],
)
def test_texts_of_pictures_are_legible_and_complete(monkeypatch, kind, n_mics, look):
    """No text overlaps another or leaves the page, all axes have units, and captions have the significant settings."""
    monkeypatch.setattr(_images, "PIXELS", 250)  # the rasters are not drawn
    monkeypatch.setattr(_slices, "_PIXELS", 50)
    figure = pictures(n_mics)[kind](**LOOKS[look])
    texts = texts_of(figure)
    require_places(figure, texts)
    if look == "dark":  # no caption is wrapped within its words
        require_units_and_settings(kind, figure, texts)


def require_places(figure, texts):
    """Fail if a text overlaps another or leaves the page."""
    width_pt, height_pt = 72 * figure.get_size_inches()
    assert len(texts) > 8
    for text, box in texts:
        assert box.x0 >= -0.5, text
        assert box.y0 >= -0.5, text
        assert box.x1 <= width_pt + 0.5, text
        assert box.y1 <= height_pt + 0.5, text
    for (first, ours), (second, theirs) in itertools.combinations(texts, 2):
        across = min(ours.x1, theirs.x1) - max(ours.x0, theirs.x0)
        up = min(ours.y1, theirs.y1) - max(ours.y0, theirs.y0)
        assert min(across, up) < 0.75, (first, second)


def require_units_and_settings(kind, figure, texts):
    """Fail if axes have no unit or the caption lacks a significant setting."""
    for axes in figure.axes:
        if axes.axison:
            labels = [label for label in (axes.get_xlabel(), axes.get_ylabel()) if label]
            assert labels
            assert all("(" in label or "dB" in label for label in labels), labels
    heading = " ".join(text.get_text() for text in figure.texts)
    wanted = ["eRTIS_v3D1", "20 °C"]
    if not kind.startswith("array"):
        wanted += ["call 25–50 kHz, 2.5 ms", " m"]
    if not kind.startswith(("array", "plot, one")):
        wanted += ["eRTIS-7", "measurement 12", "2023-11-14 22:13:20.123 UTC"]
    if kind.startswith(("plot", "projection", "slices")):
        wanted += ["method fast", "error up to −35 dB"]
    assert all(word in heading for word in wanted), heading
    assert any("dB" in text for text, _ in texts)


def test_picture_without_echoes_states_this():
    stated = [[text.get_text() for text in figures.plot(image(), peaks=peaks).texts] for peaks in ([], None)]
    assert ["no echo above the noise" in texts for texts in stated] == [True, False]


@pytest.mark.parametrize("timestamp_ns", [0, 50_000_000, 5 * 10**9, 946_684_800 * 10**9 - 1])
def test_times_of_unset_clocks_are_omitted(timestamp_ns):
    """Simulations count from 0, and a board without a clock from 1970."""
    stamp = Stamp(sequence=1, timestamp_ns=timestamp_ns)
    for heading in (
        of_image(image().replace(stamp=stamp)),
        of_measurement("Signals", SETTINGS, stamp, values=np.ones(1)),
    ):
        assert "measurement 1" in heading.title
        assert not any("UTC" in part for part in heading.settings)


def test_printed_sizes_match_the_documentation():
    """They are 85 and 170 mm wide, with letters of 6 to 8 points in black on white."""
    for columns, width_mm in ((1, 85.0), (2, 170.0)):
        figure = figures.plot(image(), theme="paper", columns=columns, font="serif", peaks=PEAKS)
        assert figure.get_size_inches()[0] * 25.4 == pytest.approx(width_mm)
        sizes = {text.get_fontsize() for text in [*figure.texts, *figure.axes[0].texts]}
        assert min(sizes) >= 6
        assert max(sizes) <= 8
        assert matplotlib.colors.to_hex(figure.get_facecolor()) == "#ffffff"
        assert figure.texts[0].get_fontfamily() == ["STIXGeneral"]


@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_picture_files_are_small_and_reproducible(kind):
    """Coloured areas are stored as images, and letters of a PDF as text."""

    def saved(figure):
        file = io.BytesIO()
        figures.save(figure, file, format=kind)
        return file.getvalue()

    areas = pictures(32)["plot, hemisphere"](theme="paper", columns=1)
    for text in areas.findobj(matplotlib.text.Text):
        text.set_visible(False)  # takes most of the time and hardly any bytes
    figure = pictures(32)["matched filter"](theme="paper", columns=1)
    files = [saved(areas), saved(figure), saved(figure)]
    assert files[1] == files[2]
    assert max(map(len, files)) < 1_400_000  # of noise, which cannot be compressed
    if kind == "pdf":
        assert b"/Type0" in files[1]  # TrueType, as journals ask for, not outlines


@pytest.mark.parametrize("draw", [figures.plot, figures.slices, figures.projection])
def test_large_images_are_drawn_within_five_imports(draw):
    big = solid(3000, range_m=np.linspace(0.5, 5.0, 1178))
    once = lambda: figures.save(draw(big, peaks=PEAKS), io.BytesIO(), format="png")  # noqa: E731
    assert best_ratio(once, times=3, promised=5) < 5


@pytest.mark.parametrize("draw", [figures.signals, figures.matched_filter])
def test_recordings_are_drawn_within_five_imports(draw):
    measurement = heard(settings=Settings.from_preset("default_25_50"))
    once = lambda: figures.save(draw(measurement), io.BytesIO(), format="png")  # noqa: E731
    assert best_ratio(once, times=3, promised=5) < 5


@pytest.mark.parametrize(
    ("draw", "match"),
    [
        (lambda: figures.plot(image(), theme="drak"), "theme 'drak' is unknown "),
        (lambda: figures.plot(image(), font="comic"), "font 'comic' is unknown; known are sans, serif"),
        (lambda: figures.plot(image(), theme="paper", columns=3), "columns '3' is unknown; known are 1, 2"),
        (lambda: figures.plot(image(), columns=1), "columns is 1, which theme 'dark' does not have; use theme 'paper'"),
        (lambda: figures.slices(image(), height_m=3.0), "height_m is 3, where the image shows nothing; use a plane"),
        (lambda: figures.slices(image(), left_m=np.nan), "left_m is nan; use a finite number"),
        (lambda: figures.slices(image(), left_m=0.0), "left_m is 0, but a planar image has no upright plane; leave it"),
        (
            lambda: figures.plot(heard()),
            "image is of type Measurement; pass an Energyscape, which Pipeline.process returns",
        ),
        (lambda: figures.polar(Settings()), "image is of type Settings; pass an "),
        (lambda: figures.signals(image()), "measurement is of type Energyscape; pass a Measurement, which a recording"),
        (lambda: figures.matched_filter(image()), "measurement is of type Energyscape; pass a "),
        (
            lambda: figures.array(image()),
            "settings is of type Energyscape; pass a Settings, which Settings.load reads, or ",
        ),
        (lambda: figures.array("eRTIS_v3D2"), "layout 'eRTIS_v3D2' is unknown "),
        (lambda: figures.array(Settings(), frequencies_hz=40e3), r"is 40000.0; pass a list, such as \[40e3\]"),
        (lambda: figures.save(figures.array("uRTIS_v1"), "x"), "x ends in none of .pdf, .png and .svg; use such a na"),
        (
            lambda: figures.save(figures.array("uRTIS_v1"), io.BytesIO()),
            "an open file has no name that states a format; set format",
        ),
        (lambda: figures.save(figures.array("uRTIS_v1"), "x", format="gif"), "format 'gif' is unknown.*known are pdf"),
        (lambda: figures.slices(solid(), left_m=9.0), "left_m is 9, where the image shows nothing"),
        (
            lambda: figures.signals(heard(), microphone=32),
            "microphone 32 is none of the 32 enabled ones; use a number from",
        ),
        (lambda: figures.matched_filter(heard(), microphone=-1), "microphone is -1; use a whole number of at least 0"),
        (lambda: figures.array(Settings(), frequencies_hz=[]), "frequencies_hz holds 0 frequencies; use 1 to 5"),
        (lambda: figures.array(Settings(), frequencies_hz=[0.0]), "frequencies_hz is 0; use a number above 0"),
        (lambda: figures.array(Settings(), azimuth_deg=91), "azimuth_deg is 91; use a number from -90 to 90"),
        (lambda: figures.array(Settings(), dynamic_range_db=0), "dynamic_range_db is 0; use a number above 0"),
    ],
)
def test_plot_kinds_refuse_invalid_arguments(draw, match):
    with pytest.raises(ArgumentError, match=match):
        draw()

"""The live view as users have it: a process that serves a page, and a real browser without a network."""

import io
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import plyfile
import pytest
from PIL import Image
from scipy import ndimage, signal as filters
from scipy.spatial import KDTree

from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import JournalEntry
from ertis_numba.network.sensor_node import SensorNode
from ertis_numba.passive import AcousticCamera
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording, Settings
from ertis_numba.simulation import Scene, Sensor
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.targets import Point
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from ertis_numba.viewer import Choices, Polar, ReceivedImage, ViewedMaps
from ertis_numba.viewer._choices import colour_table
from tests.network.test_serve import LOOPBACK, serving
from tests.passive.test_acoustic_camera import settings_of, sound
from tests.views import stamped

REFLECTORS = Path("data/synthetic/reflectors.h5")
TABLE = colour_table("inferno").astype(int)
TIMEOUT_S = 60.0
RATE_HZ = 5.0
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
# A picture that is replaced while it is being decoded is refused once, and then decoded again.
DECODED = """async image => {
    while (!await image.decode().then(() => true, () => false)) await new Promise(requestAnimationFrame)
    return image.naturalWidth
}"""
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", OFFLINE),
)


class Page:
    """Page of the viewer in a browser that blocks external requests and records them."""

    def __init__(self, browser, url):
        self.context = browser.new_context(
            viewport={"width": 1300, "height": 760}, device_scale_factor=1, accept_downloads=True
        )
        self.abroad = []
        self.context.route(lambda asked: not self.is_here(asked, url), self.refuse)
        self.page = self.context.new_page()
        self.page.set_default_timeout(1e3 * TIMEOUT_S)
        self.page.on("websocket", lambda asked: self.is_here(asked.url, url) or self.abroad.append(asked.url))
        self.page.goto(url)

    @staticmethod
    def is_here(asked, url):
        here = url if url.startswith("file:") else re.escape(url.removeprefix("http:").partition("?")[0].rstrip("/"))
        if url.startswith("file:"):
            return asked == here or asked.startswith(("blob:", "data:"))
        return re.match(rf"(blob:http|http|ws):?{here}(/|$)".replace(":?//", "://"), asked) or asked.startswith("data:")

    def refuse(self, route):
        self.abroad.append(route.request.url)
        route.abort()

    def reported(self, name):
        return self.page.inner_text(f"[data-name={name}]")

    def wait_until(self, name, condition):
        """Wait until ``text`` fulfils a condition in JavaScript."""
        cell = f"document.querySelector('[data-name={name}]')"
        self.page.wait_for_function(f"() => {{ const text = {cell}?.innerText ?? ''; return {condition} }}")

    def control(self, label):
        """The control beside a label."""
        return self.page.locator("label", has_text=label).locator("xpath=ancestor::div[.//input or .//div[@id]][1]")

    def slide(self, label, value):
        box = self.control(label).locator("input:not([type=hidden])").last
        box.fill(str(value))
        box.press("Enter")

    def press(self, label):
        self.page.get_by_role("button", name=label, exact=True).click()

    def picture(self):
        """The first picture as shown, and its scale in drawn pixels."""
        shown = self.page.locator("img").first
        drawn_px = shown.evaluate(DECODED)
        pixels = np.asarray(Image.open(io.BytesIO(shown.screenshot())).convert("RGB")).astype(int)
        return pixels, pixels.shape[1] / drawn_px

    def saved(self, label):
        with self.page.expect_download() as download:
            self.press(label)
        return Path(download.value.path()).read_bytes(), download.value.suggested_filename

    def close(self):
        self.context.close()
        assert self.abroad == []


@pytest.fixture(scope="module")
def browser():
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None and not os.environ.get("CI"):
        pytest.skip("there is no Chromium; install it (apt-get install chromium)")
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - a slow import

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def viewing(*arguments):
    """Process of ``ertis view``, and the address of its page."""
    command = [sys.executable, "-m", "ertis_cli", "view", *map(str, arguments)]
    command += ["--port", "0", "--no-open", "--quiet", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(Path("cli").absolute())}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            line = process.stdout.readline()
            assert line, process.stderr.read()
            yield process, json.loads(line)["url"]
        finally:
            process.kill()


@pytest.fixture(scope="module")
def playback(browser, tmp_path_factory):
    """Page of a file with three images of the same reflectors."""
    with open_recording(REFLECTORS) as recording, Pipeline(recording.settings) as pipeline:
        image = pipeline.process(recording[0])
    several = [
        image.replace(stamp=Stamp(sequence=number, timestamp_ns=round(1e18 + number * 1e8))) for number in range(3)
    ]
    path = write_energyscapes(tmp_path_factory.mktemp("film") / "img.h5", several)
    with viewing(path) as (_, url):
        page = Page(browser, url)
        page.image = image
        page.wait_until("state", "text.startsWith('0.20 s')")
        yield page
        page.close()


def reflectors():
    (sensor,) = json.loads(REFLECTORS.with_suffix(".json").read_text())["sensors"]
    return sensor["reflectors"]


def spots(playback):
    """Reflectors in the first picture: x, y and level of each, in drawn pixels."""
    pixels, zoom = playback.picture()
    away, levels = KDTree(TABLE).query(pixels[: -round(66 * zoom)])  # but for the scale of colours
    levels[away > 25] = 0
    joined = ndimage.binary_closing(levels > 205, np.ones((3, 3)))
    regions, count = ndimage.label(joined, np.ones((3, 3)))
    found = []
    for number in range(1, count + 1):
        level = levels[regions == number].max()
        rows, columns = np.nonzero((regions == number) & (levels >= level - 3))
        found.append(((columns.mean() + 0.5) / zoom, (rows.mean() + 0.5) / zoom, level))
    return found


def eventually(holds):
    end_s = time.monotonic() + TIMEOUT_S
    while not holds():
        assert time.monotonic() < end_s, "it never was"


def test_drawn_reflectors_match_the_scene(playback):
    polar = Polar(playback.image)
    places = [(*polar.place_of(x, y), level) for x, y, level in spots(playback)]
    assert len(places) == len(reflectors())
    for each in reflectors():
        found = min(places, key=lambda place: abs(place[1] - each["range_m"]))
        assert found[0] == pytest.approx(each["azimuth_deg"], abs=1.0)
        assert found[1] == pytest.approx(each["range_m"], abs=0.02)
        assert found[2] == pytest.approx(255 * (1 + each["level_db"] / 40), abs=6)


def test_a_higher_threshold_leaves_fewer_points(playback):
    playback.slide("Dynamic range (dB)", 5)  # which cannot be
    playback.slide("Dynamic range (dB)", 40)
    playback.slide("Threshold (dB)", -30)
    playback.wait_until("points", "Number(text) >= 5")
    many = int(playback.reported("points"))
    playback.slide("Threshold (dB)", -1)
    playback.wait_until("points", f"Number(text) < {many}")
    assert int(playback.reported("points")) == sum(each["level_db"] > -1 for each in reflectors())


def test_range_window_moves_the_axes(playback):
    slider = playback.control(re.compile("^Range"))
    thumb = slider.locator(".multi-slider-thumb").last
    box, track = thumb.bounding_box(), slider.locator(".multi-slider-track").bounding_box()
    y = box["y"] + box["height"] / 2
    playback.page.mouse.move(box["x"] + box["width"] / 2, y)
    playback.page.mouse.down()
    playback.page.mouse.move(track["x"] + 0.4 * track["width"], y, steps=4)
    playback.page.mouse.up()
    # The window now ends at 2 m of 5: what is nearer lies 2.5 times as far from the sensor as before.
    polar = Polar(playback.image)
    foot_px = np.array(polar.pixel_of(0, 0))
    near = [each for each in reflectors() if each["range_m"] < 1.9]
    wanted = [foot_px + 2.5 * (polar.pixel_of(each["azimuth_deg"], each["range_m"]) - foot_px) for each in near]

    def moved():
        places = [place[:2] for place in spots(playback)]
        return len(places) == len(near) and all(
            np.linalg.norm(places - place, axis=1).min() < 0.05 * np.linalg.norm(place - foot_px) for place in wanted
        )

    eventually(moved)


def test_time_line_selects_the_shown_image(playback):
    playback.slide("Measurement", 1)
    playback.wait_until("sequence", "text === '1'")
    playback.press("back")
    playback.wait_until("sequence", "text === '0'")
    shown = int(playback.reported("frames"))
    playback.press("Play")
    playback.wait_until("state", "text.startsWith('0.20 s')")
    assert int(playback.reported("frames")) > shown
    assert playback.reported("captured") == "2001-09-09 01:46:40.200 UTC"


def test_chosen_colour_map_is_used(playback):
    playback.control("Colours").locator("input:not([type=hidden])").first.click()
    playback.page.get_by_role("option", name="viridis").click()
    wanted = colour_table("viridis")[255].astype(int)
    eventually(lambda: np.abs(playback.picture()[0] - wanted).sum(axis=2).min() < 40)


def test_saved_page_can_be_opened(playback, browser, tmp_path):
    picture, name = playback.saved("Picture (PNG)")
    assert name == "img.png"
    image = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))
    assert image.shape[1] == 520
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100
    playback.slide("Threshold (dB)", -1)
    playback.wait_until("points", "Number(text) === 2")
    points, name = playback.saved("Points (PLY)")
    assert name == "img.ply"
    vertex = plyfile.PlyData.read(io.BytesIO(points))["vertex"]
    assert len(vertex) == 2
    strongest = max(reflectors(), key=lambda each: each["level_db"])
    azimuth = math.radians(strongest["azimuth_deg"])
    wanted = (strongest["range_m"] * math.cos(azimuth), strongest["range_m"] * math.sin(azimuth), 0.0)
    nearest = min(np.linalg.norm([vertex["x"][i] - wanted[0], vertex["y"][i] - wanted[1]]) for i in range(2))
    assert nearest < 0.02
    playback.press("Begin HTML recording")
    playback.press("Play")
    playback.wait_until("state", "text.startsWith('0.20 s')")
    recording, name = playback.saved("End HTML recording")
    assert name == "img.html"
    (tmp_path / name).write_bytes(recording)
    page = Page(browser, (tmp_path / name).as_uri())
    page.page.wait_for_selector("canvas")

    def is_drawn():
        """Return True if the image on the ground is present, by its unique colours."""
        drawn = np.asarray(Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")).astype(int)
        return (np.ptp(drawn, axis=2) > 60).sum() > 200

    eventually(is_drawn)
    page.close()


def simulated():
    """Measurement of a reflector by a sensor."""
    processing = Processing(directions="2d:61", range_m=(0.5, 1.2))
    sensor = Sensor(name="front", recording=Recording(n_samples=40_960), processing=processing)
    return Simulator(Scene(sensors=(sensor,), points=(Point(azimuth_deg=20.0, range_m=0.9),))).render(0)


@contextmanager
def measuring(address, measured):
    """Sensor node that sends a measurement repeatedly until the block ends."""
    words = measured.data
    settings = Settings(recording=measured.settings.recording, processing=measured.settings.processing)
    ended = threading.Event()

    def measure(node):
        number = 0
        while not ended.wait(1 / RATE_HZ):
            stamp = Stamp(sensor="front", sequence=number, sync_count=number, session_id=3, timestamp_ns=time.time_ns())
            node.append([JournalEntry(Measurement(words, settings, stamp), time.monotonic_ns())])
            number += 1

    with SensorNode(address) as node:
        node.add_sensor("front", settings, translation_m=(0.2, 0.0, 0.0))
        thread = threading.Thread(target=measure, args=(node,))
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


LAG = """() => new Promise(resolve => {
    const lags = [], cell = document.querySelector('[data-name=captured]');
    let last = cell.innerText;
    const look = () => {
        if (cell.isConnected && cell.innerText !== last) last = cell.innerText;
        const now = document.querySelector('[data-name=captured]').innerText;
        if (now !== look.before) {
            look.before = now;
            lags.push((Date.now() - Date.parse(now.replace(' UTC', 'Z').replace(' ', 'T'))) / 1000);
        }
        lags.length > 6 ? resolve(lags.slice(1)) : setTimeout(look, 5);
    };
    look();
})"""


@pytest.mark.alone
def test_live_view_lags_less_than_a_second(browser):
    with ExitStack() as stack:
        measured = stack.enter_context(ThreadPoolExecutor()).submit(simulated)  # while the processes start
        served = stack.enter_context(serving(*LOOPBACK, "--workers", "1", "--device", "cpu"))
        process, url = stack.enter_context(viewing(served.publish))
        live = Page(browser, url)
        stack.enter_context(measuring(served.listen, measured.result()))
        live.wait_until("frames", "Number(text) > 1")
        first = int(live.reported("frames"))
        lags_s = live.page.evaluate(LAG)
        assert int(live.reported("frames")) >= first + 6
        assert 0 < np.median(lags_s) < 1, lags_s
        assert 0 < float(live.reported("latency").removesuffix(" ms")) < 1000
        assert live.reported("state") == "live"
        assert float(live.reported("rate").removesuffix(" Hz")) > 1
        assert live.reported("dropped").startswith("0, ")  # at the beginning some come faster than tables are made
        assert int(live.reported("points")) >= 1
        live.press("Pause")
        live.page.get_by_role("button", name="Play", exact=True).wait_for()
        shown, sequence = int(live.reported("frames")), int(live.reported("sequence"))
        live.press("Step")
        live.wait_until("frames", f"Number(text) === {shown + 1}")
        assert int(live.reported("sequence")) > sequence
        live.press("Play")
        live.wait_until("frames", f"Number(text) > {shown + 1}")
        begun_s = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(TIMEOUT_S) == 0, process.stderr.read()
        assert time.monotonic() - begun_s < 1
        live.close()


def passive_recording(path):
    """Recording with low sound from the left and high sound from the right, and its map."""
    settings = settings_of()
    rate_hz = settings.recording.sample_rate_hz
    low, high = sound(settings, [(40, 0.01)], seed=1), sound(settings, [(-20, 0.02)], seed=2)
    data = filters.sosfiltfilt(filters.butter(8, 26e3, fs=rate_hz, output="sos"), low.data, axis=0)
    data += filters.sosfiltfilt(filters.butter(8, 28e3, "high", fs=rate_hz, output="sos"), high.data, axis=0)
    made = Measurement(data.astype(np.float32), settings, Stamp(sensor="front", behaviour="passive"))
    write_recording(path, [made])
    with AcousticCamera(settings, "cpu", check=False) as camera:
        return camera.process(made)


def test_band_slider_and_levels_choose_the_shown_map(browser, tmp_path):
    found = passive_recording(tmp_path / "rec.h5")
    scene = ViewedMaps()
    scene.take(ReceivedImage(found, None, 0.0))

    def picture_of(**choices):
        return scene.draw(Choices(dynamic_range_db=20, **choices)).sensors["front"].picture

    pictures = {
        "all": picture_of(),
        "low": picture_of(band_hz=22e3),
        "high": picture_of(band_hz=35e3),
        "fixed": picture_of(band_hz=35e3, max_level_db=-20.0),
    }
    with viewing(tmp_path / "rec.h5") as (_, url):
        page = Page(browser, url)

        def shown():
            """Name of the picture that is most similar to the shown one."""
            pixels, _ = page.picture()
            size = pixels.shape[1::-1]
            expected = {name: np.asarray(Image.fromarray(each).resize(size), int) for name, each in pictures.items()}
            return min(expected, key=lambda name: np.abs(pixels - expected[name]).mean())

        page.wait_until("frames", "Number(text) > 0")
        eventually(lambda: shown() == "all")
        rows = page.page.locator("tr[data-band]").all_inner_texts()
        assert [row.split("\t")[0] for row in rows] == ["all bands", "22.4 kHz", "34.6 kHz"]
        for row, loudest in zip(rows[1:], found.loudest(), strict=True):
            level, direction = row.split("\t")[2:]
            assert float(level.replace("−", "-")) == pytest.approx(loudest.level_dbfs, abs=0.06)
            assert float(direction.replace("−", "-").rstrip("°")) == pytest.approx(
                math.degrees(loudest.azimuth_rad), abs=0.6
            )
        page.slide(re.compile("^Band"), 1)
        eventually(lambda: shown() == "low")
        page.slide(re.compile("^Band"), 2)
        eventually(lambda: shown() == "high")
        page.slide("Max. level (dB)", -20)
        eventually(lambda: shown() == "fixed")
        page.page.get_by_role("checkbox").check()
        eventually(lambda: shown() == "high")
        page.close()


def test_each_browser_has_its_own_recording(playback, browser):
    other = Page(browser, playback.page.url)
    begin, end = (
        other.page.get_by_role("button", name=f"{word} HTML recording", exact=True) for word in ("Begin", "End")
    )
    other.page.get_by_text("at most 256 MB", exact=True).wait_for()
    playback.press("Begin HTML recording")
    playback.page.get_by_text(re.compile(r"^\d+\.\d MB, at most 256 MB$")).wait_for()
    begin.wait_for()
    assert end.count() == 0
    begin.click()
    end.wait_for()
    recording, _ = playback.saved("End HTML recording")
    assert b"__VISER_EMBED_DATA__" in recording
    playback.page.get_by_role("button", name="Begin HTML recording", exact=True).wait_for()
    assert end.count() == 1
    other.close()


def test_page_that_other_machines_reach_opens_with_its_token_alone(browser, tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", stamped(1))
    with viewing(path, "--host", "0.0.0.0") as (_, url):
        page = Page(browser, url)
        page.wait_until("state", "text !== ''")
        page.page.goto(url.partition("?")[0])  # the cookie keeps the token
        page.wait_until("state", "text !== ''")
        page.close()
        other = browser.new_context()
        assert other.new_page().goto(url.partition("?")[0]).status == 403
        other.close()

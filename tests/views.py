"""Images, sources and browsers for the tests of the live view."""

import time

import numpy as np

from ertis_numba.frames import Stamp
from ertis_numba.viewer import Pose, ReceivedImage
from ertis_numba.viewer._choices import colour_table
from tests.files import image

TABLE = colour_table("inferno")
PATIENCE_S = 60.0


def spot(azimuth_deg, range_m, *, sensor="front", sequence=0, level=0.5, **stamp):
    """Image with one reflector, smooth enough to lie between directions and ranges."""
    made = image(np.linspace(-90, 90, 91))
    across = (np.degrees(made.azimuth_rad) - azimuth_deg) / 4
    along = (made.range_m - range_m) / 0.012  # Longer ones would be clicks.
    amplitude = made.amplitude * 0.01 + (level * np.exp(-0.5 * (across[:, None] ** 2 + along**2))).astype(np.float32)
    return made.replace(amplitude=amplitude.astype(np.float32), stamp=Stamp(sensor=sensor, sequence=sequence, **stamp))


def taken(made, pose=None, time_s=0.0, interval_s=None):
    return ReceivedImage(made, pose or Pose(), time_s, interval_s)


def brightest(picture):
    """Centre of the pixels of the highest level, without those of the scale below: x, y."""
    away = np.abs(picture.astype(int) - TABLE[255].astype(int)).sum(axis=2)
    rows, columns = np.nonzero(away <= away.min() + 6)
    return columns.mean() + 0.5, rows.mean() + 0.5


def wait_for(reached):
    end_s = time.monotonic() + PATIENCE_S
    while not (found := reached()):
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0)
    return found


def stamped(count, *, sensors=("front",), step_s=0.05):
    return [
        spot(0, 1.0 + number, sensor=name, sequence=number, timestamp_ns=round(1e18 + number * step_s * 1e9) + index)
        for number in range(count)
        for index, name in enumerate(sensors)
    ]


class Client:
    """Browser that requests a file."""

    def __init__(self, number=0):
        self.client_id = number
        self.files, self.notices = [], []

    def send_file_download(self, name, content, *, save_immediately):
        assert save_immediately
        self.files.append((name, content))

    def add_notification(self, title, body, **_):
        self.notices.append((title, body))


class Source:
    """Live source with a clock and images that a test controls."""

    is_playback, shows_maps = False, False
    title, state, connected = "source", "live", True
    dropped = skipped = received = 0

    def __init__(self):
        self.clock_s, self.waiting = 100.0, []

    def notes(self):
        return []

    def take(self):
        came, self.waiting = self.waiting, []
        self.received += len(came)
        return came

    def latency_s(self, _):
        return None


def run_once(view, **options):
    """Run a view until it has processed its pending requests and images."""
    draw = view._draw  # noqa: SLF001  nothing else ends with the drawing

    def draw_and_end(now_s):
        draw(now_s)
        view._ended = True  # noqa: SLF001

    view._draw = draw_and_end  # noqa: SLF001
    try:
        view.run(duration_s=PATIENCE_S, **options)
    finally:
        view._draw, view._ended = draw, False  # noqa: SLF001


def acked_through(view):
    """Let a view draw its pending images, and return its last message."""
    rows = {}
    page = view._page  # noqa: SLF001  what it tells goes to browsers only
    notify = page.notify
    page.notify = lambda reported, *, playing: rows.update(reported) or notify(reported, playing=playing)
    run_once(view)
    view._emit_event()  # noqa: SLF001
    page.notify = notify
    return {name: value for name, (_, value) in rows.items()}

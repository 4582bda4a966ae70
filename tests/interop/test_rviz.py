"""The displays of RViz in ``examples/ertis.rviz`` fit the messages of ``ertis ros``."""

from pathlib import Path

import pytest

from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.interop.ros_messages import MESSAGES, ImageMessages, points_message
from ertis_numba.interop.scans import scan_message
from tests.files import image

yaml = pytest.importorskip("yaml")

CLASSES = {"PointCloud2": "points", "LaserScan": "scan", "Image": "image"}
"""Topics of the display classes of RViz."""

DISPLAYS = yaml.safe_load((Path(__file__).parents[2] / "examples" / "ertis.rviz").read_text("utf-8"))[
    "Visualization Manager"
]


def shown():
    """Displays of topics, with the last part of their class."""
    for display in DISPLAYS["Displays"]:
        if "Topic" in display:
            package, _, name = display["Class"].partition("/")
            assert package == "rviz_default_plugins"
            yield display, name


def test_displays_show_the_topics_of_a_sensor():
    topics = {display["Topic"]["Value"] for display, _ in shown()}
    assert topics == {"/front/points", "/fused/points", "/front/scan", "/front/image"}
    for display, name in shown():
        topic = display["Topic"]["Value"].rpartition("/")[2]
        assert CLASSES[name] == topic
        assert MESSAGES[topic].endswith(f"/msg/{name}")
        # Topics of sensors are reliable, and keep no messages for subscribers that come later.
        policies = display["Topic"]["Reliability Policy"], display["Topic"]["Durability Policy"]
        assert policies == ("Reliable", "Volatile")


def test_points_are_coloured_by_a_field_that_they_have():
    message = points_message(PointFinder()(image(seed=1)))
    names = {field["name"] for field in message["fields"]}
    channels = {display["Channel Name"] for display, name in shown() if name == "PointCloud2"}
    assert channels == {"intensity"} <= names
    assert {"x", "y", "z"} <= names  # The position transformer XYZ reads them.
    assert len(scan_message(image(seed=1))["intensities"]) > 0


def test_frames_are_those_of_the_messages():
    assert DISPLAYS["Global Options"]["Fixed Frame"] == "base_link"
    assert points_message(PointFinder()(image(seed=1)))["header"]["frame_id"] == image(seed=1).stamp.sensor


def test_image_display_covers_the_levels_of_an_image():
    (display,) = [display for display, name in shown() if name == "Image"]
    message = ImageMessages()(image(seed=1))
    assert message["encoding"] == "mono8"
    assert (display["Normalize Range"], display["Min Value"], display["Max Value"]) == (False, 0, 255)

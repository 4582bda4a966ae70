"""Files of the present view: a picture of all sensors, and the points on the platform."""

import io
import tempfile
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.interop._mountings import validated
from ertis_numba.interop._point_files import write_ply
from ertis_numba.interop._points import PointTable
from ertis_numba.viewer._axes import PAGE
from ertis_numba.viewer._shapes import DrawnFrame, Pose

__all__ = ["picture_png", "points_ply"]

_DPI: Final = 100
_HEAD_PX: Final = 34


def picture_png(frame: DrawnFrame) -> bytes:
    """Return the pictures of all sensors below each other, with their names and times, as PNG."""
    drawn = list(frame.sensors.items())
    width_px = max(each.picture.shape[1] for _, each in drawn)
    height_px = sum(each.picture.shape[0] + _HEAD_PX for _, each in drawn)
    figure = Figure(
        figsize=(width_px / _DPI, height_px / _DPI), dpi=_DPI, facecolor="#{:02x}{:02x}{:02x}".format(*PAGE)
    )
    top_px = height_px
    for name, each in drawn:
        late = ["overdue"] if each.overdue else []
        words = " · ".join([name, f"measurement {each.stamp.sequence}", *filter(None, [each.stamp.utc]), *late])
        place = (12 / width_px, (top_px - 12) / height_px)
        figure.text(*place, words, color="#e8eaf0", fontsize=9.5, va="top", parse_math=False)
        top_px -= _HEAD_PX + each.picture.shape[0]
        figure.figimage(each.picture, xo=0, yo=top_px)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=_DPI)
    return file.getvalue()


def points_ply(points: list[tuple[Energyscape, PointCloud, Pose | None]]) -> bytes:
    """Return the points of images on the platform as PLY.

    Points of a sensor with unknown mounting are in its own frame.

    Parameters
    ----------
    points : list of (Energyscape, PointCloud, Pose or None)
        As `ViewedScene.latest` returns them.

    Raises
    ------
    ArgumentError
        There are several sensors, and the mounting of one is unknown.
    """
    mountings = validated(
        {image.stamp.sensor: (pose.translation_m, pose.rotation_xyzw) for image, _, pose in points if pose}
    )
    found = {image.stamp.sensor: cloud for image, cloud, _ in points}  # Only drawn points are saved.
    table = PointTable.from_images(
        [image for image, _, _ in points], lambda image: found[image.stamp.sensor], mountings
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "points.ply"
        write_ply(path, table, text=False)
        return path.read_bytes()

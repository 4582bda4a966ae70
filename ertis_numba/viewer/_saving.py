"""What is shown, as files: a picture of all sensors, and the points on the platform."""

import io
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from ertis_numba.frames import Energyscape
from ertis_numba.interop import export
from ertis_numba.viewer._axes import PAGE
from ertis_numba.viewer._choices import Choices
from ertis_numba.viewer._shapes import Frame, Pose

__all__ = ["picture_png", "points_ply", "time_of"]

_DPI: Final = 100
_HEAD_PX: Final = 34
_SET_NS: Final = 946_684_800 * 10**9  # 2000: clocks that show an earlier time were never set
_MOST_POINTS: Final = 512


def picture_png(frame: Frame) -> bytes:
    """Return the pictures of all sensors below each other, with their names and times, as PNG."""
    drawn = list(frame.sensors.items())
    width_px = max(each.picture.shape[1] for _, each in drawn)
    height_px = sum(each.picture.shape[0] + _HEAD_PX for _, each in drawn)
    figure = Figure(
        figsize=(width_px / _DPI, height_px / _DPI), dpi=_DPI, facecolor="#{:02x}{:02x}{:02x}".format(*PAGE)
    )
    top_px = height_px
    for name, each in drawn:
        words = " · ".join([name, f"measurement {each.sequence}", *time_of(each.timestamp_ns)])
        place = (12 / width_px, (top_px - 12) / height_px)
        figure.text(*place, words, color="#e8eaf0", fontsize=9.5, va="top", parse_math=False)
        top_px -= _HEAD_PX + each.picture.shape[0]
        figure.figimage(each.picture, xo=0, yo=top_px)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=_DPI)
    return file.getvalue()


def points_ply(images: list[tuple[Energyscape, Pose]], choices: Choices) -> bytes:
    """Return the points of images on the platform as PLY, those above the threshold."""
    mounting = {image.stamp.sensor: (pose.translation_m, pose.rotation_xyzw) for image, pose in images}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "points.ply"
        export(
            path,
            [image for image, _ in images],
            file_format="ply",
            mounting=mounting,
            top=_MOST_POINTS,
            min_level_db=choices.threshold_db,
        )
        return path.read_bytes()


def time_of(timestamp_ns: int) -> tuple[str, ...]:
    """Return a time in words, if it is known: simulated clocks begin at 0."""
    if timestamp_ns < _SET_NS:
        return ()
    seconds, nanoseconds = divmod(timestamp_ns, 10**9)
    try:
        moment = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, OSError, ValueError):  # a clock that was never set
        return ()
    return (f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds // 10**6:03d} UTC",)

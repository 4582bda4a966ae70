"""Files of the present view: a picture of all sensors, the points on the platform, and the legend of a saved page."""

import base64
import html
import io
import tempfile
from pathlib import Path
from typing import Final

import matplotlib.image
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.interop._mountings import validated
from ertis_numba.interop._point_files import write_ply
from ertis_numba.interop._points import PointTable
from ertis_numba.viewer._axes import STYLE
from ertis_numba.viewer._shapes import DrawnFrame, Pose

__all__ = ["picture_png", "points_ply", "with_legend"]

_DPI: Final = 100
_HEAD_PX: Final = 34
_MAX_PICTURES: Final = 4
_STYLE: Final = """
#ertis-legend {position: fixed; right: 12px; top: 10px; width: 340px; color: #e8e8ee; font: 13px sans-serif;
  pointer-events: none; z-index: 10}
#ertis-legend h1 {font-size: 16px; margin: 0 0 8px; overflow-wrap: anywhere}
#ertis-legend img {width: 100%; display: block; margin: 2px 0 8px}
"""


def picture_png(frame: DrawnFrame) -> bytes:
    """Return the pictures of all sensors below each other, with their names and times, as PNG."""
    drawn = list(frame.sensors.items())
    width_px = max(each.picture.shape[1] for _, each in drawn)
    height_px = sum(each.picture.shape[0] + _HEAD_PX for _, each in drawn)
    figure = Figure(figsize=(width_px / _DPI, height_px / _DPI), dpi=_DPI, facecolor=STYLE.page)
    top_px = height_px
    for name, each in drawn:
        late = ["overdue"] if each.overdue else []
        words = " · ".join([name, f"measurement {each.stamp.sequence}", *filter(None, [each.stamp.utc]), *late])
        place = (12 / width_px, (top_px - 12) / height_px)
        figure.text(*place, words, color=STYLE.ink, fontsize=9.5, va="top", parse_math=False)
        top_px -= _HEAD_PX + each.picture.shape[0]
        figure.figimage(each.picture, xo=0, yo=top_px)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=_DPI)
    return file.getvalue()


def points_ply(points: list[tuple[Energyscape, PointCloud, Pose | None]]) -> bytes:
    """Return points of `ViewedScene.latest` as PLY: of several mounted sensors, or of one, possibly unmounted."""
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


def with_legend(page: str, title: str, frame: DrawnFrame | None) -> str:
    """Return an HTML page with a legend in its upper right corner: pictures of the frame's first four sensors."""
    unit = "" if frame is None else frame.unit
    sensors = [] if frame is None else [*frame.sensors.items()][:_MAX_PICTURES]
    pictures = "".join(
        f'<div>{html.escape(name)}, latest image: {unit}</div><img alt="levels of directions" '
        f'src="data:image/png;base64,{base64.b64encode(_png(drawn.picture)).decode()}">'
        for name, drawn in sensors
    )
    legend = f'<div id="ertis-legend"><h1>{html.escape(title)}</h1>{pictures}</div>'
    head, _, rest = page.partition("</head>")
    body, _, end = rest.rpartition("</body>")
    named = f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>"
    return f"{head}{named}{body}{legend}</body>{end}"


def _png(picture: NDArray[np.uint8]) -> bytes:
    target = io.BytesIO()
    matplotlib.image.imsave(target, picture, format="png")
    return target.getvalue()

"""Legend of saved pages: a title, and the latest picture of range and azimuth of each sensor."""

import base64
import html
import io
from typing import Final

import matplotlib.image
import numpy as np
from numpy.typing import NDArray

from ertis_numba.viewer._shapes import DrawnFrame

__all__ = ["with_legend"]

_MAX_PICTURES: Final = 4
_STYLE: Final = """
#ertis-legend {position: fixed; right: 12px; top: 10px; width: 340px; color: #e8e8ee; font: 13px sans-serif;
  pointer-events: none; z-index: 10}
#ertis-legend h1 {font-size: 16px; margin: 0 0 8px; overflow-wrap: anywhere}
#ertis-legend img {width: 100%; display: block; margin: 2px 0 8px}
"""


def with_legend(page: str, title: str, frame: DrawnFrame | None) -> str:
    """Return a saved page with a legend in its upper right corner.

    Parameters
    ----------
    page : str
        HTML, with a head and a body.
    title : str
    frame : DrawnFrame or None
        The pictures of its first four sensors are shown; they have colour bars.
    """
    sensors = [] if frame is None else [*frame.sensors.items()][:_MAX_PICTURES]
    pictures = "".join(
        f'<div>{html.escape(name)}, latest image: dB re strongest</div><img alt="range and azimuth" '
        f'src="{_source(drawn.picture)}">'
        for name, drawn in sensors
    )
    legend = f'<div id="ertis-legend"><h1>{html.escape(title)}</h1>{pictures}</div>'
    head, _, rest = page.partition("</head>")
    body, _, end = rest.rpartition("</body>")
    named = f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>"
    return f"{head}{named}{body}{legend}</body>{end}"


def _source(picture: NDArray[np.uint8]) -> str:
    """Return a picture as a data URL."""
    target = io.BytesIO()
    matplotlib.image.imsave(target, picture, format="png")
    return f"data:image/png;base64,{base64.b64encode(target.getvalue()).decode()}"

"""An image of one direction: level over range."""

from matplotlib.figure import Figure

from ertis_numba.figures._canvas import Canvas
from ertis_numba.frames import Energyscape

__all__ = ["draw"]


def draw(canvas: Canvas, image: Energyscape) -> Figure:
    """Draw level over range."""
    figure = canvas.figure(image, width_in=10.0, height_in=5.0)
    axes = figure.add_axes((0.08, 0.12, 0.88, 0.70))
    canvas.style(axes)
    axes.plot(image.range_m, canvas.level_db(image.energy)[0], color=canvas.theme.mark, linewidth=1.0)
    axes.margins(x=0.01)
    axes.set_ylim(-canvas.dynamic_range_db, 3.0)
    axes.set_xlabel("range (m)")
    axes.set_ylabel("dB below the strongest")
    axes.grid(color=canvas.theme.faint, alpha=0.3, linewidth=0.6)
    canvas.mark_peaks(axes, lambda peak: (peak.range_m, peak.level_db))
    return figure

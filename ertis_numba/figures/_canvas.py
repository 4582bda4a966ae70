"""What all pictures share: colours, levels, the words around the image and the marks in it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from ertis_numba.frames import Energyscape, Peak

__all__ = ["THEMES", "Canvas", "Theme", "angle"]

_DPI = 160


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours of a picture; ``colours`` is a perceptually uniform map of Matplotlib."""

    page: str
    ink: str
    faint: str
    mark: str
    colours: str


THEMES = {
    "dark": Theme(page="#0b0d12", ink="#e8eaf0", faint="#9aa0b0", mark="#7fe7ff", colours="inferno"),
    "light": Theme(page="#ffffff", ink="#1b1e26", faint="#5f6573", mark="#00617d", colours="magma_r"),
}


@dataclass(frozen=True, slots=True)
class Canvas:
    """The choices of one `plot`."""

    theme: Theme
    dynamic_range_db: float
    peaks: tuple[Peak, ...]

    def figure(self, image: Energyscape, *, width_in: float, height_in: float) -> Figure:
        """Return an empty page under a heading that says what is seen, and with which settings."""
        title = f"Energyscape · {image.stamp.sensor} · measurement {image.stamp.sequence}"
        return self.page(title, _settings_line(image), width_in=width_in, height_in=height_in)

    def page(self, title: str, line: str, *, width_in: float, height_in: float) -> Figure:
        """Return an empty page under a heading of two lines."""
        figure = Figure(figsize=(width_in, height_in), dpi=_DPI, facecolor=self.theme.page)
        FigureCanvasAgg(figure)
        left, top = 0.42 / width_in, 1 - 0.42 / height_in
        figure.text(left, top, title, color=self.theme.ink, fontsize=14, fontweight="bold")
        figure.text(left, top - 0.27 / height_in, line, color=self.theme.faint, fontsize=9)
        return figure

    def level_db(self, energy: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the level below the strongest, cut at the dynamic range; silence is all floor."""
        strongest = np.float32(energy.max(initial=0.0)) or np.float32(1)
        floor = np.float32(10 ** (-self.dynamic_range_db / 20))
        return np.asarray(20 * np.log10(np.maximum(energy / strongest, floor)), dtype=np.float32)

    def show(
        self, axes: Axes, level_db: NDArray[np.floating], *, extent: tuple[float, float, float, float]
    ) -> AxesImage:
        """Draw a raster whose NaN are not drawn; ``extent`` is left, right, bottom, top."""
        return axes.imshow(
            level_db,
            extent=extent,
            origin="lower",
            aspect="equal",
            cmap=self.theme.colours,
            vmin=-self.dynamic_range_db,
            vmax=0.0,
            interpolation="antialiased",
        )

    def style(self, axes: Axes) -> None:
        """Give the axes the colours of the theme."""
        axes.set_facecolor(self.theme.page)
        axes.tick_params(colors=self.theme.faint, labelsize=8.5)
        axes.xaxis.label.set_color(self.theme.faint)
        axes.yaxis.label.set_color(self.theme.faint)
        for spine in axes.spines.values():
            spine.set_color(self.theme.faint)

    def mark_peaks(self, axes: Axes, place: Callable[[Peak], tuple[float, float]]) -> None:
        """Ring and number the reflectors where ``place`` says, the strongest on top."""
        for number, peak in reversed(list(enumerate(self.peaks, 1))):
            self._mark(axes, number, *place(peak))

    def _mark(self, axes: Axes, number: int, x: float, y: float) -> None:
        outline = [withStroke(linewidth=2.5, foreground=self.theme.page)]
        (ring,) = axes.plot(x, y, "o", markersize=10, markerfacecolor="none", markeredgecolor=self.theme.mark)
        ring.set_path_effects([withStroke(linewidth=2.0, foreground=self.theme.page)])
        axes.annotate(
            str(number),
            (x, y),
            xytext=(8, 6),
            textcoords="offset points",
            color=self.theme.mark,
            fontsize=9,
            fontweight="bold",
            path_effects=outline,
        )

    def side(self, figure: Figure, shown: AxesImage, *, left: float) -> None:
        """Put the scale of colours beside the image, and the list of reflectors under it."""
        bottom, height = (0.52, 0.28) if self.peaks else (0.16, 0.64)
        axes = figure.add_axes((left, bottom, 0.16 / figure.get_figwidth(), height))
        self.style(axes)
        figure.colorbar(shown, cax=axes)
        axes.set_ylabel("dB below the strongest", color=self.theme.faint, fontsize=8.5)
        if not self.peaks:
            return
        spatial = any(abs(peak.elevation_deg) >= 0.05 for peak in self.peaks)
        rows = [_row(number, peak, spatial=spatial) for number, peak in enumerate(self.peaks, 1)]
        heading = f" #  azimuth {'elevat. ' if spatial else ''}  range    dB"
        figure.text(
            left,
            bottom - 0.06,
            "\n".join([heading, *rows][: _rows_that_fit(figure)]),
            color=self.theme.ink,
            fontsize=7.5,
            family="monospace",
            linespacing=1.6,
            va="top",
        )


def _settings_line(image: Energyscape) -> str:
    settings = image.settings
    directions = f"{len(image.azimuth_rad)} directions"
    if len(image.azimuth_rad) == 1:
        azimuth_deg, elevation_deg = np.degrees([image.azimuth_rad[0], image.elevation_rad[0]])
        directions = f"azimuth {angle(azimuth_deg)}, elevation {angle(elevation_deg)}"
    return "  ·  ".join(
        (
            settings.array.layout,
            f"call {settings.call.low_frequency_hz / 1e3:g}–{settings.call.high_frequency_hz / 1e3:g} kHz",
            directions,
            f"{len(image.range_m)} ranges",
            f"method {settings.processing.method}",
            f"{settings.air.temperature_c:g} °C",
        )
    )


def _rows_that_fit(figure: Figure) -> int:
    return int(0.42 * figure.get_figheight() * 72 / (7.5 * 1.6))


def _row(number: int, peak: Peak, *, spatial: bool) -> str:
    elevation = f" {peak.elevation_deg:+6.1f}°" if spatial else ""
    row = f"{number:>2}  {peak.azimuth_deg:+6.1f}°{elevation}  {peak.range_m:5.2f} m {peak.level_db:5.1f}"
    return row.replace("-", "−")


def angle(degrees: float) -> str:
    """Return an angle with its sign, as the axes write it."""
    text = f"{degrees:+.1f}".removesuffix(".0").replace("-", "−")
    return "0°" if text in {"+0", "−0"} else f"{text}°"

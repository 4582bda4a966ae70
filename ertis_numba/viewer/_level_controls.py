"""Controls of acoustic maps: a slider over the bands, their levels, and the scale of the colours."""

import html
import math
from collections.abc import Callable
from typing import Any, Final

import viser

from ertis_numba.viewer._choices import LEVELS_DB, Choices
from ertis_numba.viewer._shapes import BandLevel, LevelScale

__all__ = ["LevelControls"]

_ALL: Final = "all"
_MARKS: Final = 4  # Largest number of frequencies below the slider.
_BAR_PX: Final = 70


class LevelControls:
    """Controls of acoustic maps on the page; choose gets the name and the value of a choice."""

    def __init__(self, gui: viser.GuiApi, choices: Choices, choose: Callable[[str, Any], None]) -> None:
        self._gui, self._choose = gui, choose
        self._centres_hz: list[float | None] = []
        self._folder = gui.add_folder("Bands")
        self._slider: Any = None
        with self._folder:
            self._levels = gui.add_html("", order=math.inf)
        first_db = LEVELS_DB[1] if choices.max_level_db is None else choices.max_level_db
        self._automatic: Any = gui.add_checkbox("Automatic levels", choices.max_level_db is None)
        self._highest: Any = gui.add_slider("Max. level (dB)", *LEVELS_DB, 1.0, first_db)
        self._automatic.on_update(self._on_automatic)
        self._highest.on_update(self._on_highest)

    def show(self, scale: LevelScale) -> None:
        """Show the bands, their levels, and the automatic scale."""
        centres_hz = [each.centre_hz for each in scale.bands]
        if centres_hz != self._centres_hz:
            self._centres_hz = centres_hz
            self._add_slider(next((place for place, each in enumerate(scale.bands) if each.is_shown), 0))
        content = _table(scale)
        if self._levels.content != content:
            self._levels.content = content
        if self._automatic.value and self._highest.value != scale.high_db:
            self._highest.value = min(max(scale.high_db, LEVELS_DB[0]), LEVELS_DB[1])

    def put_back(self, choices: Choices) -> None:
        """Restore the scale after an invalid input."""
        if choices.max_level_db is not None and self._highest.value != choices.max_level_db:
            self._highest.value = choices.max_level_db

    def _add_slider(self, place: int) -> None:
        """Add a slider over the bands, in place of one over others."""
        if self._slider is not None:
            self._slider.remove()
        last = len(self._centres_hz) - 1
        step = max(1, math.ceil(last / _MARKS))
        marks = [(number, _name(self._centres_hz[number])) for number in range(last, step - 1, -step)]
        with self._folder:
            self._slider = self._gui.add_slider("Band", 0, last, 1, place, marks=((0, _ALL), *marks[::-1]), order=0)
        self._slider.on_update(self._on_band)

    def _on_band(self, event: Any) -> None:
        if event.client is not None and event.target.value < len(self._centres_hz):
            self._choose("band_hz", self._centres_hz[event.target.value])

    def _on_automatic(self, event: Any) -> None:
        if event.client is not None:
            self._choose("max_level_db", None if event.target.value else self._highest.value)

    def _on_highest(self, event: Any) -> None:
        if event.client is not None:
            self._automatic.value = False
            self._choose("max_level_db", event.target.value)


def _name(centre_hz: float | None) -> str:
    return _ALL if centre_hz is None else f"{centre_hz / 1e3:.3g} k"


def _table(scale: LevelScale) -> str:
    """Return the loudest direction of each band: frequency, a bar, level, direction and sensor."""
    highest_db = max(scale.high_db, *(each.level_db for each in scale.bands))
    several = len({each.sensor for each in scale.bands}) > 1
    rows = "".join(
        _row(each, (each.level_db - scale.low_db) / (highest_db - scale.low_db), named=several) for each in scale.bands
    )
    return (
        "<div style='margin:0 0.8em 0.6em;font-size:0.85em'>"
        f"<div style='color:#9aa0b0'>loudest direction of each band, {scale.unit}</div>"
        f"<table style='line-height:1.35;font-variant-numeric:tabular-nums'>{rows}</table></div>"
    )


def _row(band: BandLevel, share: float, *, named: bool) -> str:
    colour, weight = ("#ffb347", "bold") if band.is_shown else ("#5f6b8a", "normal")
    bar = f"<div style='height:0.6em;width:{_BAR_PX * min(max(share, 0.0), 1.0):.0f}px;background:{colour}'></div>"
    name = "all bands" if band.centre_hz is None else f"{band.centre_hz / 1e3:.3g} kHz"
    cells = ["–", ""]
    if math.isfinite(band.level_db):
        elevation = f" {band.elevation_deg:+.0f}°" if band.elevation_deg else ""
        sensor = f" {html.escape(band.sensor)}" if named else ""
        cells = [f"{band.level_db:.1f}", f"{band.azimuth_deg:+.0f}°{elevation}{sensor}"]
    return (
        f"<tr data-band='{name}' style='font-weight:{weight}'><td style='padding-right:0.6em'>{name}</td>"
        f"<td style='min-width:{_BAR_PX}px'>{bar}</td>"
        + "".join(f"<td style='text-align:right;padding-left:0.6em'>{cell.replace('-', '−')}</td>" for cell in cells)
        + "</tr>"
    )

"""Notes on the images and maps of a view: directions, and sound that directions or bands do not show."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from ertis_numba.analysis.direction_spacing import spacing_warning
from ertis_numba.analysis.sound_checks import SoundChecks
from ertis_numba.frames import AcousticMap, Energyscape, Measurement
from ertis_numba.fusion import PLATFORM
from ertis_numba.geometry import direction_note
from ertis_numba.passive.search_grid import coarse_map_warning
from ertis_numba.storage import EnergyscapeReader

if TYPE_CHECKING:
    from ertis_numba.settings import Settings
    from ertis_numba.viewer._shapes import DrawnFrame

__all__ = ["ResultNotes", "missing_band_note"]


class ResultNotes:
    """Notes of each sensor, once; the directions are checked again after a change of settings."""

    def __init__(self) -> None:
        self._checked: dict[str, Settings] = {}
        self._with_band_note: set[str] = set()
        self._sound: dict[str, SoundChecks] = {}
        self._files: set[str] = set()

    def of_sound(self, measurement: Measurement) -> Iterator[str]:
        """Yield the new notes on sound that contradicts the settings of a measurement."""
        sensor = measurement.stamp.sensor
        for _, text in self._sound.setdefault(sensor, SoundChecks()).check(measurement):
            yield f"sensor {sensor}: {text}"

    def of_file(self, sensor: str, images: EnergyscapeReader) -> Iterator[str]:
        """Yield the warnings that a file of images stores about the sound of a sensor, once."""
        if sensor not in self._files:
            self._files.add(sensor)
            texts = images.call_warning, images.start_warning, images.layout_warning, images.samples_warning
            for text in filter(None, texts):
                yield f"sensor {sensor}: {text}"

    def of(self, item: Energyscape | AcousticMap, band_note: str | None = None) -> Iterator[str]:
        """Yield the new notes on an image or a map; band_note is on sound outside of the bands of the map."""
        sensor = item.stamp.sensor
        if band_note and sensor not in self._with_band_note:
            self._with_band_note.add(sensor)
            yield f"sensor {sensor}: {band_note}"
        known, settings = self._checked.get(sensor), item.settings
        if sensor == PLATFORM or (known is not None and known == settings.replace(air=known.air)):
            return
        self._checked[sensor] = settings
        if text := direction_note(settings.array, item, is_passive=isinstance(item, AcousticMap)):
            yield f"sensor {sensor} {text}"
        warning_of = coarse_map_warning if isinstance(item, AcousticMap) else spacing_warning
        if text := warning_of(settings, item):
            yield f"sensor {sensor}: {text}"


def missing_band_note(frame: "DrawnFrame", chosen_hz: float | None) -> str:
    """Return a note that no map of a frame contains the chosen frequency; empty if one does, or there is no map."""
    bands = () if frame.scale is None else frame.scale.bands
    if not bands or any(each.is_shown for each in bands):
        return ""
    edges_khz = [edge_hz / 1e3 for each in bands if each.band_hz is not None for edge_hz in each.band_hz]
    return (
        f"no map has a band at {(chosen_hz or 0.0) / 1e3:g} kHz, so the page shows none; choose a frequency from "
        f"{min(edges_khz):.3g} to {max(edges_khz):.3g} kHz (band)"
    )

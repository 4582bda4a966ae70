"""Measurements of the sensors of one platform, grouped by SYNC pulse."""

import math
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _image_options, _mountings, _results, options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from ertis_cli._mountings import Mounting
    from ertis_numba.frames import Energyscape, Measurement, Stamp
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import ExcludedChannels, Settings
    from ertis_numba.storage import RecordingReader
    from ertis_numba.storage.placed_truth import PlacedTruth

__all__ = [
    "PipelinesBySensor",
    "StampedIndex",
    "image_settings",
    "mountings_of",
    "note_empty",
    "note_missing",
    "note_truth",
    "open_sensors",
    "platform_mountings",
    "processing",
    "pulse_groups",
]


_NEAR_EVERY = 8  # Measurements, of which one is searched for echoes from before the first range.


def processing(command: "Callable[..., Any]") -> "Callable[..., Any]":
    """Add the options for images of all sensors: preset, settings, device, threads, plan and mountings."""
    for option in (
        _mountings.mounting,
        options.plan,
        options.threads,
        options.device,
        options.settings_file,
        _image_options.processing_preset,
    ):
        command = option(command)
    return command


def note_empty(n_empty: int, n_pulses: int, *, quiet: bool) -> None:
    """State the number of pulses whose images hold nothing but noise."""
    if n_empty:
        pulses = options.counted(n_pulses, "pulse")
        options.note(f"{n_empty} of {pulses} carried no echo above the noise", quiet=quiet)


def note_without_own_echo(counts: "Mapping[str, int]", n_sensors: int, n_pulses: int, *, quiet: bool) -> None:
    """Print a note on sensors whose emission no echo proves, because the space ahead of them may not be empty."""
    from ertis_numba.fusion.emissions import unproven_note

    if counts:
        pulses = options.counted(n_pulses, "pulse")
        each = ", ".join(f"{sensor} in {count} of {pulses}" for sensor, count in counts.items())
        is_every = len(counts) == n_sensors and min(counts.values()) == n_pulses
        options.note(unproven_note(each, is_every=is_every), quiet=quiet)


def open_sensors(paths: "Sequence[Path]", stack: ExitStack, *, images: bool = False) -> "list[Any]":
    """Open recordings, and energyscape files with images, of different sensors until a stack closes."""
    from ertis_numba.fusion import PLATFORM
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording, sensor_names

    found: dict[str, Any] = {}
    for path in paths:
        wanted = "a recording or an energyscape file" if images else "a recording"
        is_image = images and file_kind(path, wanted) == "energyscape"
        opened: Any = open_energyscapes if is_image else open_recording
        for name in sensor_names(path, wanted):
            if is_image and name == PLATFORM:
                raise click.UsageError(
                    f"{path} has fused images; use recordings, or images of each sensor", click.get_current_context()
                )
            if name in found:
                raise click.UsageError(
                    f"{path} and {found[name].path} contain the same sensor {name!r}; choose one of them",
                    click.get_current_context(),
                )
            found[name] = stack.enter_context(opened(path, sensor=name))
    return list(found.values())


def mountings_of(readers: "Sequence[RecordingReader]", file: "Path | None") -> "dict[str, Mounting]":
    """Return the mountings of sensors from the file given with --mounting, or else from their recordings."""
    given = _mountings.mountings(file, [reader.sensor for reader in readers])
    return {reader.sensor: _mounting(reader) for reader in readers} if given is None else given


def platform_mountings(
    readers: "Sequence[RecordingReader]", file: "Path | None", *, quiet: bool
) -> "dict[str, Mounting]":
    """Return the mountings of sensors, and of others in the file, which emit as well, so that all hear them."""
    found = mountings_of(readers, file)
    others = {name: each for name, each in (_mountings.mountings(file, None) or {}).items() if name not in found}
    if others:
        options.note(
            f"{file} contains {', '.join(others)}, without a recording here; echoes may be of such a sensor's call, "
            "and confirm fewer reflectors. Remove sensors that do not emit from the file",
            quiet=quiet,
        )
    return found | others


def note_truth(truth: "PlacedTruth", *, quiet: bool) -> None:
    """Print why recordings yield no ground truth although some are simulated, and that poses differ from the scene."""
    if truth.missing and truth.is_partial:
        options.note(f"no ground truth is stored, because {truth.missing}", quiet=quiet)
    elif (differs := truth.note()) is not None:
        options.note(differs, quiet=quiet)


def note_missing(groups: "Sequence[Mapping[str, StampedIndex]]", sensors: "Sequence[str]", *, quiet: bool) -> None:
    """State in how many pulses a measurement of each sensor is missing."""
    counts = {name: sum(name not in group for group in groups) for name in sensors}
    if any(counts.values()):
        each = ", ".join(f"{name} in {count}" for name, count in counts.items() if count)
        options.note(
            f"measurements are missing, of {each} of {options.counted(len(groups), 'pulse')}; reflectors are confirmed "
            "by at least two other sensors there",
            quiet=quiet,
        )


def _mounting(reader: "RecordingReader") -> "Mounting":
    from ertis_numba.base.errors import ArgumentError

    if reader.translation_m is None or reader.rotation_xyzw is None:
        raise ArgumentError(
            f"{reader.path}: the mounting of sensor {reader.sensor!r} is unknown; add its mounting with --mounting FILE"
        )
    return reader.translation_m.tolist(), reader.rotation_xyzw.tolist()


@dataclass(frozen=True)
class StampedIndex:
    """Index of a measurement in the recording of its sensor, and its stamp."""

    index: int
    stamp: "Stamp"


def pulse_groups(readers: "Sequence[RecordingReader]") -> "list[dict[str, StampedIndex]]":
    """Return the measurements of each pulse, by sensor; raise DataError if stamps belong to different SYNC chains."""
    from ertis_numba.fusion.pulses import PulseGroups

    places = [StampedIndex(index, stamp) for reader in readers for index, stamp in enumerate(reader.stamps())]
    groups = PulseGroups.recorded(places)
    _require_one_chain(places, groups)
    return groups


def _require_one_chain(places: "Sequence[StampedIndex]", groups: "Sequence[dict[str, StampedIndex]]") -> None:
    """Raise DataError if two sensors share a pulse, but have another SYNC count at different times."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.fusion.pulses import is_same_pulse

    stamps: dict[tuple[str, int], dict[int, list[Stamp]]] = {}  # By session of a sensor, and by SYNC count.
    for place in places:
        session = stamps.setdefault((place.stamp.sensor, place.stamp.session_id), {})
        session.setdefault(place.stamp.sync_count, []).append(place.stamp)
    sharing = {
        pair
        for group in groups
        for pair in combinations(sorted((place.stamp.sensor, place.stamp.session_id) for place in group.values()), 2)
    }
    for one, other in sorted(sharing):
        for count in sorted(stamps[one].keys() & stamps[other].keys()):
            first, *repeats = (*stamps[one][count], *stamps[other][count])
            if len(repeats) == 1 and not is_same_pulse(first, repeats[0]):
                apart_s = abs(first.timestamp_ns - repeats[0].timestamp_ns) / 1e9
                raise DataError(
                    f"sensors {one[0]} and {other[0]} belong to different SYNC chains: their measurements of SYNC "
                    f"count {count} are {apart_s:.3g} s apart; use recordings of one SYNC chain, whose clocks agree "
                    "within half a second"
                )


@dataclass(frozen=True)
class ActiveGroups:
    """Measurements of each pulse in which a sensor emitted its call, by sensor, and the number of other pulses."""

    groups: "list[dict[str, StampedIndex]]"
    n_passive: int


def active_groups(
    readers: "Sequence[RecordingReader]", changed: "Callable[[Settings], Settings]", *, quiet: bool
) -> ActiveGroups:
    """Return the measurements of each pulse in which a sensor emitted its call, by sensor."""
    # A sensor that was silent in such a pulse hears the echoes of the others. A note states the number of other pulses.
    from ertis_numba.base.errors import DataError
    from ertis_numba.frames import is_passive

    settings = {reader.sensor: changed(reader.settings) for reader in readers}
    groups = pulse_groups(readers)
    active = [
        group for group in groups if not all(is_passive(settings[name], place.stamp) for name, place in group.items())
    ]
    if groups and not active:
        raise DataError(
            f"{readers[0].path}: all measurements are passive and have no echoes; use recordings of emitted calls"
        )
    if len(active) < len(groups):
        left_out = f"{len(groups) - len(active)} of {options.counted(len(groups), 'pulse')}"
        options.note(f"{left_out} left out, because no sensor emitted its call", quiet=quiet)
    return ActiveGroups(active, len(groups) - len(active))


def image_settings(settings_file: "Path | None", preset: str | None) -> "Callable[[Settings], Settings]":
    """Return a function that updates the settings of a recording, and refuses those without an image."""

    def changed(recorded: "Settings") -> "Settings":
        settings = options.settings_with(recorded, settings_file=settings_file, preset=preset)
        _results.require_image(settings, 'echoes come from images; set last_stage = "envelope" in --settings FILE')
        return settings

    return changed


class PipelinesBySensor:
    """Pipelines by sensor, for the air of each measurement; ``warnings`` are those printed about the images."""

    # `located` is True if a fusion locates the reflectors, with elevations in mind.

    def __init__(
        self,
        changed: "Callable[[Settings], Settings]",
        stack: ExitStack,
        *,
        quiet: bool,
        without: "ExcludedChannels | None" = None,
        mountings: "Mapping[str, Mounting] | None" = None,
        located: bool = True,
        **device: Any,
    ) -> None:
        self._are_located = located
        self._changed, self._stack, self._quiet, self._device = changed, stack, quiet, device
        self._without = without
        self._near = _NearEchoes({} if mountings is None else mountings)
        self._made: dict[str, tuple[Settings, Pipeline]] = {}
        self._checked: set[str] = set()
        self._is_coarse = False
        self.warnings: list[str] = []

    def settings(self, reader: "RecordingReader") -> "Settings":
        """Return the settings in use for a sensor."""
        return self._changed(reader.settings)

    def image(self, measurement: "Measurement | Energyscape") -> "Energyscape":
        """Return the image of a measurement, or the given one, and warn once if directions are too far apart."""
        from ertis_numba.analysis.direction_spacing import spacing_warning

        image = self._image(measurement)
        if image.stamp.sensor not in self._checked:
            self._checked.add(image.stamp.sensor)
            options.note_unknown_places(image.stamp.sensor, image.settings, quiet=self._quiet)
            options.note_height(image.settings, image, located=self._are_located, quiet=self._quiet)
            text = None if self._is_coarse else spacing_warning(image.settings, image)
            if text is not None:
                self._is_coarse = True
                self._warn(text)
        if (text := self._near.warning(measurement, image.settings)) is not None:
            self._warn(text)
        return image

    def _warn(self, text: str) -> None:
        self.warnings.append(text)
        options.warn(text)

    def _image(self, measurement: "Measurement | Energyscape") -> "Energyscape":
        from ertis_numba.frames import Energyscape

        if isinstance(measurement, Energyscape):
            for name, option in (("preset", "--preset"), ("settings_file", "--settings")):
                if typed(name):
                    raise click.UsageError(
                        f"{option} applies to recordings, but images keep their settings; use the recording, or remove "
                        f"{option}",
                        click.get_current_context(),
                    )
            return measurement
        sensor, settings = measurement.stamp.sensor, measurement.settings
        if sensor not in self._made or self._made[sensor][0] != settings:
            used = self._changed(settings)
            if self._without is not None:
                used = self._without.applied(used, sensor)
            pipeline = options.pipeline(used, quiet=self._quiet, **self._device)
            self._made[sensor] = settings, self._stack.enter_context(pipeline)
        pipeline = self._made[sensor][1]
        return pipeline.process(replace(measurement, settings=pipeline.settings))


class _NearEchoes:
    """Check for obstacles before the first range, in one of eight measurements of each sensor until it finds one."""

    def __init__(self, mountings: "Mapping[str, Mounting]") -> None:
        self._mountings = mountings
        self._counts: Counter[str] = Counter()
        self._delays_s: dict[str, float] = {}  # of calls, by sensor, as far as known
        self._found: set[str] = set()

    def warning(self, measurement: "Measurement | Energyscape", settings: "Settings") -> str | None:
        """Return a warning of an obstacle in front of a mounted sensor, or None."""
        from ertis_numba.analysis.near_echo import near_echo_m, near_warning
        from ertis_numba.frames import Measurement
        from ertis_numba.geometry.air import sound_speed_m_s

        sensor = measurement.stamp.sensor
        if not isinstance(measurement, Measurement) or sensor not in self._mountings or sensor in self._found:
            return None
        self._counts[sensor] += 1
        if self._counts[sensor] % _NEAR_EVERY != 1:
            return None
        place_m = self._mountings[sensor][0]
        self._delays_s[sensor] = settings.call.delay_s
        speed_m_s = sound_speed_m_s(settings.air)
        others_m = [
            math.dist(place_m, other_m)
            + speed_m_s * (self._delays_s.get(name, settings.call.delay_s) - settings.call.delay_s)
            for name, (other_m, _) in self._mountings.items()
            if name != sensor
        ]
        found_m = near_echo_m(replace(measurement, settings=settings), others_m)
        if found_m is None:
            return None
        self._found.add(sensor)
        return near_warning(sensor, found_m, settings.processing.range_m[0], is_alone=not others_m)

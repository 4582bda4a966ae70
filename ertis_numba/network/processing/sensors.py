"""Registered sensors: the pipeline for their measurements, and the descriptions of their products."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.memory import require_image_size
from ertis_numba.frames import is_passive
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import self_contained
from ertis_numba.network.log import EventLog
from ertis_numba.network.messages import Data, Description, Hello
from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.pipe_messages import Prepared
from ertis_numba.network.processing.runner import JobKind
from ertis_numba.settings import Air, Settings

__all__ = ["RegisteredSensor", "Sensors"]

_AIR_STEPS: Final = {"temperature_c": 0.5, "humidity_percent": 5.0, "pressure_pa": 1000.0}
_AGAIN_S: Final = 60.0  # Delay before a pipeline that failed is tried again …
_GREETED_S: Final = 10.0  # … and after a Hello of its sensor.
_PASSIVE: Final = 0  # Number of the kind of measurements without a call; kinds of images begin at 1.


@dataclass(slots=True)
class RegisteredSensor:
    """A sensor."""

    hello: Hello
    stated: Settings  # settings of its hello
    settings: Settings  # the same with air close to that of its latest measurement
    kind: JobKind | None  # None if no pipeline can use its settings
    passive: JobKind  # of its measurements without a call or an image
    applied: Settings | None  # with the options of this node; None if they do not suit
    raw: int = -1  # number of the description
    image: int = -1  # number of the description
    air: tuple[float, float, float] | None = None  # temperature (°C), humidity (%) and pressure (Pa)


class Sensors:
    """All sensors; those with equal settings share a kind, and therefore a pipeline."""

    def __init__(
        self,
        options: ProcessingOptions,
        log: EventLog,
        *,
        describe: Callable[[Description, tuple[bytes, ...]], None],
        prepare: Callable[[JobKind], None],
    ) -> None:
        self._options, self._log, self._emit_event, self._prepare = options, log, describe, prepare
        self._known: dict[str, RegisteredSensor] = {}
        self._kinds: dict[str, JobKind] = {}
        self._prepared: dict[int, Prepared] = {}
        self._unusable: dict[int, float] = {}  # Time of the failure.
        self._n_kinds = self._n_descriptions = 0

    def __getitem__(self, sensor: str) -> RegisteredSensor:
        return self._known[sensor]

    def register(self, hello: Hello, settings: Settings) -> bool:
        """Register a sensor; return True if it is new or has changed."""
        before = self._known.get(hello.sensor)
        if before is not None and (before.stated, _place(before.hello)) == (settings, _place(hello)):
            if before.kind is not None:
                self._try_again(before.kind, _GREETED_S)
            return False
        self._take(hello, settings, settings)
        return True

    def expect(self, settings: Settings) -> None:
        """Prepare for a sensor that has not connected yet."""
        self._kind_of("expected", self._applied("expected", settings))

    def _take(self, hello: Hello, stated: Settings, settings: Settings) -> None:
        passive = JobKind(_PASSIVE, "", sample_format(settings).n_bytes)
        applied = self._applied(hello.sensor, settings)
        known = RegisteredSensor(hello, stated, settings, self._kind_of(hello.sensor, applied), passive, applied)
        self._known[hello.sensor] = known
        known.raw = self._described(hello, settings.to_toml(), b"", b"", b"")
        self._describe_images(known)

    def kind_of(self, data: Data) -> JobKind | None:
        """Return the kind of a measurement, None if it cannot be processed, as without a call."""
        # A new kind needs a difference of 0.5 °C, 5 % or 1 kPa: ranges are wrong by at most 6 mm at 5 m.
        known = self._known[data.sensor]
        if is_passive(known.applied or known.settings, data.stamp):
            return known.passive
        came = data.temperature_c, data.humidity_percent, data.pressure_pa
        if came != known.air:
            try:
                air = _about(data.air, known.settings.air)
            except ArgumentError:
                return None
            if air != known.settings.air:
                self._take(known.hello, known.stated, known.settings.replace(air=air))
                known = self._known[data.sensor]
            known.air = came
        kind = known.kind
        return None if kind is None or kind.number in self._unusable else kind

    def is_ready(self, kind: JobKind) -> bool:
        """Return True if a worker has been ready for a kind."""
        return kind.number in self._prepared

    def became_ready(self, prepared: Prepared) -> None:
        """Store the description of a pipeline."""
        self._prepared[prepared.kind] = prepared
        for known in self._of(prepared.kind):
            self._describe_images(known)

    def failed(self, kind: int, text: str) -> None:
        """Mark a kind as unusable for now, with the reason."""
        self._unusable[kind] = time.monotonic()
        for known in self._of(kind):
            self._log.warning("unusable", sensor=known.hello.sensor, text=text)

    def tick(self) -> None:
        """Try old failures again: memory or a device may have been short."""
        for kind in [kind for kind in self._kinds.values() if kind.number in self._unusable]:
            self._try_again(kind, _AGAIN_S)

    def _try_again(self, kind: JobKind, after_s: float) -> None:
        if time.monotonic() - self._unusable.get(kind.number, float("inf")) >= after_s:
            del self._unusable[kind.number]
            self._prepare(kind)

    def shape_of(self, kind: JobKind) -> tuple[int, int]:
        """Return directions and ranges of the images of a ready kind."""
        return self._prepared[kind.number].shape

    def unused(self, under_way: Callable[[JobKind], bool]) -> list[JobKind]:
        """Remove and return kinds without a sensor and without jobs."""
        used = {known.kind.number for known in self._known.values() if known.kind is not None}
        if not self._known:  # Only the expected kind is left, if any.
            return []
        found = [kind for kind in self._kinds.values() if kind.number not in used and not under_way(kind)]
        for kind in found:
            del self._kinds[kind.settings]
            self._prepared.pop(kind.number, None)
            self._unusable.pop(kind.number, None)
        return found

    def _applied(self, sensor: str, settings: Settings) -> Settings | None:
        try:
            return self._options.applied(settings, sensor)
        except ArgumentError as error:
            self._log.warning("unusable", sensor=sensor, text=str(error))
            return None

    def _kind_of(self, sensor: str, settings: Settings | None) -> JobKind | None:
        if settings is None or settings.processing.mode == "passive":
            return None
        try:
            applied = self_contained(settings).to_toml()
            n_bytes = sample_format(settings).n_bytes
            require_image_size(settings)
        except ArgumentError as error:
            self._log.warning("unusable", sensor=sensor, text=str(error))
            return None
        if applied not in self._kinds:
            self._n_kinds += 1
            self._kinds[applied] = JobKind(self._n_kinds, applied, n_bytes)
            self._prepare(self._kinds[applied])
        return self._kinds[applied]

    def _of(self, kind: int) -> list[RegisteredSensor]:
        return [each for each in self._known.values() if each.kind is not None and each.kind.number == kind]

    def _describe_images(self, known: RegisteredSensor) -> None:
        made = None if known.kind is None else self._prepared.get(known.kind.number)
        if made is not None:
            axes = made.azimuth_rad, made.elevation_rad, made.range_m
            known.image = self._described(known.hello, made.settings, *axes)

    def _described(self, hello: Hello, settings: str, *axes: bytes) -> int:
        self._n_descriptions += 1
        description = Description(
            number=self._n_descriptions,
            sensor=hello.sensor,
            translation_m=hello.translation_m,
            rotation_xyzw=hello.rotation_xyzw,
        )
        self._emit_event(description, (settings.encode(), *axes))
        return self._n_descriptions


def _about(came: Air, used: Air) -> Air:
    """Return the present air while it is about the same; new air is rounded, so that sensors share a pipeline."""
    changes = {}
    for name, step in _AIR_STEPS.items():
        value = getattr(came, name)
        if abs(value - getattr(used, name)) >= step:
            changes[name] = step * round(value / step)
    return used.replace(**changes) if changes else used


def _place(hello: Hello) -> tuple[object, ...]:
    return hello.translation_m, hello.rotation_xyzw

"""What sensors are: which pipeline their measurements need, and what products of them are about."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from ertis_numba.errors import ArgumentError
from ertis_numba.geometry import microphones, self_contained
from ertis_numba.network.log import Log
from ertis_numba.network.messages import Data, Description, Hello
from ertis_numba.network.processing.notes import Prepared
from ertis_numba.network.processing.options import Options
from ertis_numba.network.processing.runner import Kind
from ertis_numba.settings import Air, Settings

__all__ = ["Known", "Sensors"]

_AIR = ("temperature_c", "humidity_percent", "pressure_pa")


class _Describe(Protocol):
    def __call__(self, description: Description, payloads: tuple[bytes, ...]) -> None: ...


@dataclass(slots=True)
class Known:
    """A sensor.

    Attributes
    ----------
    hello : Hello
    settings : Settings
        As it says them, but with the air of its latest measurement.
    kind : Kind or None
        None where no pipeline can use its settings.
    raw, image : int
        Numbers of the descriptions of its products.
    """

    hello: Hello
    settings: Settings
    kind: Kind | None
    raw: int = -1
    image: int = -1


class Sensors:
    """All sensors; those whose settings are equal share a kind, and so a pipeline.

    Parameters
    ----------
    options : Options
    log : Log
    describe : callable
        Called with what products are about, before there are any.
    prepare : callable
        Called with each new kind.
    """

    def __init__(self, options: Options, log: Log, *, describe: _Describe, prepare: Callable[[Kind], None]) -> None:
        self._options, self._log, self._tell, self._prepare = options, log, describe, prepare
        self._known: dict[str, Known] = {}
        self._kinds: dict[str, Kind] = {}
        self._prepared: dict[int, Prepared] = {}
        self._unusable: set[int] = set()
        self._n_kinds = self._n_descriptions = 0

    def __getitem__(self, sensor: str) -> Known:
        return self._known[sensor]

    def know(self, hello: Hello, settings: Settings) -> bool:
        """Take what a sensor is; return whether it is new or has changed."""
        before = self._known.get(hello.sensor)
        if before is not None and (before.settings, _place(before.hello)) == (settings, _place(hello)):
            return False
        known = self._known[hello.sensor] = Known(hello, settings, self._kind_of(hello.sensor, settings))
        known.raw = self._described(hello, settings.to_toml(), b"", b"", b"")
        self._describe_images(known)
        return True

    def kind_of(self, data: Data) -> Kind | None:
        """Return the kind of a measurement, None if there can be no image of it.

        In other air than that of the one before, ranges are others, and so is the kind.
        """
        known = self._known[data.sensor]
        came = {name: getattr(data, name) for name in _AIR}
        if came != {name: getattr(known.settings.air, name) for name in _AIR}:
            try:
                settings = known.settings.replace(air=Air(**came))
            except ArgumentError:
                return None
            self.know(known.hello, settings)
        kind = self._known[data.sensor].kind
        return None if kind is None or kind.number in self._unusable else kind

    def is_ready(self, kind: Kind) -> bool:
        """Whether a worker has been ready for a kind."""
        return kind.number in self._prepared

    def became_ready(self, prepared: Prepared) -> None:
        """Take what a pipeline has told of itself."""
        self._prepared[prepared.kind] = prepared
        for known in self._of(prepared.kind):
            self._describe_images(known)

    def failed(self, kind: int, text: str) -> None:
        """Know that there can be no pipeline for a kind, and why."""
        self._unusable.add(kind)
        for known in self._of(kind):
            self._log.warning("unusable", sensor=known.hello.sensor, text=text)

    def shape_of(self, kind: Kind) -> tuple[int, int]:
        """Return directions and ranges of the images of a kind that is ready."""
        return self._prepared[kind.number].shape

    def unused(self, under_way: Callable[[Kind], bool]) -> list[Kind]:
        """Forget kinds that no sensor has any more, and of which nothing is under way; return them."""
        used = {known.kind.number for known in self._known.values() if known.kind is not None}
        found = [kind for kind in self._kinds.values() if kind.number not in used and not under_way(kind)]
        for kind in found:
            del self._kinds[kind.settings]
            self._prepared.pop(kind.number, None)
            self._unusable.discard(kind.number)
        return found

    def _kind_of(self, sensor: str, settings: Settings) -> Kind | None:
        try:
            applied = self_contained(self._options.applied(settings)).to_toml()
            layout = microphones(settings.array)
        except ArgumentError as error:
            self._log.warning("unusable", sensor=sensor, text=str(error))
            return None
        if applied not in self._kinds:
            self._n_kinds += 1
            n_bytes = settings.recording.n_samples * layout.n_words * layout.word_bits // 8
            self._kinds[applied] = Kind(self._n_kinds, applied, n_bytes)
            self._prepare(self._kinds[applied])
        return self._kinds[applied]

    def _of(self, kind: int) -> list[Known]:
        return [each for each in self._known.values() if each.kind is not None and each.kind.number == kind]

    def _describe_images(self, known: Known) -> None:
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
        self._tell(description, (settings.encode(), *axes))
        return self._n_descriptions


def _place(hello: Hello) -> tuple[object, ...]:
    return hello.translation_m, hello.rotation_xyzw

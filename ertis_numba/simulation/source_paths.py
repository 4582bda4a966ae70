"""Sound paths from the sources of a scene to the microphones."""

from collections.abc import Iterator, Set as AbstractSet
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.arrivals import responses, travelled, views_of
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.noise_frames import spectrum_of
from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import Snapshot, Transmitters
from ertis_numba.simulation.sources import Noise, Sonar, Tone
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = ["AnySource", "SourceInScene", "all_sources", "sources_of"]

Floats = NDArray[np.float64]
AnySource = Tone | Noise | Sonar
Kind = TypeVar("Kind", bound=AnySource)
_VIEWS = frozenset(each.name for each in EFFECTS.values() if "views" in each.places)
_CALL_NODES = 17  # frequencies at which the response to a call is averaged


@dataclass(frozen=True, slots=True, eq=False)
class SourceInScene(Generic[Kind]):
    """Source of sound, direct and over walls, as one sensor receives it; its ``name`` is like ``tones[0]``."""

    name: str
    number: int
    source: Kind
    shot: Snapshot
    active: AbstractSet[str]
    clock: CostStopwatch = field(default_factory=CostStopwatch)

    @property
    def paths(self) -> Paths:
        """Paths to the microphones, the direct one first unless a wall blocks it; the snapshot caches them."""
        return self.shot.once(("source", self.name, _VIEWS & self.active), self._traced)

    def _traced(self) -> Paths:
        shot = self.shot.without_targets()
        transmitter = Transmitters(
            position_m=self.source.position_at(shot.time_s)[None],
            velocity_m_s=self.source.velocity_at(shot.time_s)[None],
            facing=self.source.axis_at(shot.time_s)[None],
        )
        # Numbers of emitters identify their images in the cache.
        everyone = [name for name, _, _ in _sources(shot)]
        number = len(shot.scene.sensors) + everyone.index(self.name)
        _, _, specular = views_of(shot, self.active, number, transmitter, self.clock)
        return without_target(specular.images, shot.receiver, shot.targets, specular.to_corners_m())

    def response(self, frequency_hz: Floats) -> Floats:
        """Return the amplitude of each path for a source of amplitude 1 at 1 m: (path, mic, frequency) float64."""
        emitter = Emitter(diameter_m=self.source.diameter_m)
        found = responses(self.shot, self.active, self.paths, emitter, frequency_hz, self.clock)
        return np.asarray(np.broadcast_to(found.real, (*found.shape[:2], len(frequency_hz))))

    def arrival(self, sent_s: float) -> tuple[Floats, Floats | None]:
        """Return arrival and stretch (None without motion) of sound that leaves after the snapshot: (path, mic)."""
        return travelled(self.shot, self.active, self.paths, sent_s, self.clock)

    @property
    def spectrum(self) -> tuple[Floats, Floats]:
        """Frequencies, and the mean square at each at 1 m, of a call during the call: (frequency,)."""
        source = self.source
        if isinstance(source, Tone):
            frequency_hz, amplitude = source.partials()
            return frequency_hz, np.abs(amplitude) ** 2 / 2
        power = float(10 ** (source.level_db / 10))
        if isinstance(source, Noise):
            frequency_hz, part = spectrum_of(source)
            return frequency_hz, power * part
        call = source.call
        frequency_hz = np.linspace(call.low_frequency_hz, call.high_frequency_hz, _CALL_NODES)
        return frequency_hz, np.full(_CALL_NODES, power / 2 / _CALL_NODES)


def sources_of(
    shot: Snapshot, active: AbstractSet[str], kind: type[Kind], clock: CostStopwatch | None = None
) -> list[SourceInScene[Kind]]:
    """Return the sources of one kind as the snapshot's sensor receives them."""
    clock = clock or CostStopwatch()
    return [
        SourceInScene(name, number, source, shot, active, clock)
        for name, number, source in _sources(shot)
        if isinstance(source, kind)
    ]


def all_sources(shot: Snapshot, active: AbstractSet[str]) -> list[SourceInScene[AnySource]]:
    """Return all sources of a scene as the snapshot's sensor receives them."""
    return [SourceInScene(name, number, source, shot, active) for name, number, source in _sources(shot)]


def _sources(shot: Snapshot) -> Iterator[tuple[str, int, AnySource]]:
    for kind in ("tones", "noises", "sonars"):
        for number, source in enumerate(getattr(shot.scene, kind)):
            yield f"{kind}[{number}]", number, source

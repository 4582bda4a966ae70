"""Delay, amplitude and filter of every call of a scene at every microphone."""

from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.settings import Call
from ertis_numba.simulation.effects import acting
from ertis_numba.simulation.mirrors import Views, images
from ertis_numba.simulation.noise_frames import NoiseFrame
from ertis_numba.simulation.paths import Paths, by_targets, pairs, without_target
from ertis_numba.simulation.scene_size_limits import require_few_amplitudes
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import Snapshot, Transmitters
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = [
    "Arrivals",
    "CallFilter",
    "arrivals",
    "arrived",
    "call_filters",
    "echoes",
    "emitted",
    "emitters",
    "gains",
    "responses",
    "rounded_s",
    "transmitter_of",
    "travelled",
    "views_of",
]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_TICK_S = 1e-12
_AT_ONCE = 2**13  # paths × microphones whose filters are computed at a time
_LONGEST_STRETCH = 2.0  # of a call; speeds are limited to a third of the speed of sound


class CallFilter(Protocol):
    """Filter of a call by its emitter; equal filters have equal hashes."""

    @property
    def rings_s(self) -> float:
        """Time until ringing has decayed, in seconds."""
        ...

    def response(self, frequency_hz: Floats) -> Complexes:
        """Return the response at each frequency: complex128, shaped like the input."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """Copies of one call, or of one frame of noise, at the microphones, with their own delays and sensitivities.

    ``delay_s`` (path, mic) from the start of the record; ``amplitude`` (path, mic, frequency), or one value for all;
    ``stretch`` (path, mic): received / emitted duration, None if nothing moves and clocks agree.
    """

    call: Call | NoiseFrame
    delay_s: Floats
    amplitude: Floats | Complexes
    stretch: Floats | None = None
    filters: tuple[CallFilter, ...] = ()

    @property
    def lasts_s(self) -> float:
        """Longest duration of a copy, with ringing."""
        stretch = 1.0 if self.stretch is None else float(self.stretch.max(initial=1.0))
        return stretch * self.call.end_s + self.rings_s

    @property
    def rings_s(self) -> float:
        """Time for which a copy that is not stretched rings."""
        return sum((each.rings_s for each in self.filters), 0.0)


def arrivals(shot: Snapshot, active: AbstractSet[str], frequency_hz: Floats, clock: CostStopwatch) -> list[Arrivals]:
    """Return all copies of calls that arrive at the microphones, with filters evaluated at ``frequency_hz``.

    Delays are rounded to picoseconds, which hides the last digits of sines and roots. These differ between processors.
    """
    gain, _ = gains(shot, active, clock)
    found: list[Arrivals] = []
    for number in emitters(shot, active):
        sensor = shot.scene.sensors[number]
        level = _linear(sensor.emitter.level_db)
        own = "propagation" if number == shot.number else "cross_emission"
        for paths in echoes(shot, active, number, clock, n_frequencies=len(frequency_hz)):
            amplitude = level * responses(shot, active, paths, sensor.emitter, frequency_hz, clock)
            times = travelled(shot, active, paths, 0.0, clock, propagation=own)
            found.append(arrived(shot, active, number, times[0], gain[:, None] * amplitude, times[1]))
    for name, act in acting("arrivals", active):
        with clock(name):
            found = act(shot, active, frequency_hz, found)
    return found


def travelled(
    shot: Snapshot,
    active: AbstractSet[str],
    paths: Paths,
    sent_s: float,
    clock: CostStopwatch,
    *,
    propagation: str = "propagation",
) -> tuple[Floats, Floats | None]:
    """Return the arrival time of sound that leaves at ``sent_s``, and its stretch, None without motion: (path, mic)."""
    times: tuple[Floats, Floats | None] = np.full(paths.second_m.shape, sent_s), None
    for name, act in acting("times", active):
        with clock(propagation if name == "propagation" else name):
            times = act(shot, paths, sent_s, times)
    return times


def emitters(shot: Snapshot, active: AbstractSet[str]) -> list[int]:
    """Return the indices of the sensors whose calls arrive, the receiving sensor first."""
    others = [number for _, act in acting("other_emitters", active) for number in act(shot)]
    return others if shot.sensor.emitter.silent else [shot.number, *others]


def transmitter_of(shot: Snapshot, active: AbstractSet[str], number: int) -> Transmitters:
    """Return the emitter of a sensor, at the sensor's origin or at its offset."""
    pose = shot.transmitters[number]
    for _, act in acting("transmitter", active):
        pose = act(shot, number, pose)
    return pose


def echoes(
    shot: Snapshot, active: AbstractSet[str], number: int, clock: CostStopwatch, *, n_frequencies: int = 1
) -> list[Paths]:
    """Return the paths of the call of sensor ``number`` over targets and walls; direct ones for other sensors only."""
    firsts, seconds, specular = views_of(shot, active, number, transmitter_of(shot, active, number), clock)
    over = by_targets
    for _, act in acting("turns", active):
        over = act
    one, other = pairs(firsts, seconds, shot.scene.max_reflections)
    require_few_amplitudes(len(one), len(shot.channels), n_frequencies)
    step = max(1, _AT_ONCE // shot.receiver.positions_m.shape[1])
    found = [
        over(firsts.chosen(one[first : first + step]), seconds.chosen(other[first : first + step]), shot.targets)
        for first in range(0, len(one), step)
    ]
    # The call of the sensor itself does not arrive directly.
    specular = specular.chosen((specular.n_mirrors > 0) | (number != shot.number))
    if len(specular):
        found.append(without_target(specular.images, shot.receiver, shot.targets, specular.to_corners_m()))
    return found


def views_of(
    shot: Snapshot, active: AbstractSet[str], number: int, transmitter: Transmitters, clock: CostStopwatch
) -> Views:
    """Return the emitter and the microphones as seen from the targets, and the emitter from the microphones."""
    views: Views = (
        images(transmitter, shot.targets.positions_m, shot.mirrors, 0),
        images(shot.receiver, shot.targets.positions_m, shot.mirrors, 0),
        images(transmitter, shot.receiver.centre_m, shot.mirrors, 0),
    )
    for name, act in acting("views", active):
        with clock(name):
            views = act(shot, number, views)
    return views


def responses(
    shot: Snapshot,
    active: AbstractSet[str],
    paths: Paths,
    emitter: Emitter,
    frequency_hz: Floats,
    clock: CostStopwatch,
) -> Floats | Complexes:
    """Return the gain (path, mic, frequency) of a call without the transducer's response; see `emitted`."""
    strength = _strength(paths, spreads="spreading" in active)
    amplitude = (paths.reflection * strength)[:, None, None] * np.ones((*paths.second_m.shape, 1))
    for name, act in acting("gain", active):
        with clock(name):
            amplitude = amplitude * act(shot, paths, emitter, frequency_hz)
    return amplitude


def call_filters(active: AbstractSet[str], emitter: Emitter) -> tuple[CallFilter, ...]:
    """Return the filters of an emitter's call."""
    found = [act(emitter) for _, act in acting("call_filter", active)]
    return tuple(each for each in found if each is not None)


def emitted(active: AbstractSet[str], emitter: Emitter, frequency_hz: Floats) -> Floats | Complexes:
    """Return the response of an emitter's filters at each frequency: (frequency,) float64 or complex128."""
    response: Floats | Complexes = np.ones(len(frequency_hz))
    for each in call_filters(active, emitter):
        response = response * each.response(frequency_hz)
    return response


def gains(shot: Snapshot, active: AbstractSet[str], clock: CostStopwatch | None = None) -> tuple[Floats, Floats]:
    """Return the sensitivity and the delay of each microphone (mic,): its calibration and its uncalibrated spread."""
    clock = clock or CostStopwatch()

    def found() -> tuple[Floats, Floats]:
        gain, late_s = shot.layout.gain[shot.channels], shot.layout.delay_s[shot.channels]
        for name, act in acting("microphones", active):
            with clock(name):
                gain, late_s = act(shot, gain, late_s)
        return gain, late_s

    return shot.once(("gains", frozenset(active)), found)


def _strength(paths: Paths, *, spreads: bool) -> Floats:
    """Return the reflected amplitude of each target: (path,)."""
    # A sphere acts as a point of half of its radius in the far field; its spreading includes this factor.
    targets = paths.targets
    if not len(targets):
        return np.ones(len(paths))
    as_point = (targets.radius_m > 0) & (not (paths.surface and spreads))
    return np.asarray(targets.strength * np.where(as_point, targets.radius_m / 2, 1.0))


def arrived(
    shot: Snapshot,
    active: AbstractSet[str],
    number: int,
    delay_s: Floats,
    amplitude: Floats | Complexes,
    stretch: Floats | None = None,
) -> Arrivals:
    """Return copies of the call of sensor ``number``, timed by the clock of the receiving sensor."""
    # `delay_s` and `stretch` are (path, mic), and `amplitude` (path, mic, frequency).
    sensor = shot.scene.sensors[number]
    for _, act in acting("clock_times", active):
        delay_s, stretch = act(shot, number, delay_s, stretch)
    filters = call_filters(active, sensor.emitter)
    lasts_s = sensor.call.end_s + sum(each.rings_s for each in filters)
    delay_s = delay_s + gains(shot, active)[1]
    heard = np.max(delay_s, axis=1) > -_LONGEST_STRETCH * lasts_s
    if not heard.all():
        delay_s, amplitude = delay_s[heard], amplitude[heard]
        stretch = None if stretch is None else stretch[heard]
    return Arrivals(sensor.call, rounded_s(delay_s), amplitude, stretch, filters)


def rounded_s(delay_s: Floats) -> Floats:
    """Return delays rounded to picoseconds."""
    return np.asarray(np.rint(delay_s / _TICK_S) * _TICK_S)


def _linear(level_db: float) -> float:
    return float(10 ** (level_db / 20))

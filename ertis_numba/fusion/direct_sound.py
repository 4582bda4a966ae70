"""Direct sound between the sensors of a platform, which shows errors of clocks and mountings."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.constants import SYNC_STEP_S
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.signals import matched, signals_of
from ertis_numba.frames import Measurement
from ertis_numba.fusion.audibility import audible_ratio
from ertis_numba.fusion.rig import MountedSensor, Mountings, mounted_sensors
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_filter_spectrum, matched_guard_s
from ertis_numba.settings import Settings

__all__ = ["DirectSound", "DirectSoundCheck"]

Floats = NDArray[np.float64]

_PULSE_S: Final = 120e-6  # Half of the width of a pulse, outside which the background is measured.
_EDGE_S: Final = _PULSE_S / 2  # A maximum this close to the end of a window may belong to a pulse outside.
_WINDOW_S: Final = 500e-6 + _EDGE_S  # Half of the window in which an arrival is searched, …
_MIN_WINDOW_S: Final = 250e-6  # … unless the sensor's own direct sound is near; pairs with less are left out.
_FALSE_ALARMS: Final = 1e-3  # Accepted probability that noise passes for a direct sound in a whole check.
_OVERSAMPLING: Final = 8
_MOUNTING_SD_M: Final = 1e-3  # of the position of a sensor along the way to another one
_SIGMAS: Final = 3.0
_NEAREST_M: Final = 0.05
_BESIDE_S: Final = 150e-6  # Largest difference of a sensor's own direct sound, whose emitter may be beside the origin.
_CLEAR: Final = 2.0  # Level relative to the threshold from which the way back would be heard as well.


class DirectSound(NamedTuple):
    """Arrival of the direct sound of a neighbour, which is audible in most pulses.

    ``difference_s`` is the measured minus the predicted arrival, as a median over these pulses; its ``uncertainty_s``
    contains ``noise_s`` of the measured arrival, and those of the mountings and of the SYNC chain.
    """

    emitter: str
    receiver: str
    difference_s: float
    noise_s: float
    uncertainty_s: float


@dataclass(frozen=True, slots=True)
class _Arrival:
    difference_s: float
    noise_s: float
    excess: float  # Level relative to the threshold.


class DirectSoundCheck:
    """Comparison of the direct sound between sensors with the prediction of their mountings on the platform.

    Sound from sensor a to sensor b arrives early or late if their clocks differ, and late if they are farther apart
    than their mountings state. The way back tells both apart: a difference of clocks has the opposite sign there.
    Emitters are assumed to be at the origins of the sensors, as in images.
    The sound also shows silent emitters. Sound between two sensors is equally loud both ways. A sensor that most others
    do not hear, although it clearly hears one of them, does not emit. The same holds for a sensor that does not hear
    its own call, if all others clearly hear theirs.
    Noise alone passes for a direct sound in at most one of 1000 checks. Each of the n (n − 1) pairs of n sensors has an
    equal share of this rate in a single pulse. Of several pulses, more than half must contain the sound, which is less
    probable still, so the rate holds for any number of pulses.
    """

    def __init__(self, mountings: Mountings) -> None:
        self._mountings = {sensor.name: sensor for sensor in mounted_sensors(mountings)}
        self._found: dict[tuple[str, str], list[_Arrival | None]] = {}  # by emitter and receiver
        self._own: dict[str, list[_Arrival | None]] = {}
        self._sample_s = 0.0
        self._speed_m_s = 0.0

    def add(self, measurements: Iterable[Measurement]) -> None:
        """Add the measurements of one SYNC pulse, at most one of each mounted sensor."""
        group = {}
        for each in checks.items("measurements", measurements, Measurement, "a recording contains"):
            if each.stamp.sensor not in self._mountings:
                raise ArgumentError(
                    f"measurements has sensor {each.stamp.sensor!r}, whose mounting is unknown; add it to mountings, "
                    f"or use sensors of {', '.join(self._mountings)}"
                )
            group[each.stamp.sensor] = each
        for name, each in group.items():
            call = each.settings.call
            starts_s = {
                other: heard.settings.call.start_s
                for other, heard in group.items()
                if other != name
                and heard.stamp.behaviour != "passive"
                and heard.settings.call.sounds_like(call)
                and self._distance_m(name, other) > _NEAREST_M
            }
            arrivals = _arrivals(each, self._mountings, starts_s, _FALSE_ALARMS / self._n_pairs)
            for other, arrival in arrivals.items():
                self._found.setdefault((other, name), []).append(arrival)
            if each.stamp.behaviour != "passive":
                self._add_own(each, [self._distance_m(name, other) for other in group if other != name])
            self._sample_s = max(self._sample_s, 1 / each.settings.signal_rate_hz)
            self._speed_m_s = sound_speed_m_s(each.settings.air)

    @property
    def sounds(self) -> tuple[DirectSound, ...]:
        """Direct sound of each pair of emitter and receiver, where it is audible in more than half of the pulses."""
        chain_s = SYNC_STEP_S * (len(self._mountings) - 1)
        found, silent = [], self.silent
        for (emitter, receiver), searched in self._found.items():
            if emitter in silent:
                continue
            arrivals = [each for each in searched if each is not None]
            if 2 * len(arrivals) <= len(searched):
                continue
            difference_s = float(np.median([each.difference_s for each in arrivals]))
            noise_s = float(np.median([each.noise_s for each in arrivals]))
            mounting_s = math.sqrt(2) * _MOUNTING_SD_M / self._speed_m_s
            found.append(
                DirectSound(emitter, receiver, difference_s, noise_s, math.hypot(noise_s, mounting_s, chain_s))
            )
        return tuple(found)

    @property
    def silent(self) -> tuple[str, ...]:
        """Sensors that emit no sound, in contrast to others."""
        found = []
        for name in self._mountings:
            searched = {receiver: each for (emitter, receiver), each in self._found.items() if emitter == name}
            unheard = [receiver for receiver, each in searched.items() if not any(each)]
            # Sound of others may arrive at a receiver at nearly the same time.
            is_one_way = any(_is_clear(self._found.get((receiver, name), ())) for receiver in unheard)
            if is_one_way and 2 * len(unheard) > len(searched):
                found.append(name)
        clear = [name for name, each in self._own.items() if _is_clear(each)]
        deaf = [name for name, each in self._own.items() if not any(each)]
        if clear and len(deaf) <= max(1, len(clear) - 1) and len(clear) + len(deaf) == len(self._own):
            found += deaf
        return tuple(dict.fromkeys(found))

    def _add_own(self, measurement: Measurement, distances_m: Sequence[float]) -> None:
        """Add the direct sound of a sensor at its own microphones, unless that of a neighbour is too close."""
        nearest_s = min(distances_m, default=math.inf) / sound_speed_m_s(measurement.settings.air)
        window_s = min(_WINDOW_S, nearest_s - _PULSE_S / 2)
        if window_s >= _MIN_WINDOW_S:
            name = measurement.stamp.sensor
            self._own.setdefault(name, []).append(
                _own_arrival(measurement, window_s, _FALSE_ALARMS / len(self._mountings))
            )

    def warnings(self) -> tuple[str, ...]:
        """Return one line for each silent emitter, and each clock and distance beyond 3 σ and one signal sample."""
        sounds = {(each.emitter, each.receiver): each for each in self.sounds}
        clocks_s, distances_s = _both_ways(sounds, SYNC_STEP_S * (len(self._mountings) - 1))
        found = [f"{name} emits no sound, unlike the other sensors; check its emitter" for name in self.silent]
        found += self._of_clocks(clocks_s)
        for (one, other), (late_s, sd_s) in distances_s.items():
            if self._is_wrong(late_s, sd_s):
                found.append(
                    f"{one} and {other} are {self._millimetres(late_s)} than their mountings state, "
                    f"± {1e3 * sd_s * self._speed_m_s:.1f} mm; measure the mountings again"
                )
        for (emitter, receiver), each in sounds.items():
            is_single = (receiver, emitter) not in sounds
            if is_single and self._is_wrong(each.difference_s, each.uncertainty_s):
                found.append(
                    f"direct sound of {emitter} arrives at {receiver} {_microseconds(each.difference_s)} than "
                    f"predicted, ± {1e6 * each.uncertainty_s:.1f} µs; check the SYNC line and the mountings"
                )
        return tuple(found)

    def _of_clocks(self, clocks_s: Mapping[tuple[str, str], tuple[float, float]]) -> Iterable[str]:
        """Yield a line for each sensor whose clock differs from most others, or for two that differ."""
        for names in _linked(clocks_s):
            pairs = {pair: value for pair, value in clocks_s.items() if pair[0] in names}
            if len(names) == 2:
                yield from self._of_two_clocks(pairs)
                continue
            for name, late_s in _lateness_s(names, pairs).items():
                sd_s = float(np.median([sd for pair, (_, sd) in pairs.items() if name in pair]))
                if self._is_wrong(late_s, sd_s):
                    yield (
                        f"{name} emits and records {_microseconds(late_s)} than the other sensors, ± "
                        f"{1e6 * sd_s:.1f} µs; check its SYNC line"
                    )

    def _of_two_clocks(self, pairs: Mapping[tuple[str, str], tuple[float, float]]) -> Iterable[str]:
        for (one, other), (late_s, sd_s) in pairs.items():
            if self._is_wrong(late_s, sd_s):
                yield (
                    f"{one} emits and records {_microseconds(late_s)} than {other}, ± {1e6 * sd_s:.1f} µs; check the "
                    "SYNC line"
                )

    @property
    def _n_pairs(self) -> int:
        return len(self._mountings) * (len(self._mountings) - 1)

    def _is_wrong(self, difference_s: float, sd_s: float) -> bool:
        return abs(difference_s) > max(_SIGMAS * sd_s, self._sample_s)

    def _distance_m(self, one: str, other: str) -> float:
        return float(np.linalg.norm(self._mountings[one].translation_m - self._mountings[other].translation_m))

    def _millimetres(self, late_s: float) -> str:
        return f"{1e3 * abs(late_s) * self._speed_m_s:.1f} mm {'farther apart' if late_s > 0 else 'closer together'}"


def _both_ways(
    sounds: Mapping[tuple[str, str], DirectSound], chain_s: float
) -> tuple[dict[tuple[str, str], tuple[float, float]], dict[tuple[str, str], tuple[float, float]]]:
    """Return the first clock's lateness and the distance's excess in s, with deviations, of pairs heard both ways."""
    clocks_s, distances_s = {}, {}
    names = dict.fromkeys(name for pair in sounds for name in pair)
    for one, other in combinations(names, 2):
        if (one, other) in sounds and (other, one) in sounds:
            there, back = sounds[one, other], sounds[other, one]
            noise_s = math.hypot(there.noise_s, back.noise_s) / 2
            clocks_s[one, other] = (there.difference_s - back.difference_s) / 2, math.hypot(noise_s, chain_s)
            mounting_s = math.sqrt(max(0.0, there.uncertainty_s**2 - there.noise_s**2 - chain_s**2))
            distances_s[one, other] = (there.difference_s + back.difference_s) / 2, math.hypot(noise_s, mounting_s)
    return clocks_s, distances_s


def _linked(pairs: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Return the groups of sensors that pairs link, directly or over others."""
    groups: list[list[str]] = []
    for pair in pairs:
        joined = [group for group in groups if set(group) & set(pair)]
        groups = [group for group in groups if group not in joined]
        groups.append([*dict.fromkeys([name for group in joined for name in group] + [*pair])])
    return groups


def _lateness_s(names: Sequence[str], pairs: Mapping[tuple[str, str], tuple[float, float]]) -> dict[str, float]:
    """Return how late each sensor is relative to the median of all, with the least sum of absolute residuals.

    Single wrong differences thus have no influence, and sensors that do not hear each other are compared over others.
    """
    places = {name: number for number, name in enumerate(names)}
    signs = np.zeros((len(pairs), len(names)))
    for row, (one, other) in enumerate(pairs):
        signs[row, places[one]], signs[row, places[other]] = 1, -1
    late_us = 1e6 * np.array([late_s for late_s, _ in pairs.values()])
    unit = np.eye(len(pairs))
    found = scipy.optimize.linprog(
        np.repeat([0.0, 1.0], [len(names), len(pairs)]),
        A_ub=np.block([[signs, -unit], [-signs, -unit]]),
        b_ub=np.concatenate([late_us, -late_us]),
        bounds=[(0, 0), *[(None, None)] * (len(names) - 1), *[(0, None)] * len(pairs)],
    )
    each_us = found.x[: len(names)]
    return dict(zip(names, (1e-6 * (each_us - np.median(each_us))).tolist(), strict=True))


def _arrivals(
    measurement: Measurement,
    mountings: Mapping[str, MountedSensor],
    starts_s: Mapping[str, float],
    false_alarms: float,
) -> dict[str, _Arrival | None]:
    """Return the arrivals of direct sound at a sensor, by emitter, and None for those that are not audible."""
    settings = measurement.settings
    layout, sensor = microphones(settings.array), mountings[measurement.stamp.sensor]
    speed_m_s = sound_speed_m_s(settings.air)
    places_m = sensor.translation_m + layout.enabled_positions_m @ sensor.rotation.T
    late_s = {
        name: start_s
        + np.linalg.norm(places_m - mountings[name].translation_m, axis=1) / speed_m_s
        + layout.delay_s[layout.enabled]
        for name, start_s in starts_s.items()
    }
    if not late_s:
        return {}
    sound = _Sound(measurement, max(float(each.max()) for each in late_s.values()))
    # Direct sound from the sensor itself is far louder, and hides that of neighbours.
    own_s = settings.call.start_s
    own_end_s = own_s + float(np.linalg.norm(layout.enabled_positions_m, axis=1).max()) / speed_m_s + _PULSE_S / 2
    found: dict[str, _Arrival | None] = {}
    for name, each in late_s.items():
        middle_s = float(each.mean())
        window_s = min(_WINDOW_S, max(own_s - _PULSE_S / 2 - middle_s, middle_s - own_end_s))
        if window_s >= _MIN_WINDOW_S:
            found[name] = sound.arrival(each, window_s, false_alarms)
    return found


def _own_arrival(measurement: Measurement, window_s: float, false_alarms: float) -> _Arrival | None:
    """Return the arrival of a sensor's own direct sound, None if it is not audible."""
    settings = measurement.settings
    layout, speed_m_s = microphones(settings.array), sound_speed_m_s(settings.air)
    away_m = np.linalg.norm(layout.enabled_positions_m, axis=1)
    late_s = settings.call.start_s + away_m / speed_m_s + layout.delay_s[layout.enabled]
    found = _Sound(measurement, float(late_s.max())).arrival(late_s, window_s, false_alarms)
    return found if found is not None and abs(found.difference_s) < _BESIDE_S else None


class _Sound:
    """Spectra of the signals of a measurement after the matched filter, up to a time."""

    def __init__(self, measurement: Measurement, last_s: float) -> None:
        settings = measurement.settings
        # Without its own delay, the matched filter yields times since the start of the record.
        self._settings = settings = settings.replace(call=settings.call.replace(delay_s=0.0))
        needed_s = last_s + 2 * _WINDOW_S + settings.call.end_s + 2 * matched_guard_s(settings)
        needed = math.ceil(needed_s * settings.recording.sample_rate_hz)
        signals = matched(signals_of(measurement, settings=settings, max_samples=needed), settings)
        self._spectra = np.fft.fft(signals.astype(np.complex128), axis=1)
        self._frequency_hz = np.fft.fftfreq(signals.shape[1], 1 / settings.signal_rate_hz)

    def arrival(self, late_s: Floats, window_s: float, false_alarms: float) -> _Arrival | None:
        """Return the strongest pulse around predicted times of the microphones, None if it is not audible."""
        beam = np.mean(self._spectra * np.exp(2j * math.pi * self._frequency_hz * late_s[:, None]), axis=0)
        return _strongest(beam, self._settings, window_s, false_alarms)


def _is_clear(found: Sequence[_Arrival | None]) -> bool:
    """Return True for a sound that clearly exceeds the threshold in more than half of the pulses."""
    return 2 * sum(each is not None and each.excess >= _CLEAR for each in found) > len(found)


def _strongest(
    spectrum: NDArray[np.complex128], settings: Settings, window_s: float, false_alarms: float
) -> _Arrival | None:
    """Return the time of the strongest pulse within a window around time 0 of a beam, or None if it is not audible."""
    count = len(spectrum)
    padded = np.zeros(_OVERSAMPLING * count, dtype=np.complex128)
    padded[: count // 2], padded[-(count - count // 2) :] = spectrum[: count // 2], spectrum[count // 2 :]
    amplitude = np.abs(np.fft.ifft(padded)) * _OVERSAMPLING
    step_s = 1 / (_OVERSAMPLING * settings.signal_rate_hz)
    half, edge = round(window_s / step_s), round(_EDGE_S / step_s)
    level = np.concatenate([amplitude[-half:], amplitude[: half + 1]])
    peak = int(level.argmax())
    is_pulse = np.abs(np.arange(len(level)) - peak) * step_s < _PULSE_S
    background = float(np.sqrt(np.mean(level[~is_pulse] ** 2)))
    audible = audible_ratio(
        settings,
        searched_s=2 * (window_s - _EDGE_S),
        averaged_s=2 * (window_s - _PULSE_S),
        false_alarms=false_alarms,
    )
    if not edge <= peak < len(level) - edge or level[peak] < audible * max(background, 1e-30):
        return None
    before, here, after = level[peak - 1 : peak + 2].tolist()
    offset = 0.5 * (before - after) / (before - 2 * here + after)
    noise_s = background / (here * math.sqrt(2) * 2 * math.pi * _bandwidth_hz(settings))
    excess = level[peak] / (audible * max(background, 1e-30))
    return _Arrival((peak - half + offset) * step_s, noise_s, float(excess))


def _bandwidth_hz(settings: Settings) -> float:
    """Return the RMS bandwidth of the matched call, which determines the error of its time."""
    n_fft = 2 ** math.ceil(math.log2(4 * settings.call.end_s * settings.signal_rate_hz))
    power = matched_filter_spectrum(settings, n_fft=n_fft).echo_power
    frequency_hz = np.arange(len(power)) * settings.signal_rate_hz / n_fft
    centre_hz = np.average(frequency_hz, weights=power)
    return float(np.sqrt(np.average((frequency_hz - centre_hz) ** 2, weights=power)))


def _microseconds(late_s: float) -> str:
    return f"{1e6 * abs(late_s):.1f} µs {'later' if late_s > 0 else 'earlier'}"

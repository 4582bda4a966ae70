"""What a sensor's image will show of a scene, estimated without rendering it."""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.settings import Call, Settings
from ertis_numba.simulation.arrivals import echoes, responses
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.stopwatch import Stopwatch
from ertis_numba.waveform import MatchedFilter, call_samples, matched_band_hz, matched_filter, matched_guard_s

__all__ = ["Echoes", "Sight", "change_db"]

Floats = NDArray[np.float64]
_NODES = 65
_LAG_NODES = 256  # resolves lags of several milliseconds
_LAGS, _LAG_DIRECTIONS = 128, 64
_BEAM_PATHS, _BEAM_DIRECTIONS = 6, 361
_SHOWN_DB = 40.0  # what an image shows below its strongest reflector, among side lobes
_PEAK = 3.3  # highest of some ten thousand Rayleigh-distributed amplitudes, by their root mean square
_SAME_RANGE_M = 0.05
_MODULATOR_DBFS = {1: -22.0, 2: -44.0, 3: -48.0, 4: -58.0}  # white noise of the same level in a call's band


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """Paths as an image shows them.

    Attributes
    ----------
    names : tuple of str
    gain : (path, node) float64
    delay_s : (path,) float64
        To the middle of the array.
    direction : (path, axis) float64
        Where the sound comes from, in the sensor frame.
    """

    names: tuple[str, ...]
    gain: Floats
    delay_s: Floats
    direction: Floats

    def __len__(self) -> int:
        return len(self.names)


class Sight:
    """The image of one sensor at one time, with some effects.

    Parameters
    ----------
    shot : Snapshot
    active : frozenset of str

    Attributes
    ----------
    frequency_hz, power : (node,) float64
        Of the matched call; the powers add up to 1.
    """

    def __init__(self, shot: Snapshot, active: frozenset[str]) -> None:
        self.shot = shot
        # Paths end in the middle of the array: what microphones hear differs by parts of a percent.
        self._middle = replace(shot, ear=replace(shot.ear, positions_m=shot.ear.centre_m[None]))
        self.active = active
        self.settings = shot.sensor.settings()
        self.frequency_hz, self.power = _band(self.settings)

    @functools.cached_property
    def own(self) -> Echoes:
        """The echoes of the sensor's own call."""
        return self.echoes(self.shot.number, self.active)

    @functools.cached_property
    def shown(self) -> NDArray[np.bool_]:
        """Which of its own echoes the image shows: (path,) bool."""
        level = self.levels(self.own)
        weakest = max(self.noise, float(level.max(initial=0.0)) * 10 ** (-_SHOWN_DB / 20))
        return np.asarray((level > weakest) & self.inside(self.own.delay_s))

    @functools.cached_property
    def floor(self) -> float:
        """The weakest reflector that the image shows, or its noise where it shows none."""
        return float(np.min(self.levels(self.own)[self.shown], initial=np.inf)) if self.shown.any() else self.noise

    @functools.cached_property
    def noise(self) -> float:
        """Highest amplitude that the modulators' noise reaches in the image."""
        return self.of_white_noise(_MODULATOR_DBFS[self.shot.sensor.electronics.modulator_order])

    def echoes(self, number: int, active: frozenset[str]) -> Echoes:
        """Return the echoes of an emitter's call with other effects."""
        found = [
            self._seen(paths, number, active)
            for paths in self.paths(number, active)
        ]
        return Echoes(
            names=tuple(name for entry in found for name in entry.names),
            gain=np.concatenate([np.zeros((0, _NODES)), *(entry.gain for entry in found)]),
            delay_s=np.concatenate([np.zeros(0), *(entry.delay_s for entry in found)]),
            direction=np.concatenate([np.zeros((0, 3)), *(entry.direction for entry in found)]),
        )

    def paths(self, number: int, active: frozenset[str]) -> list[Paths]:
        """Return the ways of an emitter's call, none of a silent one's."""
        if self.shot.scene.sensors[number].emitter.silent:
            return []
        return echoes(self._middle, active, number, Stopwatch())

    def _seen(self, paths: Paths, number: int, active: frozenset[str]) -> Echoes:
        emitter = self.shot.scene.sensors[number].emitter
        gain = responses(self._middle, active, paths, emitter, self.frequency_hz, Stopwatch())
        return Echoes(
            names=paths.names,
            gain=10 ** (emitter.level_db / 20) * np.broadcast_to(gain[:, 0], (len(paths), _NODES)),
            delay_s=paths.length_m[:, 0] / self.shot.speed_m_s,
            direction=-paths.arriving[:, 0] @ paths.ear.axes.T,
        )

    def levels(self, seen: Echoes) -> Floats:
        """Return the amplitudes at which an image shows echoes: (path,) float64."""
        return np.asarray(np.abs(seen.gain @ self.power) * self.coverage(seen.direction))

    def inside(self, delay_s: Floats) -> NDArray[np.bool_]:
        """Return whether echoes lie in the image's range window: (path,) bool."""
        first_m, last_m = self.settings.processing.range_m
        range_m = delay_s * self.shot.speed_m_s / 2
        return np.asarray((range_m >= first_m) & (range_m <= last_m))

    def beside(self, delay_s: Floats, after: Echoes | None = None) -> Floats:
        """Return the strongest of the image at the ranges of some delays, at least its floor: (path,) float64.

        With the same echoes under another effect, the weaker of the two counts.
        """
        level = self.levels(self.own) * self.shown
        floor = self.floor
        if after is not None:
            level = np.minimum(level, self.levels(after))
            floor = max(float(np.min(level[self.shown], initial=floor)), self.noise)
        apart_m = np.abs(delay_s[:, None] - self.own.delay_s) * self.shot.speed_m_s / 2
        return np.maximum(np.max(np.where(apart_m < _SAME_RANGE_M, level, 0.0), axis=1, initial=0.0), floor)

    def coverage(self, direction: Floats) -> Floats:
        """Return how much of a wave from a direction the best beam takes: (path,) float64, at most 1."""
        wave = 2 * math.pi * float(self.frequency_hz @ self.power) / self.shot.speed_m_s
        beams = np.exp(-1j * wave * (_directions(self.settings) @ self._positions_m.T))
        waves = np.exp(1j * wave * (direction @ self._positions_m.T))
        return np.asarray(np.max(np.abs(beams @ waves.T), axis=0, initial=0.0) / len(self._positions_m))

    def of_white_noise(self, dbfs: float, *, coherent: bool = False, band_hz: tuple[float, float] | None = None) -> float:
        """Return the highest amplitude that noise reaches in the image.

        Parameters
        ----------
        dbfs : float
            Root mean square, over the whole band or ``band_hz``.
        coherent : bool
            The noise comes from one place, so that a beam takes all of it.
        band_hz : (low, high), optional
        """
        matched, rate_hz, n_fft = _matched(self.settings)
        frequency_hz = (matched.first_bin + np.arange(len(matched.values))) * rate_hz / n_fft
        low_hz, high_hz = band_hz or (0.0, self.settings.recording.pdm_rate_hz / 2)
        heard = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
        # A density σ² / B, one-sided, through the filter, and as the modulus of the analytic signal.
        power = np.sum(np.abs(matched.values[heard]) ** 2) * rate_hz / n_fft / (high_hz - low_hz) / 2
        mics = 1 if coherent else len(self.shot.channels)
        return float(_PEAK * 10 ** (dbfs / 20) * math.sqrt(power / mics))

    def of_tone(self, amplitude: float, frequency_hz: float) -> float:
        """Return the amplitude of a tone in the image."""
        matched, rate_hz, n_fft = _matched(self.settings)
        place = round(frequency_hz * n_fft / rate_hz) - matched.first_bin
        inside = 0 <= place < len(matched.values)
        return float(amplitude * abs(matched.values[place]) / 2) if inside else 0.0

    def likeness(self, call: Call) -> float:
        """Return the amplitude of another call, 1 at the microphones, in the image; that of the own call is 1."""
        if call == self.settings.call:
            return 1.0
        rate_hz = self.settings.signal_rate_hz
        n_fft = 2 ** math.ceil(math.log2((call.duration_s + self.settings.call.duration_s) * rate_hz + 2))
        mine = matched_filter(self.settings.call, n_fft=n_fft, rate_hz=rate_hz)
        spectrum = np.zeros(n_fft, dtype=np.complex128)
        bins = slice(mine.first_bin, mine.first_bin + len(mine.values))
        spectrum[bins] = np.fft.rfft(call_samples(call, rate_hz=rate_hz), n_fft)[bins] * mine.values
        return float(np.abs(np.fft.ifft(spectrum)).max())

    def pulse_over_s(self) -> float:
        """Return how long after its beginning nothing of a sound that lasts as the call is left in the image."""
        return self.settings.call.duration_s + matched_guard_s(self.settings.call)

    def lags_s(self) -> Floats:
        """Return times from the beginning of the image until the direct sound is over: (time,) float64."""
        begin_s = 2 * self.settings.processing.range_m[0] / self.shot.speed_m_s
        return np.linspace(begin_s, max(begin_s, self.pulse_over_s()), _LAGS)

    def near_field(self, amplitude: Floats, delay_s: Floats) -> Floats:
        """Return the most that beams take, at `lags_s`, of what comes from within the array: (time,) float64.

        Parameters
        ----------
        amplitude, delay_s : (mic,) float64
        """
        frequency_hz, power = _band(self.settings, _LAG_NODES)
        every = max(1, len(_directions(self.settings)) // _LAG_DIRECTIONS)
        early_s = _directions(self.settings)[::every] @ self._positions_m.T / self.shot.speed_m_s
        wave = 2j * math.pi * frequency_hz
        beams = np.einsum("dmf,m->df", np.exp(-wave * (delay_s + early_s)[..., None]), amplitude / len(amplitude))
        return np.asarray(np.max(np.abs(np.exp(wave * self.lags_s()[:, None]) @ (beams * power).T), axis=1))

    def beam_change(self, directions: Floats, weight: NDArray[np.complex128]) -> float:
        """Return by how much beams on reflectors change, beside the reflector, when microphones are weighted.

        Parameters
        ----------
        directions : (path, axis) float64
        weight : (mic, node) complex128
        """
        nodes = slice(_NODES % 8 // 2, None, 8)
        power = self.power[nodes] / self.power[nodes].sum()
        every = max(1, len(_directions(self.settings)) // _BEAM_DIRECTIONS)
        change = 0.0
        for direction in directions[:_BEAM_PATHS]:
            towards = np.concatenate([direction[None], _directions(self.settings)[::every]])
            apart_m = (direction - towards) @ self._positions_m.T
            waves = np.exp(2j * math.pi / self.shot.speed_m_s * apart_m[..., None] * self.frequency_hz[nodes])
            before = np.abs(np.mean(waves, axis=1) @ power)
            after = np.abs(np.mean(waves * weight[:, nodes], axis=1) @ power)
            change = max(change, float(np.max(np.abs(after - before))))
        return change

    @property
    def _positions_m(self) -> Floats:
        return self.shot.layout.positions_m[self.shot.channels]

    def envelope_change(self, before: Echoes, after: Echoes) -> Floats:
        """Return by how much envelopes differ at the most: (path,) float64, for the same paths with other effects."""
        if not len(before):
            return np.zeros(0)
        shift_s = after.delay_s - before.delay_s
        near_s = np.linspace(-1.5, 1.5, 61) / np.ptp(self.frequency_hz)
        # Beyond a few pulses the two no longer meet, and the nodes would repeat them.
        shift_s = np.clip(shift_s, -8 / np.ptp(self.frequency_hz), 8 / np.ptp(self.frequency_hz))
        change = np.zeros(len(before))
        for centre_s in (np.zeros_like(shift_s), shift_s):
            time_s = centre_s[:, None] + near_s
            was = self._envelope(before.gain, time_s)
            is_now = self._envelope(after.gain, time_s - shift_s[:, None])
            change = np.maximum(change, np.max(np.abs(is_now - was), axis=1))
        return np.asarray(change * self.coverage(before.direction))

    def _envelope(self, gain: Floats, time_s: Floats) -> Floats:
        turns = np.exp(2j * math.pi * time_s[..., None] * (self.frequency_hz - self.frequency_hz.mean()))
        return np.asarray(np.abs(np.einsum("ptn,pn->pt", turns, gain * self.power)))


def change_db(part: Floats, beside: Floats) -> float:
    """Return by how many decibels amplitudes change others at the most, 0 where there are none."""
    return float(20 * np.log10(1 + np.max(part / beside, initial=0.0)))


@functools.lru_cache(maxsize=16)
def _directions(settings: Settings) -> Floats:
    grid = direction_grid(settings.processing)
    return unit_vectors(grid.azimuth_rad, grid.elevation_rad)


@functools.lru_cache(maxsize=16)
def _matched(settings: Settings) -> tuple[MatchedFilter, float, int]:
    rate_hz = settings.signal_rate_hz
    n_fft = 2 ** math.ceil(math.log2(2 * settings.call.duration_s * rate_hz))
    return matched_filter(settings.call, n_fft=n_fft, rate_hz=rate_hz), rate_hz, n_fft


@functools.lru_cache(maxsize=16)
def _band(settings: Settings, n_nodes: int = _NODES) -> tuple[Floats, Floats]:
    """Return some frequencies of the call's band, and the share of the matched call's power at each."""
    rate_hz, n_fft = settings.signal_rate_hz, 32_768  # bins much narrower than a node
    matched = matched_filter(settings.call, n_fft=n_fft, rate_hz=rate_hz)
    frequency_hz = (matched.first_bin + np.arange(len(matched.values))) * rate_hz / n_fft
    edges = np.linspace(*matched_band_hz(settings.call), n_nodes + 1)
    # S H is what the image sums; between the edges of its window H is conj(S).
    power, _ = np.histogram(frequency_hz, edges, weights=np.abs(matched.values) ** 2)
    return (edges[:-1] + edges[1:]) / 2, power / power.sum()


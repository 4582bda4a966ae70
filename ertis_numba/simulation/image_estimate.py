"""Estimate of a sensor's image of a scene, computed without rendering."""

import functools
import math
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.constants import ERTIS_PDM_RATE_HZ
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.settings import Call
from ertis_numba.simulation import pulse
from ertis_numba.simulation.arrivals import call_filters, echoes, emitted, emitters, responses
from ertis_numba.simulation.converter import QUANTISATION_DBFS
from ertis_numba.simulation.echoes import Echoes, Ways
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.stopwatch import CostStopwatch
from ertis_numba.simulation.surroundings import Surroundings, envelope, greatest, parts

__all__ = ["SAME_RANGE_M", "Sight"]

Floats = NDArray[np.float64]
# Effects that change sound paths.
_GEOMETRY = frozenset(each.name for each in EFFECTS.values() if {"transmitter", "views", "turns"} & {*each.places})
# Effects that change the paths or the amplitudes of a call.
_ON_ECHOES = _GEOMETRY | frozenset(each.name for each in EFFECTS.values() if {"gain", "call_filter"} & {*each.places})
_LAGS, _LAG_DIRECTIONS = 128, 64
_BEAM_PATHS, _BEAM_DIRECTIONS = 6, 361
_SHOWN_DB = 40.0  # dynamic range of an image: weaker reflectors are masked by side lobes
_ACROSS = 8192
_OWN_BYTES = 4_000  # with its settings and the snapshot of one microphone
_SIDE_LOBE = 0.5  # of an array of a few dozen microphones
_CUT = 0.05
_PEAK = 3.3  # highest of some ten thousand Rayleigh-distributed amplitudes, relative to their RMS
SAME_RANGE_M = 0.05
"""Largest difference of ranges that count as the same range, in metres."""
# Level of white noise equivalent to the noise of modulators of each order between 20 and 80 kHz at the clock of eRTIS.
_MODULATOR_DBFS, _MAX_NOISE_DBFS = {1: -22.0, 2: -44.0, 3: -48.0, 4: -58.0}, -10.0


class Sight:
    """Estimated image of one sensor at one time; ``power`` (frequency,) is the share of the matched call's, sum 1."""

    def __init__(self, shot: Snapshot, active: frozenset[str]) -> None:
        self.shot = shot
        # Paths end at the centre of the array: levels at the microphones differ by less than a percent.
        self._middle = shot.at_centre()
        self.active = active
        self.settings = shot.sensor.settings()
        self.frequency_hz, self.power = pulse.band(self.settings)
        self._rings = call_filters(active, shot.sensor.emitter)

    @classmethod
    def of(cls, shot: Snapshot, active: frozenset[str]) -> Self:
        """Return the estimate with given effects; the snapshot caches it."""
        return shot.once((cls, active), lambda: cls(shot, active))

    @property
    def nbytes(self) -> int:
        """Size of the object in bytes. All arrays with an element per path or direction are results of their own."""
        return _OWN_BYTES

    @property
    def heard(self) -> Echoes:
        """Echoes of the sensor's own call, and of other sensors' calls if cross-emission is simulated."""
        return self.echoes(self.active)

    @property
    def shown(self) -> NDArray[np.bool_]:
        """True for echoes that the image shows: (path,) bool."""
        level = self.heard.level
        weakest = max(self.noise, float(level.max(initial=0.0)) * 10 ** (-_SHOWN_DB / 20))
        return np.asarray((level > weakest) & self.inside(self.heard.delay_s))

    @functools.cached_property
    def floor(self) -> float:
        """Amplitude of the weakest reflector that the image shows, or of its noise if it shows none."""
        shown = self.shown
        return float(np.min(self.heard.level[shown])) if shown.any() else self.noise

    @functools.cached_property
    def noise(self) -> float:
        """Highest amplitude that the noise of modulators or converters reaches in the image."""
        if not self.settings.recording.is_pdm:
            return self.of_white_noise(QUANTISATION_DBFS[self.settings.recording.encoding])
        order = self.shot.sensor.electronics.modulator_order
        # Shaped noise rises with the ratio of band to clock, by 6 dB per octave and order.
        slower = ERTIS_PDM_RATE_HZ / self.settings.recording.sample_rate_hz
        dbfs = _MODULATOR_DBFS[order] + 20 * order * math.log10(slower)
        return self.of_white_noise(min(dbfs, _MAX_NOISE_DBFS))

    def echoes(self, active: frozenset[str]) -> Echoes:
        """Return the echoes of all calls with other effects."""
        numbers = self.emitters(active)
        if len(numbers) == 1:
            return self.of_emitter(numbers[0], active)
        return self._middle.once(
            ("echoes", *numbers, active & _ON_ECHOES),
            lambda: Echoes.joined([self.of_emitter(number, active) for number in numbers], self.power),
        )

    def emitters(self, active: frozenset[str]) -> list[int]:
        """Return the numbers of the sensors whose calls arrive, given some effects."""
        return emitters(self.shot, active)

    def of_emitter(self, number: int, active: frozenset[str]) -> Echoes:
        """Return the echoes of one sensor's call; a call unlike the receiving sensor's appears only weakly."""
        return self._middle.once(("echoes", number, active & _ON_ECHOES), lambda: self._echoes(number, active))

    def _echoes(self, number: int, active: frozenset[str]) -> Echoes:
        ways, other = self._ways(number, active), self.shot.scene.sensors[number]
        level = 10 ** (other.emitter.level_db / 20) * emitted(active, other.emitter, self.frequency_hz)
        level = level * self.likeness(other.call)
        gain = np.zeros((len(ways.delay_s), pulse.N_NODES))
        parts = [
            responses(self._middle, active, paths, other.emitter, self.frequency_hz, CostStopwatch())[:, 0]
            for paths in ways.paths
        ]
        gain = level * np.concatenate([np.broadcast_to(part, (len(part), pulse.N_NODES)) for part in parts] or [gain])
        # Delays are relative to the emission of the receiving sensor, as ranges are.
        delay_s = ways.delay_s + (other.call.start_s - self.settings.call.start_s)
        return Echoes(ways.names, gain, delay_s, ways.direction, ways.coverage, self.power)

    def paths(self, number: int, active: frozenset[str]) -> list[Paths]:
        """Return the paths of an emitter's call to the centre of the array."""
        return self._ways(number, active).paths

    def _ways(self, number: int, active: frozenset[str]) -> Ways:
        middle, geometry = self._middle, active & _GEOMETRY

        def found() -> Ways:
            paths = echoes(middle, geometry, number, CostStopwatch())
            own = "" if number == self.shot.number else f"{self.shot.scene.sensors[number].name}: "
            direction = [np.einsum("pkx,px->pk", part.receiver.axes, -part.arriving[:, 0]) for part in paths]
            towards = np.concatenate([np.zeros((0, 3)), *direction])
            return Ways(
                paths=paths,
                names=tuple(own + name for part in paths for name in part.names),
                delay_s=np.concatenate([np.zeros(0), *(part.length_m[:, 0] for part in paths)]) / self.shot.speed_m_s,
                direction=towards,
                coverage=self.coverage(towards),
            )

        return middle.once(("ways", number, geometry), found)

    def inside(self, delay_s: Floats) -> NDArray[np.bool_]:
        """Return True for echoes in the image's range window: (path,) bool."""
        return np.asarray(self._outside_s(delay_s) == 0)

    def reach(self, delay_s: Floats) -> Floats:
        """Return the fraction (path,) of each echo, by its range side lobes, that reaches into the range window."""
        return self._lobe(self._outside_s(delay_s))

    def _outside_s(self, delay_s: Floats) -> Floats:
        first_s, last_s = self._window_s()
        return np.maximum(np.maximum(first_s - delay_s, delay_s - last_s), 0.0)

    def surroundings(self, after: Echoes | None = None) -> Surroundings:
        """Return the highest amplitudes of the image, or of the weaker of both if ``after`` has other effects."""
        level, floor = self.heard.level, self.floor
        if after is not None:
            level = np.minimum(level, after.level)
            floor = max(float(np.min(level[self.shown], initial=floor)), self.noise)
        loud = level > floor
        return Surroundings(
            floor=floor,
            level=level[loud],
            delay_s=self.heard.delay_s[loud],
            window_s=self._window_s(),
            same_s=2 * SAME_RANGE_M / self.shot.speed_m_s,
            lobe=self._lobe,
        )

    @functools.cached_property
    def quietest(self) -> float:
        """Lowest of the highest amplitudes at each range of the image, at least its floor."""
        return float(np.min(self.surroundings().at(np.linspace(*self._window_s(), _LAGS))))

    def _window_s(self) -> tuple[float, float]:
        first_m, last_m = self.settings.processing.range_m
        return 2 * first_m / self.shot.speed_m_s, 2 * last_m / self.shot.speed_m_s

    def _lobe(self, lag_s: Floats) -> Floats:
        """Return the highest range side lobe of the call at a lag or beyond, 1 at its peak."""
        lags_s, envelope = pulse.envelope(self.settings, self._rings)
        return np.asarray(np.interp(lag_s, lags_s, np.maximum.accumulate(envelope[::-1])[::-1]))

    def coverage(self, direction: Floats) -> Floats:
        """Return the gain of the best beam for a wave from each direction: (path,) float64, at most 1."""
        # Sensors with equal settings share the beams, and no sight holds them: each takes a megabyte or more.
        beams = self.shot.cache.once(("beams", self.settings), self._beams)
        wave = self._wavenumber_rad_m
        taken = np.zeros(len(direction))
        for part in parts(len(direction), max(beams.shape)):
            waves = np.exp(1j * wave * (direction[part] @ self._positions_m.T))
            signals = beams @ waves.T
            taken[part] = np.max(signals.real**2 + signals.imag**2, axis=0, initial=0.0)  # faster than np.abs
        return np.sqrt(taken) / len(self._positions_m)

    @property
    def _wavenumber_rad_m(self) -> float:
        """Wavenumber at the mean frequency."""
        return 2 * math.pi * float(self.frequency_hz @ self.power) / self.shot.speed_m_s

    def _beams(self) -> NDArray[np.complex128]:
        """Return the phases of the beams of all directions: (direction, mic)."""
        return np.asarray(np.exp(-1j * self._wavenumber_rad_m * (self._directions @ self._positions_m.T)))

    @property
    def _directions(self) -> Floats:
        """Unit vectors towards the directions of the image: (direction, axis)."""

        def found() -> Floats:
            grid = direction_grid(self.settings.processing)
            return unit_vectors(grid.azimuth_rad, grid.elevation_rad)

        return self.shot.cache.once(("directions", self.settings.processing), found)

    def of_white_noise(
        self, dbfs: float, *, coherent: bool = False, band: tuple[Floats, Floats] | None = None
    ) -> float:
        """Return the highest amplitude that white noise, or noise with a spectrum, reaches in the image."""
        # `dbfs` is the RMS over the whole band or `band`, frequencies and powers. `coherent` noise is from one place.
        matched, rate_hz, n_fft = pulse.match(self.settings)
        heard_hz = (matched.first_bin + np.arange(len(matched.values))) * rate_hz / n_fft
        half_hz = self.settings.recording.sample_rate_hz / 2
        across_hz, density = band or (np.linspace(0.0, half_hz, _ACROSS), np.ones(_ACROSS))
        response = np.interp(across_hz, heard_hz, np.abs(matched.values), left=0.0, right=0.0)
        # One-sided density σ² / B after the filter, and as the modulus of the analytic signal.
        power = float(np.average(response**2, weights=density)) / 2 if density.any() else 0.0
        mics = 1 if coherent else len(self.shot.channels)
        return float(_PEAK * 10 ** (dbfs / 20) * math.sqrt(power / mics))

    def of_tone(self, amplitude: float, frequency_hz: float) -> float:
        """Return the amplitude of a tone in the image."""
        matched, rate_hz, n_fft = pulse.match(self.settings)
        place = round(frequency_hz * n_fft / rate_hz) - matched.first_bin
        response = np.abs(matched.values)
        inside = 0 <= place < len(response)
        # Outside of the band, the truncation of the record to the window leaks some of the tone.
        return float(amplitude / 2 * (response[place] if inside else _CUT * response.max()))

    def likeness(self, call: Call) -> float:
        """Return another call's amplitude in the image relative to the own call, both 1 at the microphones."""
        if call.sounds_like(self.settings.call):
            return 1.0
        return float(np.abs(pulse.matched(self.settings, call)).max())

    def near_field(self, amplitude: Floats, delay_s: Floats) -> tuple[Floats, Floats]:
        """Return times after the image begins, and the highest amplitude of sound within the array in any beam."""
        begin_s = 2 * self.settings.processing.range_m[0] / self.shot.speed_m_s
        time_s = begin_s + np.linspace(0.0, self.settings.call.duration_s, _LAGS)
        every = max(1, len(self._directions) // _LAG_DIRECTIONS)
        early_s = self._directions[::every] @ self._positions_m.T / self.shot.speed_m_s
        lag_s, sound = pulse.baseband(self.settings, self._rings)
        at_s = time_s[:, None, None] - (delay_s + early_s)
        carrier = np.exp(2j * math.pi * float(self.frequency_hz @ self.power) * at_s)
        heard = (np.interp(at_s, lag_s, sound.real) + 1j * np.interp(at_s, lag_s, sound.imag)) * carrier
        return time_s, np.asarray(np.max(np.abs(heard @ amplitude) / len(amplitude), axis=1))

    def beam_change(self, directions: Floats, weight: Floats | NDArray[np.complex128]) -> float:
        """Return the greatest change of beams at reflectors (path, axis) by microphone weights (mic, frequency)."""
        nodes = slice(pulse.N_NODES % 8 // 2, None, 8)
        power = self.power[nodes] / self.power[nodes].sum()
        every = max(1, len(self._directions) // _BEAM_DIRECTIONS)
        change = 0.0
        for direction in directions[:_BEAM_PATHS]:
            towards = np.concatenate([direction[None], self._directions[::every]])
            apart_m = (direction - towards) @ self._positions_m.T
            waves = np.exp(2j * math.pi / self.shot.speed_m_s * apart_m[..., None] * self.frequency_hz[nodes])
            before = np.abs(np.mean(waves, axis=1) @ power)
            after = np.abs(np.mean(waves * weight[:, nodes], axis=1) @ power)
            change = max(change, float(np.max(np.abs(after - before))))
        return change

    @property
    def _positions_m(self) -> Floats:
        return self.shot.layout.positions_m[self.shot.channels]

    def most_changed(
        self,
        before: Echoes,
        after: Echoes,
        around: Surroundings,
        reach: Floats,
        *,
        turn_s: Floats | None = None,
        aside: Floats | float = 0.0,
    ) -> tuple[int, float]:
        """Return the path that changes most relative to the image ``around`` it, and the ratio."""
        # Its envelope changes, and its carrier by `turn_s` (path,). `reach` is as in `reach`; `aside`: other changes.
        shift_s = after.delay_s - before.delay_s
        turn_s = np.abs(shift_s) if turn_s is None else turn_s
        centre_hz = float(self.frequency_hz @ self.power)
        turn = np.where(turn_s * centre_hz < 0.5, 2 * np.abs(np.sin(math.pi * centre_hz * turn_s)), 2.0)
        # Beyond a few pulse lengths the two no longer overlap, and the sampled spectrum would repeat them.
        shift_s = np.clip(shift_s, -8 / np.ptp(self.frequency_hz), 8 / np.ptp(self.frequency_hz))
        offset_hz = self.frequency_hz - self.frequency_hz.mean()
        was, is_now = before.gain * self.power, after.gain * self.power
        later = np.exp(-2j * math.pi * np.outer(shift_s, offset_hz)) if shift_s.any() else np.ones((len(before), 1))
        near_s = np.linspace(-1.5, 1.5, 61) / np.ptp(self.frequency_hz)
        turns = np.exp(2j * math.pi * np.outer(offset_hz, near_s))

        def ratio(part: NDArray[np.intp]) -> Floats:
            change = np.maximum(turn[part] * self._met(before, part) if turn[part].any() else 0.0, aside_of[part])
            # Around the first pulse, then around the second; they coincide without a shift.
            both = [(was[part], is_now[part] * later[part]), (was[part] * later[part].conj(), is_now[part])]
            for one, other in both if shift_s[part].any() else both[:1]:
                own = np.max(np.abs(envelope(one, turns) - envelope(other, turns)), axis=1) * before.coverage[part]
                change = np.maximum(change, own)
            return np.asarray(change * reach[part] / around.at(before.delay_s[part]))

        aside_of = np.broadcast_to(np.asarray(aside, dtype=np.float64), reach.shape)
        most = np.sum(np.abs(was - is_now * later), axis=1) * before.coverage
        most = np.maximum(np.maximum(most, aside_of), turn * _SIDE_LOBE * self._lobe(np.zeros(1)) * before.level)
        return greatest(most * reach / around.floor, ratio)

    def turn_change(self, seen: Echoes, angle_rad: Floats) -> Floats:
        """Return the change of the image by a small change of the echoes' directions: (path,) float64."""
        aperture_m = math.sqrt(float(np.mean(np.sum(self._positions_m**2, axis=1))))
        return np.asarray(seen.level * np.minimum(self._wavenumber_rad_m * aperture_m * angle_rad, 1.0))

    def _met(self, seen: Echoes, places: NDArray[np.intp]) -> Floats:
        """Return the highest overlap of some paths with the side lobes of others: (path,) float64."""
        level, delay_s, direction = seen.level[places], seen.delay_s[places], seen.direction[places]
        heard = self.heard
        strongest = np.zeros(len(level))
        for part in parts(len(level), 3 * len(heard)):
            apart_s = np.abs(delay_s[part, None] - heard.delay_s)
            met = _SIDE_LOBE * np.minimum(level[part, None], heard.level) * self._lobe(apart_s)
            row, column = np.nonzero(apart_s == 0)
            same = np.all(direction[part][row] == heard.direction[column], axis=-1)
            met[row[same], column[same]] = 0.0
            strongest[part] = np.max(met, axis=1, initial=0.0)
        return strongest

"""Rendering of a scene with given effects to PDM bits or PCM samples."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import checks
from ertis_numba.base.constants import SYNC_STEP_S
from ertis_numba.frames import Measurement, Reflector, Stamp, TrueSource
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import Layout, microphones
from ertis_numba.simulation import noise_frames, synthesis
from ertis_numba.simulation.arrivals import arrivals, gains
from ertis_numba.simulation.converter import Converter
from ertis_numba.simulation.effects import acting
from ertis_numba.simulation.modulator import Modulator
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sensors import Sensor
from ertis_numba.simulation.snapshot import Snapshot, snapshot
from ertis_numba.simulation.stopwatch import CostStopwatch
from ertis_numba.simulation.target_validity import require_clear
from ertis_numba.simulation.truth import reflectors, true_sources

__all__ = ["Engine"]

_EVERY = 16  # samples between those whose level is noted: a call at 80 kHz has three of them per period
_CHANNELS = 128  # rendered at a time, so that memory does not grow with the array; a multiple of every word size


class Engine:
    """Renders the measurements of one sensor with given effects; the bits do not depend on ``threads``.

    ``loudest``: highest amplitude at a modulator or converter so far, full scale 1. Modulators are linear up to about
    0.6, converters up to 1.
    """

    def __init__(self, scene: Scene, sensor: Sensor, active: frozenset[str], *, threads: int | None = None) -> None:
        self.scene = scene
        self.sensor = sensor
        self.active = active
        self.clock = CostStopwatch()
        self.loudest = 0.0
        sensor.require_microphones()
        self._layout = microphones(self.sensor.array)
        self._settings = self.sensor.settings()
        self._threads = kernels.load_host().max_threads if threads is None else threads
        rate_hz = self.sensor.recording.sample_rate_hz
        calls = [*(other.call for other in scene.sensors), *(sonar.call for sonar in scene.sonars)]
        tops_hz = [synthesis.highest_hz(call, rate_hz) for call in calls]
        tops_hz += [min(noise_frames.top_hz(noise), rate_hz / 2) for noise in scene.noises]
        self._node_hz = synthesis.node_frequencies(max(tops_hz))

    def render(self, index: int = 0) -> Measurement:
        """Return measurement ``index``; scene, sensor and index determine every bit.

        Channels without a microphone contain zeros.
        """
        shot = self._shot(index)
        form = sample_format(self._settings)
        words = np.zeros(form.shape_2d, form.dtype)
        if not self.sensor.recording.is_pdm:
            self._convert(shot, index, words)
        for channels in range(0, len(self._layout.enabled) if self.sensor.recording.is_pdm else 0, _CHANNELS):
            part = slice(channels, channels + _CHANNELS)
            columns = slice(channels // self._layout.word_bits, (channels + _CHANNELS) // self._layout.word_bits)
            self._modulate(shot, index, part, words[:, columns])
        for name, act in acting("samples", self.active):
            with self.clock(name):
                act(words, self.sensor)
        return Measurement(words.reshape(form.shape), self._settings, self._stamp(shot, index))

    def signals(self, index: int = 0) -> NDArray[np.float64]:
        """Return the input of the modulators without their own noise: (mic, sample) float64, full scale 1."""
        n_samples = self.sensor.recording.n_samples
        blocks = [block[:, : synthesis.BLOCK].copy() for block in self._signals(self._shot(index), index)]
        return np.concatenate(blocks, axis=1)[:, :n_samples]

    def reflectors(self, index: int = 0) -> list[Reflector]:
        """Return the reflectors that an image of measurement ``index`` should show, strongest first."""
        return reflectors(self._shot(index), self.active)

    def sources(self, index: int = 0) -> list[TrueSource]:
        """Return the sources of sound during measurement ``index``, in the order of tones, noises and sonars."""
        return true_sources(self._shot(index), self.active)

    def _shot(self, index: int) -> Snapshot:
        checks.integer("index", index, 0)
        shot = snapshot(self.scene, self.sensor, index / self.scene.rate_hz)
        require_clear(shot)
        return shot

    def converted(self, signals: NDArray[np.float64], draw: int) -> NDArray[Any]:
        """Return the raw samples for signals that already contain all noise other than that of the conversion.

        ``signals`` (mic, sample): full scale 1. ``draw``: seed of the modulators' dither.
        """
        form = sample_format(self._settings)
        words = np.zeros(form.shape_2d, form.dtype)
        keys = np.arange(len(signals), dtype=np.uint64) + np.uint64(draw * len(signals))
        if self.sensor.recording.is_pdm:
            self._modulator(self._layout, keys, 0.0).process(signals, out=words)
            return words
        numbers = np.empty((len(words), len(signals)), form.dtype)
        Converter(self.sensor.recording, keys, 0.0).process(signals, out=numbers)
        words[:, np.flatnonzero(self._layout.enabled)] = numbers
        return words

    def _modulator(self, layout: Layout, keys: NDArray[np.uint64], noise_rms: float) -> Modulator:
        electronics, recording = self.sensor.electronics, self.sensor.recording
        return Modulator(
            layout,
            keys,
            np.full(len(keys), noise_rms),
            order=electronics.modulator_order,
            dither=electronics.dither,
            band=min(self.sensor.call.high_frequency_hz / recording.sample_rate_hz, 0.25),
            threads=self._threads,
        )

    def _modulate(self, shot: Snapshot, index: int, part: slice, out: NDArray[np.unsignedinteger]) -> None:
        """Write the PDM words of some channels."""
        mics = np.flatnonzero((shot.channels >= part.start) & (shot.channels < part.stop))
        if not len(mics):
            return
        chosen = slice(mics[0], mics[-1] + 1)
        keys = self._keys(index, len(shot.channels))[chosen]
        modulator = self._modulator(_part(self._layout, part), keys, self.noise_rms())
        for first, block in zip(_begins(len(out)), self._signals(shot.of_mics(chosen), index), strict=True):
            words = np.empty_like(out[first : first + synthesis.BLOCK], order="C")
            with self.clock("modulation"):
                modulator.process(block, out=words)
                self.loudest = max(self.loudest, float(block[:, ::_EVERY].max()), -float(block[:, ::_EVERY].min()))
            out[first : first + len(words)] = words

    def _convert(self, shot: Snapshot, index: int, out: NDArray[np.int16] | NDArray[np.float32]) -> None:
        """Write the PCM samples of all channels."""
        converter = Converter(self.sensor.recording, self._keys(index, len(shot.channels)), self.noise_rms())
        numbers = np.empty((synthesis.BLOCK, len(shot.channels)), out.dtype)
        for first, block in zip(_begins(len(out)), self._signals(shot, index), strict=True):
            rows = out[first : first + synthesis.BLOCK]
            with self.clock("modulation"):
                converter.process(block, out=numbers[: len(rows)])
                self.loudest = max(self.loudest, float(np.abs(block[:, : len(rows)]).max()))
            rows[:, shot.channels] = numbers[: len(rows)]

    def _signals(self, shot: Snapshot, index: int) -> Iterator[NDArray[np.float64]]:
        active, recording = self.active, self.sensor.recording
        arrived = arrivals(shot, active, self._node_hz, self.clock)
        for name, act in acting("frames", active):
            with self.clock(name):
                arrived += act(shot, active, self._node_hz)
        blocks = synthesis.signals(
            arrived,
            n_samples=recording.n_samples,
            rate_hz=recording.sample_rate_hz,
            n_mics=len(shot.channels),
            threads=self._threads,
            clock=self.clock,
        )
        gain, _ = gains(shot, active, self.clock)
        seed = self.scene.seed, index, self.scene.sensors.index(self.sensor)
        # The order determines the last digits of the sum. Recordings hold them, so the last registered stays first.
        sounds = [(name, sound) for name, act in acting("sounds", active)[::-1] for sound in act(shot, active, seed)]
        for first, block in zip(_begins(recording.n_samples), blocks, strict=True):
            if sounds:
                more = np.zeros((len(block), min(synthesis.BLOCK, recording.n_samples - first)))
                for name, sound in sounds:
                    with self.clock(name):
                        sound.add_to(more, first)
                block[:, : more.shape[1]] += gain[:, None] * more
            yield block

    def noise_rms(self) -> float:
        """Return the RMS of the white noise in each microphone, full scale 1."""
        return math.hypot(*(act(self.sensor) for _, act in acting("noise_rms", self.active)))

    def _keys(self, index: int, n_mics: int) -> NDArray[np.uint64]:
        number = self.scene.sensors.index(self.sensor)
        seeds = np.random.SeedSequence((self.scene.seed, index, number)).spawn(n_mics)
        return np.array([seed.generate_state(1, np.uint64)[0] for seed in seeds])

    def _stamp(self, shot: Snapshot, index: int) -> Stamp:
        later_ns = round(SYNC_STEP_S * shot.number * 1e9)
        return Stamp(
            sensor=self.sensor.name,
            sequence=index,
            sync_count=index,
            timestamp_ns=round(index * 1e9 / self.scene.rate_hz) + later_ns,
            behaviour="passive" if self.sensor.emitter.silent else "active",
        )


def _begins(n_samples: int) -> range:
    return range(0, n_samples, synthesis.BLOCK)


def _part(layout: Layout, part: slice) -> Layout:
    return Layout(
        name=layout.name,
        positions_m=layout.positions_m[part],
        enabled=layout.enabled[part],
        gain=layout.gain[part],
        delay_s=layout.delay_s[part],
        word_bits=layout.word_bits,
    )

"""Table of faults, with the injection of each into a healthy recording, and the scene in which a recording shows it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench.health_trials.scenes import Base
from ertis_numba.frames import Measurement
from ertis_numba.geometry import load_layout, microphones
from ertis_numba.settings import Array
from ertis_numba.simulation.modulator import Modulator

__all__ = ["FAULTS", "ArrayFault"]

_ONE = Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8)
_APART_S = 25e-6
_Injected = tuple[NDArray[Any], tuple[int, ...]]
_Injection = Callable[[Base, np.random.Generator], _Injected]
_Change = Callable[[NDArray[Any], np.random.Generator], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class ArrayFault:
    """Fault that can be injected into a recording.

    Attributes
    ----------
    inject : callable
        Returns new words and the faulty channels. The channels are empty if the whole record is faulty.
    names : tuple of str
        Faults of the report that count as correct.
    scene : str
        ``one echo`` or ``direct sound``, the scene that shows the fault best.
    observable : bool
        True if a single recording of that scene shows the fault.
    why : str
        Condition, or the reason why the fault is not observable.
    encodings : tuple of bool
        True for PDM, False for PCM.
    """

    inject: Callable[[Base, np.random.Generator], _Injected]
    names: tuple[str, ...]
    scene: str = "one echo"
    observable: bool = True
    why: str = "any scene"
    encodings: tuple[bool, ...] = (True, False)

    def put_into(self, base: Base, rng: np.random.Generator) -> tuple[Measurement, tuple[int, ...]]:
        """Return the faulty recording and its faulty channels."""
        words, channels = self.inject(base, rng)
        return replace(base.measurement, data=np.ascontiguousarray(words)), channels


def _column(base: Base, channel: int) -> NDArray[Any]:
    words = base.measurement.data
    if base.sensor.recording.is_pdm:
        return np.asarray(words >> np.uint32(channel) & np.uint32(1)).astype(np.uint8)
    return words[:, channel].copy()


def _with_channels(base: Base, columns: dict[int, NDArray[Any]], words: NDArray[Any] | None = None) -> NDArray[Any]:
    """Return a copy of the words with other samples in some channels."""
    words = (base.measurement.data if words is None else words).copy()
    for channel, column in columns.items():
        if base.sensor.recording.is_pdm:
            bit = np.uint32(1 << channel)
            words = words & ~bit | (np.asarray(column).astype(np.uint32) << np.uint32(channel))
        else:
            words[:, channel] = column
    return words


def _converted(base: Base, signal: NDArray[np.float64], rng: np.random.Generator) -> NDArray[Any]:
    """Return the samples that one microphone produces for a signal."""
    electronics, recording = base.sensor.electronics, base.sensor.recording
    rms = 10 ** ((electronics.noise_dbfs or -300.0) / 20)
    if not recording.is_pdm:
        noisy = signal + rms * rng.standard_normal(len(signal))
        return np.clip(np.rint(32768 * noisy), -32768, 32767).astype(np.int16)
    key = rng.integers(0, 2**63, 1).astype(np.uint64)
    band = base.sensor.call.high_frequency_hz / recording.sample_rate_hz
    modulator = Modulator(
        microphones(_ONE), key, np.array([rms]), order=electronics.modulator_order, dither=electronics.dither, band=band
    )
    out = np.zeros((len(signal), 1), np.uint8)
    modulator.process(signal[None], out=out)
    return out[:, 0] & 1


def _signal(change: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]) -> _Injection:
    """Return an injection that changes the signal of one channel, by a function of signal and time."""

    def inject(base: Base, rng: np.random.Generator) -> _Injected:
        channel = int(rng.integers(len(base.signals)))
        time_s = np.arange(base.signals.shape[1]) / base.sensor.recording.sample_rate_hz
        return _with_channels(base, {channel: _converted(base, change(base.signals[channel], time_s), rng)}), (channel,)

    return inject


def _samples(change: _Change) -> _Injection:
    """Return an injection that changes the samples of one channel."""

    def inject(base: Base, rng: np.random.Generator) -> _Injected:
        channel = int(rng.integers(len(base.signals)))
        return _with_channels(base, {channel: change(_column(base, channel), rng)}), (channel,)

    return inject


def _ordered(source: NDArray[np.intp]) -> _Injection:
    """Return an injection that permutes the channels."""

    def inject(base: Base, _: np.random.Generator) -> _Injected:
        columns = {to: _column(base, int(origin)) for to, origin in enumerate(source) if to != origin}
        return _with_channels(base, columns), ()

    return inject


def _rows(change: _Change) -> _Injection:
    """Return an injection that changes all words."""

    def inject(base: Base, rng: np.random.Generator) -> _Injected:
        return change(base.measurement.data, rng), ()

    return inject


def _stuck(value: int) -> _Injection:
    return _samples(lambda x, _: np.full_like(x, value if x.dtype == np.uint8 else (-32768, 32767)[value]))


def _half_stuck(x: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    first = int(rng.integers(len(x) // 2))
    out = x.copy()
    out[first : first + len(x) // 2] = 0
    return out


def _intermittent(x: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    out, length = x.copy(), len(x) // 16
    for _ in range(4):
        first = int(rng.integers(len(x) - length))
        out[first : first + length] = 0
    return out


def _white(x: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    if x.dtype == np.uint8:
        return (rng.random(len(x)) < 0.5).astype(np.uint8)
    return rng.integers(-32768, 32768, len(x)).astype(np.int16)


def _flipped(share: float) -> _Injection:
    return _samples(lambda x, rng: x ^ (rng.random(len(x)) < share).astype(np.uint8))


def _noisier(more_db: float) -> _Injection:
    def inject(base: Base, rng: np.random.Generator) -> _Injected:
        louder = base.sensor.electronics.replace(noise_dbfs=min((base.sensor.electronics.noise_dbfs or 0) + more_db, 0))
        noisy = replace(base, sensor=base.sensor.replace(electronics=louder))
        channel = int(rng.integers(len(base.signals)))
        return _with_channels(base, {channel: _converted(noisy, base.signals[channel], rng)}), (channel,)

    return inject


def _amplified(gain_db: float) -> _Injection:
    def inject(base: Base, rng: np.random.Generator) -> _Injected:
        quieter = base.sensor.electronics.replace(noise_dbfs=(base.sensor.electronics.noise_dbfs or 0) + gain_db)
        other = replace(base, sensor=base.sensor.replace(electronics=quieter))
        channel = int(rng.integers(len(base.signals)))
        signal = 10 ** (gain_db / 20) * base.signals[channel]
        return _with_channels(base, {channel: _converted(other, signal, rng)}), (channel,)

    return inject


def _late(delay_s: float) -> _Injection:
    def change(x: NDArray[np.float64], time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(time_s - delay_s, time_s, x, left=0.0)

    return _signal(change)


def _swapped(*, apart: bool) -> _Injection:
    """Return an injection that swaps two microphones.

    Their delays differ by more than the tolerance between microphones if ``apart``, otherwise by as little as possible.
    """

    def inject(base: Base, rng: np.random.Generator) -> _Injected:
        delay_s = base.echo_s()
        one = int(rng.integers(len(delay_s)))
        differ_s = np.abs(delay_s - delay_s[one])
        fitting = np.flatnonzero(differ_s > _APART_S) if apart else np.argsort(differ_s)[1:2]
        # A microphone in the middle of the array may have no partner. The farthest microphone replaces it.
        if not len(fitting):
            fitting = np.argsort(differ_s)[-1:]
        other = int(rng.choice(fitting))
        return _with_channels(base, {one: _column(base, other), other: _column(base, one)}), (one, other)

    return inject


def _of_layout(base: Base, rng: np.random.Generator) -> _Injected:
    """Return the channels of an eRTIS_v2 in the order of an eRTIS_v3D1, or vice versa."""
    names = ("eRTIS_v2", "eRTIS_v3D1")
    own = base.sensor.array.layout
    other = names[1 - names.index(own)]
    mine, theirs = load_layout(own).positions_m, load_layout(other).positions_m
    source = np.argmin(np.linalg.norm(theirs[:, None] - mine[None], axis=2), axis=1)
    return _ordered(source)(base, rng)


def _repeated(words: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    length = 1024
    first = int(rng.integers(len(words) - 2 * length))
    out = words.copy()
    out[first + length : first + 2 * length] = out[first : first + length]
    return out


def _dropped(words: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    first = int(rng.integers(len(words) - 200))
    return np.concatenate([words[:first], words[first + 50 :], words[:50]])


def _shifted(base: Base, rng: np.random.Generator) -> _Injected:
    shift = round(5000 / 4.5e6 * base.sensor.recording.sample_rate_hz)
    return np.roll(base.measurement.data, shift if rng.random() < 0.5 else -shift, axis=0), ()


def _crosstalk(base: Base, rng: np.random.Generator) -> _Injected:
    one, other = (int(channel) for channel in rng.choice(len(base.signals), 2, replace=False))
    return _with_channels(base, {one: _converted(base, base.signals[one] + 0.5 * base.signals[other], rng)}), (one,)


def _copied(base: Base, rng: np.random.Generator) -> _Injected:
    one, other = (int(channel) for channel in rng.choice(len(base.signals), 2, replace=False))
    return _with_channels(base, {one: _column(base, other)}), (one, other)


def _half_missing(base: Base, _: np.random.Generator) -> _Injected:
    silent = np.zeros(len(base.measurement.data), np.uint8)
    return _with_channels(base, dict.fromkeys(range(16), silent)), tuple(range(16))


def _inverted(x: NDArray[Any], _: np.random.Generator) -> NDArray[Any]:
    return 1 - x if x.dtype == np.uint8 else np.clip(-x.astype(np.int32), -32768, 32767).astype(np.int16)


def _alternating(x: NDArray[Any], _: np.random.Generator) -> NDArray[Any]:
    return (np.arange(len(x)) % 2).astype(x.dtype)


_ECHO = "a compact arrival from the side"
_BITS = (True,)
_TWISTED = np.arange(32).reshape(4, 8)

FAULTS = {
    "stuck at 0": ArrayFault(_stuck(0), ("stuck at",)),
    "stuck at 1": ArrayFault(_stuck(1), ("stuck at",)),
    "alternating bits": ArrayFault(_samples(_alternating), ("stuck in a pattern",), encodings=_BITS),
    "stuck half of the time": ArrayFault(_samples(_half_stuck), ("stuck at times",)),
    "intermittent contact": ArrayFault(_samples(_intermittent), ("stuck at times",)),
    "white bits, unconnected": ArrayFault(_samples(_white), ("white bits", "noisy")),
    "noise +20 dB": ArrayFault(_noisier(20.0), ("noisy", "white bits", "flipped bits")),
    "noise +10 dB": ArrayFault(_noisier(10.0), ("noisy",), why="a noise floor of the microphones, not of echoes"),
    "gain +10 dB": ArrayFault(_amplified(10.0), ("gain",), why="a sound at least 9 dB above the noise"),
    "gain -10 dB": ArrayFault(_amplified(-10.0), ("gain", "dead"), why="a sound at least 9 dB above the noise"),
    "gain +6 dB": ArrayFault(_amplified(6.0), ("gain",), why="an echo, and a gain spread of 0.5 dB"),
    "gain -6 dB": ArrayFault(_amplified(-6.0), ("gain",), why="an echo, and a gain spread of 0.5 dB"),
    "inverted polarity": ArrayFault(_samples(_inverted), ("inverted polarity",), why="a compact arrival"),
    "two channels swapped": ArrayFault(
        _swapped(apart=True), ("swapped",), why="an echo that reaches both at least 25 µs apart"
    ),
    "two channels swapped of nearly equal delay": ArrayFault(
        _swapped(apart=False),
        ("swapped",),
        observable=False,
        why="the delay difference is below the tolerance of microphones",
    ),
    "order reversed": ArrayFault(_ordered(np.arange(32)[::-1]), ("order of channels",), why=_ECHO),
    "bits reversed in each byte": ArrayFault(_ordered(_TWISTED[:, ::-1].ravel()), ("order of channels",), why=_ECHO),
    "bytes reversed": ArrayFault(_ordered(_TWISTED[::-1].ravel()), ("order of channels",), why=_ECHO),
    "order of another layout": ArrayFault(_of_layout, ("order of channels",), why=_ECHO),
    "two channels identical": ArrayFault(_copied, ("duplicate",)),
    "1 % of bits flipped": ArrayFault(_flipped(0.01), ("flipped bits", "noisy"), encodings=_BITS),
    "0.1 % of bits flipped": ArrayFault(_flipped(0.001), ("flipped bits", "noisy"), encodings=_BITS),
    "1 % of bits flipped in every channel": ArrayFault(
        _rows(lambda w, rng: w ^ np.packbits(rng.random((len(w), 32)) < 0.01, axis=1).view("<u4")[:, 0]),
        ("flipped bits",),
        encodings=_BITS,
    ),
    "repeated block": ArrayFault(_rows(_repeated), ("repeated blocks",)),
    "50 words dropped": ArrayFault(
        _rows(_dropped),
        ("shifted record",),
        observable=False,
        why="all channels are equal, and echoes only arrive earlier",
    ),
    "shifted by 1.1 ms": ArrayFault(_shifted, ("shifted record",), scene="direct sound", why="a direct sound"),
    "overload": ArrayFault(_signal(lambda x, t: x + 1.5 * np.sin(2.5e5 * t) * (t < 4e-3)), ("saturated",)),
    "DC offset": ArrayFault(_signal(lambda x, _: x + 0.1), ("offset",)),
    "hum": ArrayFault(_signal(lambda x, t: x + 0.1 * np.sin(2 * np.pi * 100 * t)), ("low-frequency hum", "offset")),
    "idle tone": ArrayFault(_signal(lambda x, t: x + 0.02 * np.sin(2 * np.pi * 31e3 * t)), ("idle tone",)),
    "half of the channels missing": ArrayFault(_half_missing, ("stuck at",)),
    "late by 50 µs": ArrayFault(_late(50e-6), ("late",), why="a compact arrival"),
    "late by 1 sample of PDM": ArrayFault(
        _late(1 / 4.5e6), ("late",), observable=False, why="0.2 µs, below the tolerance of microphones"
    ),
    "late by 10 samples of PDM": ArrayFault(
        _late(10 / 4.5e6), ("late",), observable=False, why="2.2 µs, below the tolerance of microphones"
    ),
    "bytes of numbers swapped": ArrayFault(
        _rows(lambda w, _: w.byteswap()), ("order of bytes",), encodings=(False,), why="any scene of 16-bit numbers"
    ),
    "crosstalk of -6 dB": ArrayFault(
        _crosstalk, ("late", "gain"), observable=False, why="not distinguishable from a sound with two arrivals"
    ),
}
"""All kinds of faults by name."""

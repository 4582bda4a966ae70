"""Small scenes and measurement functions for the tests of the simulator."""

import numpy as np

from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Array, Call, Processing, Recording
from ertis_numba.simulation import Emitter, Scene, Sensor
from ertis_numba.simulation.arrivals import arrivals
from ertis_numba.simulation.effect_plan import EffectPlan, Verdict
from ertis_numba.simulation.effects import EFFECTS, INDISPENSABLE
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.snapshot import snapshot
from ertis_numba.simulation.stopwatch import CostStopwatch

RATE_HZ = 4_500_000.0
ONE = Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8)
THREE = Array(layout="three", positions_m=((0.0, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, -0.03)), word_bits=8)
SENSOR = Sensor(array=THREE, recording=Recording(n_samples=40_000), processing=Processing(range_m=(0.3, 0.9)))
EAR = SENSOR.replace(array=ONE)
NARROW = Call(start_frequency_hz=40_500.0, stop_frequency_hz=39_500.0, duration_s=2.5e-3)
BAND_HZ = np.linspace(27e3, 48e3, 22)
SPEED_M_S = sound_speed_m_s(SENSOR.air)


def only(*names):
    """A plan with the given effects and the indispensable ones, whatever the scene needs."""
    return EffectPlan(
        tuple(
            Verdict(name=name, on=name in names or name in INDISPENSABLE, reason="a test asks for it", estimate_db=None)
            for name in EFFECTS
        )
    )


def line_array(n_mics, spacing_m):
    """A line of microphones along y, centred on the origin."""
    places_m = spacing_m * (np.arange(n_mics) - (n_mics - 1) / 2)
    return Array(layout="line", positions_m=tuple((0.0, float(y), 0.0) for y in places_m), word_bits=64)


def heard(scene, *names, index=0, sensor=None):
    """Signals before the modulators: (mic, sample) float64."""
    return Simulator(scene, sensor=sensor, plan=only(*names)).signals(index)


def ways(scene, *names, index=0, sensor=None, frequency_hz=(40_000.0,)):
    """Arrivals of the calls with the given effects."""
    shot = snapshot(scene, scene.sensor(sensor), index / scene.rate_hz)
    return arrivals(shot, {*names, *INDISPENSABLE}, np.asarray(frequency_hz, dtype=np.float64), CostStopwatch())


def sorted_ways(scene, *names, **options):
    """Delay and amplitude of all arrivals at the first microphone, sorted by delay: both (path,) float64."""
    found = ways(scene, *names, **options)
    delay_s = np.concatenate([np.zeros(0), *(entry.delay_s[:, 0] for entry in found)])
    amplitude = np.concatenate([np.zeros(0), *(entry.amplitude[:, 0, 0] for entry in found)])
    order = np.argsort(delay_s)
    return delay_s[order], amplitude[order]


def seen(scene, *names, index=0, sensor=None):
    """Reflectors of the ground truth with the given effects, strongest first."""
    return Simulator(scene, sensor=sensor, plan=only(*names)).reflectors(index)


def written_out(call, delay_s, amplitude, n_samples, stretch=1.0):
    """Render by summing copies of the call, evaluated at the sample times: (mic, sample) float64.

    Parameters
    ----------
    delay_s, amplitude : (path, mic)
    """
    delay_s, amplitude = np.broadcast_arrays(delay_s, amplitude)
    time_s = np.arange(n_samples) / RATE_HZ
    return sum(
        a[:, None] * call_at(call, (time_s - t[:, None]) / stretch) for t, a in zip(delay_s, amplitude, strict=True)
    )


def error_db(found, wanted):
    """Power of the difference relative to the power of ``wanted``, in dB."""
    return 10 * np.log10(np.sum((found - wanted) ** 2) / np.sum(wanted**2) + 1e-30)


def spectrum_at(signal, frequency_hz):
    """Spectrum of a signal at arbitrary frequencies: (frequency,) complex128."""
    time_s = np.arange(len(signal)) / RATE_HZ
    return np.exp(-2j * np.pi * np.outer(frequency_hz, time_s)) @ signal


def filtered(before, after):
    """Gain of an effect at each frequency of ``BAND_HZ`` in the first microphone's signal."""
    return np.abs(spectrum_at(after[0], BAND_HZ) / spectrum_at(before[0], BAND_HZ))


def bits_of(measurement):
    """Unpack the bits of every channel: (channel, sample) of +1 and −1."""
    words = measurement.data.reshape(len(measurement.data), -1)
    octets = words.astype(words.dtype.newbyteorder("<")).view(np.uint8)
    return 2.0 * np.unpackbits(octets, axis=1, bitorder="little").T - 1.0


def arrival_s(signal, call, near_s):
    """Arrival time of the call in a signal, from the correlation peak, to a small fraction of a sample."""
    n = 2 * len(signal)
    frequency_hz = np.fft.rfftfreq(n, 1 / RATE_HZ)
    inside = (frequency_hz > call.low_frequency_hz) & (frequency_hz < call.high_frequency_hz)
    replica = np.fft.rfft(call_at(call, np.arange(len(signal)) / RATE_HZ), n)
    product = np.where(inside, np.fft.rfft(signal, n) * np.conj(replica), 0)
    for _ in range(4):  # Newton steps to the maximum of the exact correlation
        turn = 2j * np.pi * frequency_hz
        turned = product * np.exp(turn * near_s)
        near_s -= np.sum(turned * turn).real / np.sum(turned * turn**2).real
    return near_s


def scene_of(*points, sensor=SENSOR, **more):
    """A scene with one sensor and the given points."""
    return Scene(seed=7, sensors=(sensor,), points=points, **more)


def listener_and_emitter(receiver_m, mouth_m, **more):
    """A scene with a silent receiver and a second sensor that transmits."""
    receiver = EAR.replace(position_m=vector(receiver_m), emitter=Emitter(silent=True))
    return Scene(sensors=(receiver, EAR.replace(name="mouth", position_m=vector(mouth_m))), **more)


def vector(values):
    """Convert values to a tuple of Python floats, as scenes require."""
    return tuple(float(value) for value in values)

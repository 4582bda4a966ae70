"""Random healthy arrays and scenes, and the recordings into which faults are injected."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Measurement
from ertis_numba.geometry import layout_names, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Array, Call, Recording
from ertis_numba.simulation import Ambient, Electronics, Emitter, Noise, Point, Scene, Sensor, Sonar, Sphere, Tone, Wall
from ertis_numba.simulation.render import Simulator

__all__ = ["SCENES", "Base", "base", "healthy"]

_PDM, _PCM = Recording(n_samples=65_536), Recording(sample_rate_hz=192_000.0, n_samples=4_000, encoding="int16")
_CALLS = (
    Call(),
    Call(start_frequency_hz=80_000.0, stop_frequency_hz=20_000.0),
    Call(start_frequency_hz=60_000.0, stop_frequency_hz=30_000.0, duration_s=1.5e-3, modulation="linear"),
    Call(start_frequency_hz=45_000.0, stop_frequency_hz=25_000.0, duration_s=4e-3, ramp_fraction=0.25),
    Call(duration_s=1e-3),
)


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """Healthy recording into which faults are injected.

    Attributes
    ----------
    measurement : Measurement
    signals : (mic, sample) float64
        Signals before converters and modulators, without their noise.
    sensor : Sensor
    scene : Scene
    """

    measurement: Measurement
    signals: NDArray[np.float64]
    sensor: Sensor
    scene: Scene

    def echo_s(self) -> NDArray[np.float64]:
        """Return the delay of the echo at each microphone, relative to the centre of the array: (mic,) float64."""
        point = self.scene.points[0]
        azimuth, elevation = math.radians(point.azimuth_deg or 0.0), math.radians(point.elevation_deg or 0.0)
        unit = (math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation))
        return np.asarray(-microphones(self.sensor.array).positions_m @ unit / sound_speed_m_s(self.sensor.air))


def _array(rng: np.random.Generator, n_mics: int) -> Array:
    """Return microphones on a line, on a ring or in a box, with a mean spacing of 4 mm."""
    names = layout_names()
    if rng.random() < 0.5:
        return Array(layout=str(rng.choice(names)))
    shape = rng.choice(["line", "ring", "random"])
    if shape == "line":
        places = np.outer(np.arange(n_mics), (0.0, 0.004, 0.0))
    elif shape == "ring":
        turn = 2 * np.pi * np.arange(n_mics) / n_mics
        places = 0.03 * np.column_stack([0 * turn, np.cos(turn), np.sin(turn)])
    else:
        half_m = 0.004 * np.sqrt(n_mics)
        places = rng.uniform(-half_m, half_m, (n_mics, 3)) * (0.2, 1.0, 1.0)
    rows = tuple((float(x), float(y), float(z)) for x, y, z in places)
    return Array(layout=str(shape), positions_m=rows, word_bits=int(rng.choice([8, 16, 32, 64])))


def _point(rng: np.random.Generator, level_dbfs: float) -> Point:
    """Return a point whose echo has the given level at the array."""
    range_m = float(rng.uniform(0.3, 1.4))
    return Point(
        azimuth_deg=float(rng.uniform(-60, 60)),
        elevation_deg=float(rng.uniform(-40, 40)),
        range_m=range_m,
        strength_db=level_dbfs + 40 * math.log10(range_m),
    )


def _nothing(_: np.random.Generator) -> dict[str, Any]:
    return {}


def _echo(rng: np.random.Generator) -> dict[str, Any]:
    return {"points": (_point(rng, float(rng.uniform(-40, -15))),)}


def _echoes(rng: np.random.Generator) -> dict[str, Any]:
    return {"points": tuple(_point(rng, float(rng.uniform(-60, -30))) for _ in range(rng.integers(2, 25)))}


def _direct(rng: np.random.Generator) -> dict[str, Any]:
    return {**_echoes(rng), "direct_db": float(rng.uniform(-30, -12))}


def _near_overload(rng: np.random.Generator) -> dict[str, Any]:
    return {"points": (_point(rng, -9.0),), "direct_db": float(rng.uniform(-10, -7))}


def _walls(rng: np.random.Generator) -> dict[str, Any]:
    wall = Wall(position_m=(float(rng.uniform(0.6, 1.5)), 0.0, 0.0), facing_deg=(180.0, 0.0), reflection_db=-15.0)
    floor = Wall(position_m=(0.0, 0.0, -float(rng.uniform(0.2, 0.5))), facing_deg=(0.0, 90.0), reflection_db=-12.0)
    ball = Sphere(position_m=(float(rng.uniform(0.5, 1.0)), 0.2, 0.0), radius_m=0.05)
    return {"walls": (wall, floor), "spheres": (ball,)}


def _noise(rng: np.random.Generator) -> dict[str, Any]:
    place = float(rng.uniform(0.5, 1.5)), float(rng.uniform(-1, 1)), 0.0
    return {
        **_echoes(rng),
        "ambient": Ambient(level_dbfs=float(rng.uniform(-80, -50))),
        "noises": (Noise(position_m=place, level_db=float(rng.uniform(-80, -45))),),
    }


def _interference(rng: np.random.Generator) -> dict[str, Any]:
    place = float(rng.uniform(0.5, 1.5)), float(rng.uniform(-1, 1)), 0.0
    tone = Tone(position_m=place, frequency_hz=float(rng.uniform(2e4, 5e4)), level_db=float(rng.uniform(-70, -40)))
    other = Sonar(position_m=place, offset_s=float(rng.uniform(0, 0.01)), level_db=-35.0)
    return {**_echo(rng), "tones": (tone,), "sonars": (other,)}


SCENES = {
    "silence": _nothing,
    "one echo": _echo,
    "many echoes": _echoes,
    "strong direct sound": _direct,
    "near overload": _near_overload,
    "walls": _walls,
    "noise": _noise,
    "interference": _interference,
}
"""Scenes that healthy arrays record, by name."""


def _scene(
    seed: int, array: Array, recording: Recording, call: Call, electronics: Electronics, what: dict[str, Any]
) -> Scene:
    direct_db = what.pop("direct_db", None)
    if direct_db is not None:  # ``direct_db`` is the level at the nearest microphone.
        nearest_m = np.linalg.norm(microphones(array).enabled_positions_m, axis=1).min()
        direct_db += 20 * math.log10(max(nearest_m, 1e-3))
    sensor = Sensor(
        array=array,
        call=call,
        recording=recording,
        electronics=electronics,
        emitter=Emitter(direct_sound_db=direct_db),
    )
    effects = {"microphone_noise": electronics.noise_dbfs is not None, "direct_sound": direct_db is not None}
    return Scene(seed=seed, sensors=(sensor,), effects=effects | {"microphone_spread": True}, **what)


def healthy(seed: int) -> tuple[str, Measurement]:
    """Return the kind of scene and the recording of a healthy array. The seed determines both."""
    rng = np.random.default_rng((seed, 1))
    name = list(SCENES)[seed % len(SCENES)]
    is_pdm = rng.random() < 0.7
    electronics = Electronics(
        noise_dbfs=None if is_pdm and rng.random() < 0.2 else float(rng.uniform(-70, -30 if is_pdm else -60)),
        modulator_order=int(rng.integers(2, 5)),
        gain_spread_db=float(rng.uniform(0, 1)),
        delay_spread_s=float(rng.uniform(0, 3e-6)),
    )
    array = _array(rng, int(rng.integers(1, 65)))
    call = _CALLS[int(rng.integers(len(_CALLS)))]
    encoding = "int16" if rng.random() < 0.5 else "float32"
    recording = _PDM if is_pdm else _PCM.replace(encoding=encoding)
    return name, Simulator(_scene(seed, array, recording, call, electronics, SCENES[name](rng))).render()


@functools.lru_cache(maxsize=128)
def base(scene: str, seed: int, *, is_pdm: bool) -> Base:
    """Return a healthy recording of a two-dimensional array of 32 microphones.

    The recording contains an echo or the direct sound.
    """
    rng = np.random.default_rng((seed, 2))
    names = ("eRTIS_v2", "eRTIS_v3D1")
    what: dict[str, Any] = {}
    if scene == "one echo":
        azimuth_deg, elevation_deg = rng.choice([-1, 1], 2) * rng.uniform((25, 20), (55, 40))
        point = _point(rng, -18.0).replace(azimuth_deg=float(azimuth_deg), elevation_deg=float(elevation_deg))
        what = {"points": (point,)}
    elif scene == "direct sound":
        what = {"points": (_point(rng, -45.0),), "direct_db": float(rng.uniform(-20, -10))}
    electronics = Electronics(
        noise_dbfs=float(rng.uniform(-70, -50)),
        gain_spread_db=float(rng.uniform(0, 0.5)),
        delay_spread_s=float(rng.uniform(0, 2e-6)),
    )
    recording = _PDM if is_pdm else _PCM
    array = Array(layout=names[int(rng.integers(len(names)))])
    simulator = Simulator(_scene(seed, array, recording, Call(), electronics, what))
    return Base(simulator.render(), simulator.signals(), simulator.sensor, simulator.scene)

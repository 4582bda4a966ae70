"""Signals of sensors on a platform among posts, smooth walls and boxes, rendered by sums of delayed calls.

This renderer shares no code with the simulator. Faces reflect sound in the plane of the sensors. Posts scatter it in
all directions. It spreads spherically, and the air absorbs it. Emitters are circular pistons in a baffle, or
omnidirectional. Samples are PCM.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

import ertis_numba as ertis
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Processing, Recording, Settings

__all__ = [
    "HEIGHT_M",
    "Face",
    "Mountings",
    "Room",
    "images_of",
    "mounted",
    "nearest_m",
    "random_room",
    "rendered",
    "settings_of",
    "toward",
    "wall",
]

Floats = NDArray[np.float64]
Spectrum = NDArray[np.complex128]
Mountings = Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float, float]]]

HEIGHT_M: Final = 0.4
RATE_HZ: Final = 200_000.0
N_SAMPLES: Final = 6400
_NOISE: Final = 2.5e-4
_LEVEL: Final = 10 ** (-24 / 20)
_N_FFT: Final = 12_288  # Long enough that sound after the recording does not wrap to its beginning.
_BAND_HZ: Final = 22e3, 55e3
_EDGE_DB: Final = -16.0  # Strength of the edges of boxes.
_POST_M: Final = 0.05  # Radius of posts in the truth.
_HALF_WALL_M: Final = 9.0
_ASIDE_M: Final = 1e-3  # Offset of a sensor's receiver, without which rounding errors decide how corners reflect.


class Face(NamedTuple):
    """Smooth reflecting face from one place to another: (2,) float64 each, and the amplitude of reflected sound."""

    start_m: Floats
    end_m: Floats
    reflection: float


class Room(NamedTuple):
    """Surroundings of a platform.

    Attributes
    ----------
    posts_m : (post, 2) float64
    strength_db : (post,) float64
        Level of the echo at 1 m relative to the incident sound.
    faces : tuple of Face
    edges_m : (edge, 2) float64
        Vertical edges, which scatter faintly.
    """

    posts_m: Floats
    strength_db: Floats
    faces: tuple[Face, ...] = ()
    edges_m: Floats = np.empty((0, 2))


class _Leg(NamedTuple):
    """Way of sound between two places: that of its source, mirrored by faces or not, and the factor of reflection.

    ``first_m`` is the place that the sound meets first, which determines what an emitter radiates.
    """

    from_m: Floats
    first_m: Floats
    factor: float


def settings_of(range_m: tuple[float, float] = (0.6, 4.0)) -> Settings:
    """Return the settings of a PCM sensor."""
    return Settings(
        recording=Recording(sample_rate_hz=RATE_HZ, n_samples=N_SAMPLES, encoding="float32"),
        processing=Processing(directions="90", range_m=range_m, range_decimation=4),
    )


def mounted(places: Mapping[str, tuple[float, float, float]]) -> Mountings:
    """Return mountings of sensors, from x and y in metres and the yaw in degrees."""
    return {
        name: ((x, y, HEIGHT_M), (0.0, 0.0, math.sin(math.radians(yaw) / 2), math.cos(math.radians(yaw) / 2)))
        for name, (x, y, yaw) in places.items()
    }


def toward(turn_rad: float) -> Floats:
    """Return the unit vector at an azimuth: (2,) float64."""
    return np.array([math.cos(turn_rad), math.sin(turn_rad)])


def wall(turn_rad: float, away_m: float, level_db: float) -> Face:
    """Return a wall of 18 m, from the azimuth and the distance of its middle, and the level of reflected sound."""
    middle_m, along_m = away_m * toward(turn_rad), _HALF_WALL_M * toward(turn_rad + math.pi / 2)
    return Face(middle_m + along_m, middle_m - along_m, 10 ** (level_db / 20))


def random_room(seed: int, kind: str) -> Room:
    """Return four to eight posts around a platform, with one or two walls, two boxes, or both."""
    random = np.random.default_rng([seed, 42])
    faces: list[Face] = []
    walls: list[tuple[float, float]] = []
    for _ in range(random.integers(1, 3) if kind in ("walls", "both") else 0):
        turn_rad, away_m = random.uniform(-np.pi, np.pi), random.uniform(1.4, 3.0)
        if all(abs(_turned(turn_rad - other)) > math.radians(50) for other, _ in walls):
            walls.append((turn_rad, away_m))
            faces.append(wall(turn_rad, away_m, random.uniform(-12, -3)))
    places: list[Floats] = []
    edges: list[Floats] = []

    def free(clear_m: float, apart_m: tuple[float, float], first_m: float) -> Floats:
        while True:
            place_m = random.uniform(first_m, 3.3) * toward(random.uniform(-np.pi, np.pi))
            is_inside = all(place_m @ toward(turn_rad) < away_m - clear_m for turn_rad, away_m in walls)
            n_boxes = len(edges) // 4
            if is_inside and all(
                np.linalg.norm(place_m - other) > apart_m[number < n_boxes] for number, other in enumerate(places)
            ):
                return place_m

    for _ in range(2 if kind in ("boxes", "both") else 0):
        centre_m = free(0.5, (0.9, 0.9), 1.2)
        places.append(centre_m)
        size_m, turn_rad = random.uniform(0.2, 0.6, 2) / 2, random.uniform(0, np.pi / 2)
        corners = [
            centre_m + a * size_m[0] * toward(turn_rad) + b * size_m[1] * toward(turn_rad + math.pi / 2)
            for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ]
        faces += [Face(corners[n], corners[(n + 1) % 4], 10 ** (-6 / 20)) for n in range(4)]
        edges += corners
    first = len(places)
    for _ in range(random.integers(4, 9)):
        place_m = free(0.25, (0.4, 0.75), 0.8)
        places.append(place_m)
    posts_m = np.array(places[first:])
    return Room(posts_m, random.uniform(-9, 0, len(posts_m)), tuple(faces), np.array(edges).reshape(-1, 2))


def nearest_m(room: Room, angle_rad: Floats, from_m: Floats | None = None) -> Floats:
    """Return the distance of the nearest surface along rays: (ray,) float64, infinite without one."""
    origin_m = np.zeros(2) if from_m is None else from_m
    ray = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
    found = np.full(len(ray), np.inf)
    for face in room.faces:
        along, start_m = face.end_m - face.start_m, face.start_m - origin_m
        across = ray[:, 0] * along[1] - ray[:, 1] * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            away_m = (start_m[0] * along[1] - start_m[1] * along[0]) / across
            part = (start_m[0] * ray[:, 1] - start_m[1] * ray[:, 0]) / across
        is_hit = (away_m > 0) & (part >= 0) & (part <= 1)
        found = np.where(is_hit & (away_m < found), away_m, found)
    for post_m in room.posts_m - origin_m:
        along_m, aside_m = ray @ post_m, np.abs(ray[:, 0] * post_m[1] - ray[:, 1] * post_m[0])
        range_m = float(np.linalg.norm(post_m))
        found = np.where((along_m > 0) & (aside_m <= _POST_M) & (range_m < found), range_m, found)
    return found


class _Air:
    """Spectra of sound in the band of the call: its emission by emitters, and its way through the air."""

    def __init__(self, settings: Settings, diameter_m: float) -> None:
        frequency_hz = np.fft.rfftfreq(_N_FFT, 1 / RATE_HZ)
        self.inside = (frequency_hz > _BAND_HZ[0]) & (frequency_hz < _BAND_HZ[1])
        inside_hz: Floats = frequency_hz[self.inside].astype(np.float64)
        self._wave_1_m = 2 * math.pi * inside_hz / sound_speed_m_s(settings.air)
        self._lost_1_m = math.log(10) / 20 * absorption_db_m(settings.air, inside_hz)
        self._call = _LEVEL * np.fft.rfft(call_at(settings.call, np.arange(_N_FFT) / RATE_HZ))[self.inside]
        self._diameter_m = diameter_m

    def radiated(self, sensor_m: Floats, ahead: Floats, leg: _Leg) -> Spectrum:
        """Return the spectrum that an emitter sends on a way; 0 behind the baffle of a piston."""
        way_m = leg.first_m - sensor_m
        cosine = float(way_m @ ahead) / max(1e-9, float(np.linalg.norm(way_m)))
        if not self._diameter_m:
            return self._call * leg.factor
        argument = self._wave_1_m * self._diameter_m / 2 * math.sqrt(max(1e-12, 1 - cosine**2))
        return np.asarray(self._call * leg.factor * (cosine > 0) * 2 * scipy.special.j1(argument) / argument)

    def arrived(self, sent: Spectrum, way_m: float) -> Spectrum:
        """Return sound at the end of its way."""
        return np.asarray(sent * np.exp(-(self._lost_1_m + 1j * self._wave_1_m) * way_m) / way_m)

    def heard(self, sources: Iterable[tuple[Floats, Spectrum]], mics_m: Floats) -> NDArray[np.float32]:
        """Return signals of microphones: (sample, mic) float32, from places and spectra of sound."""
        spectrum = np.zeros((_N_FFT // 2 + 1, len(mics_m)), np.complex64)
        for from_m, sent in sources:
            way_m = np.linalg.norm(mics_m - [*from_m, HEIGHT_M], axis=1)
            turn = (self._wave_1_m[:, None] * way_m).astype(np.float32)
            spread = sent * np.exp(-self._lost_1_m * way_m.mean())
            spectrum[self.inside] += (spread[:, None] / way_m).astype(np.complex64) * (np.cos(turn) - 1j * np.sin(turn))
        return np.fft.irfft(spectrum, _N_FFT, axis=0)[:N_SAMPLES].astype(np.float32)


def rendered(
    mountings: Mountings,
    settings: Settings,
    room: Room,
    *,
    diameter_m: float,
    random: np.random.Generator,
    noise: float = _NOISE,
    dead: str = "",
    reflections: int = 2,
) -> dict[str, NDArray[np.float32]]:
    """Return the signals of all sensors, by name: (sample, mic) float32. The emitter of a dead sensor is silent.

    At most so many faces in turn reflect sound from sensor to sensor. One may reflect it on its way to a post or an
    edge, and one on its way back.
    """
    air = _Air(settings, diameter_m)
    scatterers_m = np.concatenate([room.posts_m, room.edges_m])
    strength = 10 ** (np.append(room.strength_db, np.full(len(room.edges_m), _EDGE_DB)) / 20)
    placed = {
        name: (np.array(place_m[:2]), toward(2 * math.atan2(turn[2], turn[3])))
        for name, (place_m, turn) in mountings.items()
    }
    emitting = [sensor for name, sensor in placed.items() if name != dead]
    lit = [
        sum(
            air.arrived(air.radiated(*sensor, leg), float(np.linalg.norm(leg.from_m - scatterer_m)))
            for sensor in emitting
            for leg in _ways(room, sensor[0], scatterer_m, 1)
        )
        for scatterer_m in scatterers_m
    ]
    mics_m = np.asarray(microphones(settings.array).positions_m, np.float64)
    found = {}
    for name, sensor in placed.items():
        sensor_m, ahead = sensor
        left = np.array([-ahead[1], ahead[0]])
        heard_m = np.column_stack([sensor_m + mics_m[:, :1] * ahead + mics_m[:, 1:2] * left, HEIGHT_M + mics_m[:, 2]])
        sources: list[tuple[Floats, Spectrum]] = [
            (leg.from_m, factor * leg.factor * spectrum)
            for scatterer_m, factor, spectrum in zip(scatterers_m, strength, lit, strict=True)
            for leg in _ways(room, scatterer_m, sensor_m, 1)
            if not isinstance(spectrum, int)
        ]
        for other in emitting:
            with_direct = other is not sensor and not diameter_m
            at_m = sensor_m + _ASIDE_M * left if other is sensor else sensor_m
            sources += [
                (leg.from_m, air.radiated(*other, leg))
                for leg in _ways(room, other[0], at_m, reflections)
                if with_direct or leg.from_m is not other[0]
            ]
        signal = air.heard(sources, heard_m)
        found[name] = signal + noise * random.standard_normal(signal.shape).astype(np.float32)
    return found


def images_of(
    signals: Mapping[str, NDArray[np.float32]], settings: Settings, number: int = 0
) -> dict[str, ertis.Energyscape]:
    """Return the images of all sensors, by name."""
    found = {}
    with ertis.Pipeline(settings, predict=False) as pipeline:
        for name, signal in signals.items():
            stamp = ertis.Stamp(
                sensor=name, sequence=number, sync_count=number, timestamp_ns=10**18 + 100_000_000 * number
            )
            found[name] = pipeline.process(ertis.Measurement(signal, settings, stamp))
    return found


def _ways(room: Room, from_m: Floats, to_m: Floats, most: int, over: tuple[Face, ...] = ()) -> Iterator[_Leg]:
    """Yield the ways of sound between two places over given faces in turn, and over further ones, at most so many."""
    images_m, met_m = [from_m], [to_m]
    for face in over:
        images_m.append(_mirrored(face, images_m[-1]))
    for face, image_m in zip(over[::-1], images_m[-2::-1], strict=False):
        place_m = _met(face, image_m, met_m[-1])
        if place_m is None:
            break
        met_m.append(place_m)
    else:
        if not any(_is_blocked(room, *way) for way in itertools.pairwise([from_m, *met_m[::-1]])):
            yield _Leg(images_m[-1], met_m[-1], math.prod((face.reflection for face in over), start=1.0))
    for face in room.faces if len(over) < most else ():
        if not over or face is not over[-1]:
            yield from _ways(room, from_m, to_m, most, (*over, face))


def _mirrored(face: Face, place_m: Floats) -> Floats:
    along = (face.end_m - face.start_m) / np.linalg.norm(face.end_m - face.start_m)
    offset_m = place_m - face.start_m
    return np.asarray(face.start_m + 2 * (offset_m @ along) * along - offset_m)


def _met(face: Face, from_m: Floats, to_m: Floats) -> Floats | None:
    """Return the place at which a face reflects sound from one place to another, None if it does not."""
    along = face.end_m - face.start_m
    normal = np.array([along[1], -along[0]])
    from_depth, to_depth = normal @ (from_m - face.start_m), normal @ (to_m - face.start_m)
    if from_depth * to_depth <= 0:
        return None
    part = abs(from_depth) / (abs(from_depth) + abs(to_depth))
    image_m = _mirrored(face, to_m)
    met_m = from_m + part * (image_m - from_m)
    share = (met_m - face.start_m) @ along / (along @ along)
    return np.asarray(met_m) if 0 <= share <= 1 else None


def _is_blocked(room: Room, from_m: Floats, to_m: Floats) -> bool:
    """Return True if a face lies between two places, apart from their own."""
    way = to_m - from_m
    for face in room.faces:
        along, start_m = face.end_m - face.start_m, face.start_m - from_m
        across = way[0] * along[1] - way[1] * along[0]
        if abs(across) < 1e-12:
            continue
        part = (start_m[0] * along[1] - start_m[1] * along[0]) / across
        share = (start_m[0] * way[1] - start_m[1] * way[0]) / across
        if 1e-6 < part < 1 - 1e-6 and 1e-6 < share < 1 - 1e-6:
            return True
    return False


def _turned(turn_rad: float) -> float:
    return (turn_rad + math.pi) % (2 * math.pi) - math.pi

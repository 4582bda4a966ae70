"""Matching of waves to reflectors and emitters, given approximate poses."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.constants import SYNC_STEP_S
from ertis_numba.calibration.pose_fit import WaveTable, predicted_waves
from ertis_numba.calibration.pose_links import WavesOfSensor, echo_points
from ertis_numba.calibration.wave_finder import Wave

__all__ = ["Gates", "Matched", "match_waves", "without_outliers"]

_MAX_REFLECTORS: Final = 8  # in one measurement
_MIN_WAVES: Final = 3
_MERGED_M: Final = 0.01  # Reflectors to try within this distance are one.
_AT_REST_M: Final = 0.03  # Reflectors of different measurements within this distance are one that did not move.
_NO_INFORMATION: Final = 1e-6


class Gates(NamedTuple):
    """Largest deviations of a wave from its expected path in metres, and of its direction cosines."""

    path_m: float
    cosine: float


class Matched(NamedTuple):
    """Waves whose origins are known."""

    waves: WaveTable
    reflectors_m: NDArray[np.float64]  # (reflector, axis), approximate
    pulse: tuple[tuple[int, int], ...]  # SYNC pulse of each reflector


class _Poses(NamedTuple):
    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]
    speed_m_s: float


class _Origin(NamedTuple):
    """Number of a wave in the measurement of a receiver, and its emitter."""

    receiver: int
    emitter: int
    number: int


class _Reflector(NamedTuple):
    score: float
    place_m: NDArray[np.float64]
    origins: tuple[_Origin, ...]
    pulse: tuple[int, int]


def match_waves(
    waves: Mapping[str, WavesOfSensor],
    rotation: NDArray[np.float64],
    translation_m: NDArray[np.float64],
    speed_m_s: float,
    gates: Gates,
) -> Matched:
    """Return the waves that reflectors and emitters explain; sensors are in the order of the SYNC chain."""
    # The reflector that explains most waves, as echoes of all emitters, is accepted first.
    poses = _Poses(rotation, translation_m, speed_m_s)
    sensors = list(waves.values())
    reflectors: list[_Reflector] = []
    direct: dict[tuple[int, int], tuple[float, Wave]] = {}
    for pulse in sorted(set().union(*(sensor.keys() for sensor in sensors))):
        heard = [sensor.get(pulse, ()) for sensor in sensors]
        used: set[tuple[int, int]] = set()
        reflectors += _reflectors(heard, used, poses, gates, pulse)
        _note_direct(heard, used, poses, gates, direct)
    kept = _without_repeats(reflectors)
    rows = [
        (origin.receiver, origin.emitter, number, sensors[origin.receiver][reflector.pulse][origin.number])
        for number, reflector in enumerate(kept)
        for origin in reflector.origins
    ]
    rows += [(receiver, emitter, -1, wave) for (receiver, emitter), (_, wave) in direct.items()]
    places_m = np.array([reflector.place_m for reflector in kept]).reshape(-1, 3)
    return Matched(_table(rows, speed_m_s), places_m, tuple(reflector.pulse for reflector in kept))


def without_outliers(
    matched: Matched, reflectors_m: NDArray[np.float64], residual_m: NDArray[np.float64], limit_m: float
) -> Matched:
    """Return the waves whose paths fit within limit_m, without reflectors that lose too many of theirs."""
    fits = np.abs(residual_m) < limit_m
    reflector = matched.waves.reflector
    counts = np.bincount(reflector[fits & (reflector >= 0)], minlength=len(reflectors_m))
    stays = counts >= _MIN_WAVES
    kept = fits & ((reflector < 0) | stays[reflector])
    numbers = np.append(np.cumsum(stays) - 1, -1)  # The last one is for direct calls, whose number is −1.
    pulse = tuple(each for each, stay in zip(matched.pulse, stays, strict=True) if stay)
    waves = WaveTable(
        receiver=matched.waves.receiver[kept],
        emitter=matched.waves.emitter[kept],
        reflector=numbers[reflector[kept]],
        parameters=matched.waves.parameters[kept],
        root=matched.waves.root[kept],
        sync_m=matched.waves.sync_m[kept],
    )
    return Matched(waves, reflectors_m[stays], pulse)


def _table(rows: Sequence[tuple[int, int, int, Wave]], speed_m_s: float) -> WaveTable:
    receiver, emitter, reflector = (np.array([row[place] for row in rows], dtype=np.intp) for place in range(3))
    return WaveTable(
        receiver,
        emitter,
        reflector,
        np.array([row[3].parameters for row in rows]).reshape(-1, 5),
        np.array([_root(row[3].information) for row in rows]).reshape(-1, 5, 5),
        _sync_m(receiver, emitter, speed_m_s),
    )


def _sync_m(receiver: NDArray[np.intp], emitter: NDArray[np.intp], speed_m_s: float) -> NDArray[np.float64]:
    """Return how far sound travels from the start of the record to the emission, which a pulse passes one by one."""
    return np.asarray((emitter - receiver) * (SYNC_STEP_S * speed_m_s), dtype=np.float64)


def _root(information: NDArray[np.float64]) -> NDArray[np.float64]:
    values, vectors = np.linalg.eigh(information)
    values = np.where(values < _NO_INFORMATION * values.max(), 0.0, values)
    return np.asarray(np.sqrt(values)[:, None] * vectors.T)


def _reflectors(
    heard: Sequence[Sequence[Wave]], used: set[tuple[int, int]], poses: _Poses, gates: Gates, pulse: tuple[int, int]
) -> list[_Reflector]:
    """Return the reflectors of one measurement, and note the waves that they explain."""
    places_m = _places_to_try(heard, poses)
    found: list[_Reflector] = []
    while len(found) < _MAX_REFLECTORS and len(places_m):
        tried = [_explained(place, heard, used, poses, gates, pulse) for place in places_m]
        # A place that explains too little now explains even less later.
        usable = [
            number
            for number, each in enumerate(tried)
            if len(each.origins) >= _MIN_WAVES and len({origin.receiver for origin in each.origins}) > 1
        ]
        if not usable:
            break
        best = max((tried[number] for number in usable), key=lambda each: each.score)
        used |= {(origin.receiver, origin.number) for origin in best.origins}
        found.append(best)
        places_m = places_m[usable]
    return found


def _places_to_try(heard: Sequence[Sequence[Wave]], poses: _Poses) -> NDArray[np.float64]:
    found: list[NDArray[np.float64]] = []
    for sensor, waves in enumerate(heard):
        points_m = echo_points(waves)[0] @ poses.rotation[sensor].T + poses.translation_m[sensor]
        found += [point for point in points_m if all(np.abs(point - other).max() > _MERGED_M for other in found)]
    return np.array(found).reshape(-1, 3)


def _explained(
    place_m: NDArray[np.float64],
    heard: Sequence[Sequence[Wave]],
    used: set[tuple[int, int]],
    poses: _Poses,
    gates: Gates,
    pulse: tuple[int, int],
) -> _Reflector:
    """Return the waves that a reflector explains."""
    n_sensors = len(heard)
    origins, score = [], 0.0
    everyone = np.arange(n_sensors)
    for receiver, waves in enumerate(heard):
        free = [number for number in range(len(waves)) if (receiver, number) not in used]
        if not free:
            continue
        model = predicted_waves(
            np.broadcast_to(place_m, (n_sensors, 3)),
            np.broadcast_to(poses.rotation[receiver], (n_sensors, 3, 3)),
            np.broadcast_to(poses.translation_m[receiver], (n_sensors, 3)),
            poses.translation_m,
        )
        model[:, 0] += _sync_m(np.full(n_sensors, receiver), everyone, poses.speed_m_s)
        misfit = _misfits([waves[number] for number in free], model, gates)
        for place, emitter in _assigned(misfit):
            origins.append(_Origin(receiver, emitter, free[place]))
            score += 1 - misfit[place, emitter]
    return _Reflector(score, place_m, tuple(origins), pulse)


def _misfits(waves: Sequence[Wave], model: NDArray[np.float64], gates: Gates) -> NDArray[np.float64]:
    """Return squared deviations relative to the gates: (wave, model) float64; 1 or more is outside."""
    measured = np.array([wave.parameters for wave in waves])
    observed = np.array([[float(wave.information[axis, axis] > 1) for axis in (1, 2, 3)] for wave in waves])
    path = (measured[:, None, 0] - model[:, 0]) / gates.path_m
    cosines = np.abs(measured[:, None, 1:4] - model[:, 1:4]) * observed[:, None] / gates.cosine
    return np.asarray(np.maximum(np.abs(path), cosines.max(axis=2)) ** 2)


def _assigned(misfit: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return pairs of wave and emitter, the best first; each wave and each emitter occurs once."""
    rows, columns = np.nonzero(misfit < 1)
    order = np.argsort(misfit[rows, columns])
    pairs: list[tuple[int, int]] = []
    taken: tuple[set[int], set[int]] = (set(), set())
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if row not in taken[0] and column not in taken[1]:
            pairs.append((row, column))
            taken[0].add(row)
            taken[1].add(column)
    return pairs


def _note_direct(
    heard: Sequence[Sequence[Wave]],
    used: set[tuple[int, int]],
    poses: _Poses,
    gates: Gates,
    direct: dict[tuple[int, int], tuple[float, Wave]],
) -> None:
    """Keep the call of each sensor to each other one from the measurement in which it is most precise."""
    for receiver, waves in enumerate(heard):
        free = [wave for number, wave in enumerate(waves) if (receiver, number) not in used]
        others = [number for number in range(len(heard)) if number != receiver]
        if not free:
            continue
        model = predicted_waves(
            poses.translation_m[others],
            np.broadcast_to(poses.rotation[receiver], (len(others), 3, 3)),
            np.broadcast_to(poses.translation_m[receiver], (len(others), 3)),
            poses.translation_m[others],
        )
        model[:, 0] += _sync_m(np.full(len(others), receiver), np.array(others), poses.speed_m_s)
        for place, column in _assigned(_misfits(free, model, gates)):
            pair = receiver, others[column]
            precision = float(free[place].information[0, 0])
            if pair not in direct or precision > direct[pair][0]:
                direct[pair] = precision, free[place]


def _without_repeats(reflectors: Sequence[_Reflector]) -> list[_Reflector]:
    """Return one reflector of those at the same place in different measurements, that which explains most waves."""
    kept: list[_Reflector] = []
    for each in sorted(reflectors, key=lambda reflector: -len(reflector.origins)):
        if all(np.linalg.norm(each.place_m - other.place_m) > _AT_REST_M for other in kept):
            kept.append(each)
    return sorted(kept, key=lambda reflector: reflector.pulse)

"""Shift and stretch of calls and of other sound due to motion."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.snapshot import Receivers, Snapshot, Transmitters

__all__ = ["emission", "estimate", "times"]

Floats = NDArray[np.float64]
_ROUNDS = 60  # of moving walls; each reduces the error by the factor v / c, so that few are needed
_ENOUGH_S = 1e-16
_STEP_S = 1e-5


def times(
    shot: Snapshot, paths: Paths, sent_s: float, times: tuple[Floats, Floats | None]
) -> tuple[Floats, Floats | None]:
    """Return delays and stretches due to motion, instead of those at rest: both (path, mic) float64."""
    return _moved(paths, shot.speed_m_s, sent_s)


def emission(shot: Snapshot, paths: Paths, received_s: Floats) -> Floats:
    """Return the times at which sound that arrives at ``received_s`` (mic, time) left its source: (path, mic, time)."""
    # It left u earlier, the positive root of `(c² - v²) u² - 2 (d·v) u - d² = 0` for the source's velocity v and
    # distance d. A moving wall is met after the same fraction of the path as without motion. `paths` have no targets.
    source, receiver, speed_m_s = paths.transmitter, paths.receiver, shot.speed_m_s
    # A wall moves the image from t - u until the time of reflection, so only a part of its velocity counts in v.
    done = paths.transmitter_corners_m / np.mean(paths.second_m, axis=1)
    source_m_s = (source.velocity_m_s - np.sum(done[..., None] * source.sways_m_s, axis=0))[:, None]
    apart_m = receiver.positions_m - source.position_m[:, None]
    apart_m_s = _mics_m_s(receiver) - source.velocity_m_s[:, None]
    # d grows linearly with time, so that its products are polynomials.
    along = _dot(apart_m, source_m_s) + _dot(apart_m_s, source_m_s) * received_s
    square = _dot(apart_m, apart_m) + (2 * _dot(apart_m, apart_m_s) + _dot(apart_m_s, apart_m_s) * received_s) * (
        received_s
    )
    rest = speed_m_s**2 - _dot(source_m_s, source_m_s)
    return np.asarray(received_s - (along + np.sqrt(along**2 + rest * square)) / rest)


def _dot(one: Floats, other: Floats) -> Floats:
    """Return the products of vectors, with an axis for times: (path, mic, 1) float64."""
    return np.asarray(np.sum(one * other, axis=-1)[..., None])


def _moved(paths: Paths, speed_m_s: float, sent_s: float = 0.0) -> tuple[Floats, Floats]:
    """Return the arrival time of sound that leaves at ``sent_s``, and its stretch: both (path, mic)."""
    # Sound meets the target at t₁ with `c (t₁ - t₀) = |p + v t₁ - s(t₀)|`, and then the microphone, which moves at `v +
    # ω × r`, at t₂. The stretch is dt₂/dt₀ (P. M. Morse, K. U. Ingard, Theoretical Acoustics, 1968, chapter 11).
    earlier_s, arrival_s, later_s = (
        _arrival_s(paths, sent_s + step_s, speed_m_s) for step_s in (-_STEP_S, 0.0, _STEP_S)
    )
    return arrival_s, (later_s - earlier_s) / (2 * _STEP_S)


def _arrival_s(paths: Paths, start_s: float, speed_m_s: float) -> Floats:
    """Return the arrival time of sound emitted at a given time: (path, mic) float64."""
    transmitter, receiver = paths.transmitter, paths.receiver
    sent_m = (transmitter.position_m + start_s * _own_m_s(transmitter))[:, None]
    first_m, leaving = _per_path(paths.first_m), _per_path(paths.leaving)
    target_m = transmitter.position_m[:, None] + first_m[..., None] * leaving
    mics_m_s = _mics_m_s(receiver)
    met_s = start_s + first_m / speed_m_s
    arrival_s = met_s + paths.second_m / speed_m_s
    sways = bool(np.any(transmitter.sways_m_s)), bool(np.any(receiver.sways_m_s))
    for _ in range(_ROUNDS if any(sways) else 1):
        before_s, from_m, receiver_m = arrival_s, sent_m, receiver.positions_m
        if sways[0]:  # the sound meets a wall after the same fraction of the path as without motion
            done = (met_s if len(paths.targets) else arrival_s) - start_s
            whole_m = first_m if len(paths.targets) else paths.second_m
            from_m = sent_m + _swayed_m(transmitter, start_s + paths.transmitter_corners_m * _mean(done, whole_m))
        met_m, left_s = from_m, np.full((1, 1), start_s)
        if len(paths.targets):
            targets_m_s = paths.targets.velocities_m_s[:, None, :]
            met_s = left_s = _met_s(from_m, left_s, target_m, targets_m_s, speed_m_s)
            met_m = target_m + met_s[..., None] * targets_m_s
        if sways[1]:
            back = _mean(arrival_s - met_s, paths.second_m)
            receiver_m = receiver_m + _swayed_m(receiver, np.mean(arrival_s, axis=1) - paths.receiver_corners_m * back)
        arrival_s = _met_s(met_m, left_s, receiver_m, mics_m_s, speed_m_s)
        if np.abs(arrival_s - before_s).max() < _ENOUGH_S:
            break
    return arrival_s


def _met_s(from_m: Floats, left_s: Floats, place_m: Floats, velocity_m_s: Floats, speed_m_s: float) -> Floats:
    """Return the times (path, mic) at which sound meets objects at ``place_m`` at time 0, in uniform motion."""
    # With `d = p + v t₀ - a`, it takes the positive root u of `(c² - v²) u² - 2 (d·v) u - d² = 0`.
    apart_m = place_m + velocity_m_s * left_s[..., None] - from_m
    along = np.sum(apart_m * velocity_m_s, axis=-1)
    rest = speed_m_s**2 - np.sum(velocity_m_s**2, axis=-1)
    return np.asarray(left_s + (along + np.sqrt(along**2 + rest * np.sum(apart_m**2, axis=-1))) / rest)


def _per_path(values: Floats) -> Floats:
    """Return one value per path where all microphones share it: (path, 1 or mic, ...)."""
    return values[:, :1] if values.strides[1] == 0 else values


def _mics_m_s(receiver: Receivers) -> Floats:
    """Return the velocity of each microphone without the contribution of moving walls: (path, mic, axis) float64."""
    arms_m = receiver.positions_m - receiver.centre_m[:, None]
    return np.asarray(_own_m_s(receiver)[:, None] + np.cross(receiver.spin_rad_s[:, None], arms_m))


def _own_m_s(end: Transmitters | Receivers) -> Floats:
    """Return the velocity of each image without the contribution of moving walls: (path, axis) float64."""
    return np.asarray(end.velocity_m_s - np.sum(end.sways_m_s, axis=0))


def _swayed_m(end: Transmitters | Receivers, met_s: Floats) -> Floats:
    """Return the displacement of images by walls moving until the sound meets them, (wall, path): (path, 1, axis)."""
    return np.asarray(np.sum(met_s[..., None] * end.sways_m_s, axis=0)[:, None])


def _mean(time_s: Floats, length_m: Floats) -> Floats:
    """Return the mean travel time per length of each path: (path,) float64."""
    total_m = np.sum(length_m, axis=1)
    return np.asarray(np.divide(np.sum(time_s, axis=1), total_m, out=np.zeros_like(total_m), where=total_m > 0))


def estimate(sight: Sight) -> Estimate | None:
    """Compute the shift of pulses due to the motion of targets and sensors.

    A hyperbolic chirp stretched by s equals the chirp shifted by ``-(s - 1) p₀ / p'``. Here p₀ is its first period, and
    p' the growth of its periods with time. For a linear chirp this holds in the mean over its frequencies.
    """
    shot = sight.shot
    scene = shot.scene
    if not (len(sight.heard) and _echoes_move(scene)):
        return None
    shifts_s, turns_s, stretches, asides = [], [], [], []
    for number in sight.emitters(sight.active):
        call = scene.sensors[number].call
        rise = (1 / call.stop_frequency_hz - 1 / call.start_frequency_hz) / call.duration_s
        for paths in sight.paths(number, sight.active):
            delay_s, stretch = _moved(paths, shot.speed_m_s)
            late_s = delay_s - paths.length_m / shot.speed_m_s
            coupled_s = (stretch - 1) / call.start_frequency_hz / rise
            shifts_s.append(np.mean(late_s - coupled_s, axis=1))
            turns_s.append(np.mean(np.abs(late_s) + np.abs(coupled_s), axis=1))
            stretches.append(np.mean(stretch, axis=1))
            asides.append(_aside_rad(paths, shot.speed_m_s))
    shift_s, turn_s, stretch, aside_rad = (np.concatenate(parts) for parts in (shifts_s, turns_s, stretches, asides))
    own = sight.heard
    moved = replace(own, delay_s=own.delay_s + shift_s)
    _, ratio = sight.most_changed(
        own,
        moved,
        sight.surroundings(),
        sight.reach(own.delay_s),
        turn_s=turn_s,
        aside=sight.turn_change(own, aside_rad),
    )
    worst = int(np.argmax(np.abs(shift_s)))
    return Estimate(
        change_db=20 * math.log10(1 + ratio),
        sure=200.0,
        reason=f"{own.names[worst]}, {_reported_m_s(float(stretch[worst]), shot.speed_m_s)}, shifts by "
        f"{shift_s[worst] * shot.speed_m_s / 2 * 1000:.3g} mm",
    )


def _echoes_move(scene: Scene) -> bool:
    moving = [*scene.points, *scene.spheres, *scene.walls, *scene.boxes, *(sensor.path() for sensor in scene.sensors)]
    return any(thing.moves for thing in moving) or (scene.platform is not None and scene.platform.moves)


def _reported_m_s(stretch: float, speed_m_s: float) -> str:
    """Return the velocity of a reflector that causes a stretch of the call, as text."""
    away_m_s = speed_m_s * (stretch - 1) / (stretch + 1)
    return f"{'going' if away_m_s > 0 else 'coming'} at {abs(away_m_s):.3g} m/s"


def _aside_rad(paths: Paths, speed_m_s: float) -> NDArray[np.float64]:
    """Return the angle (path,) by which targets and turning microphones change directions until the sound arrives."""
    turned_rad = np.linalg.norm(paths.receiver.spin_rad_s, axis=-1) * paths.length_m[:, 0] / speed_m_s
    if not len(paths.targets):
        return np.asarray(turned_rad)
    way = paths.arriving[:, 0]
    across_m_s = paths.targets.velocities_m_s - paths.receiver.velocity_m_s
    across_m_s = across_m_s - np.sum(across_m_s * way, axis=-1, keepdims=True) * way
    moved_m = np.linalg.norm(across_m_s, axis=-1) * paths.first_m[:, 0] / speed_m_s
    away_m = paths.second_m[:, 0]
    return np.asarray(turned_rad + np.divide(moved_m, away_m, out=np.zeros_like(moved_m), where=away_m > 0))

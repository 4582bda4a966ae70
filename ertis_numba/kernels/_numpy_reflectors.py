"""Kernels of fusion that locate reflectors, in plain NumPy: see `ertis_numba.kernels._numpy_fusion`."""

import numpy as np

from ertis_numba.kernels._contract.arrays import Real
from ertis_numba.kernels._contract.reflectors import (
    AUDIBLE,
    DISTURBING,
    GRAZING,
    LAST_PATH_M,
    LEAST_COSINE,
    NEAREST_M,
    SHIFT,
    SIDE_LOBES,
    SPREAD,
    SPREADING_M,
    TILT,
    Doubles,
    HeardEchoes,
    Places,
    SeenPlaces,
    Truths,
    ViewingSensors,
)

__all__ = [
    "find_arrivals",
    "find_maxima",
    "locate_reflector",
    "match_echoes",
    "overlap_echoes",
    "see_places",
]


def locate_reflector(
    sensor_m: Doubles,
    ahead: Doubles,
    echoes: HeardEchoes,
    echo: Places,
    emitter: Places,
    added: Doubles,
    information: float,
    nearest_m: float,
    outlier: float,
    n_rounds: int,
    position_m: Doubles,
    out: Doubles,
) -> None:
    """Locate a reflector by the paths and directions of its echoes."""
    deviation, axes, receiver = echoes.deviation[echo], echoes.axes[echo, 1:], echoes.receiver[echo]
    if len(added):
        deviation = np.sqrt(deviation**2 + added)
    is_behind = np.einsum("ei,ei->e", position_m - sensor_m[receiver], ahead[receiver]) < 0
    beyond = np.where(is_behind[:, None], np.einsum("eti,ei->et", axes, ahead[receiver]), 0.0)
    axes = axes - 2 * beyond[..., None] * ahead[receiver, None]
    path_m = echoes.path_m[echo, emitter]
    for _ in range(n_rounds):
        away_m, back_m = position_m - sensor_m[emitter], position_m - sensor_m[receiver]
        from_m, to_m = (np.maximum(nearest_m, np.linalg.norm(each, axis=1))[:, None] for each in (away_m, back_m))
        along = (away_m / from_m + back_m / to_m) / deviation[:, :1]
        across = axes / (to_m * deviation[:, 1:])[:, None]
        slopes = np.concatenate([along, across.reshape(-1, 3)])
        late = (path_m[:, None] - from_m - to_m) / deviation[:, :1]
        residual = np.concatenate([late[:, 0], -np.einsum("eti,ei->et", across, back_m).ravel()])
        weighted = slopes / (1 + (residual / outlier) ** 2)[:, None]
        out[:] = np.linalg.inv(weighted.T @ slopes + information * np.eye(3))
        position_m += out @ weighted.T @ residual


def match_echoes(
    places: SeenPlaces,
    across: Doubles,
    reflectivity: Doubles,
    extra_m: float,
    is_flat: Truths,
    echoes: HeardEchoes,
    chosen: Places,
    gate: float,
    alike: float,
    found: Places,
    out: Doubles,
) -> int:
    """Find the echoes that reflectors at given places explain, by path, direction and power."""
    here, to_m = echoes.receiver[chosen], places.apart_m[:, echoes.receiver[chosen]]
    turned = np.maximum(0.0, 2 - 2 * np.einsum("pei,ei->pe", places.seen[:, here], echoes.axes[chosen, 0]))
    turned /= np.sum(across**2, axis=1)[:, None] / to_m**2 + echoes.gate_rad2[chosen]
    place, one = np.nonzero((turned < gate) & (is_flat[here] | (places.depth[:, here] >= 0)))
    turned, echo, here = turned[place, one, None], chosen[one], here[one]
    late_m = echoes.path_m[echo] - places.apart_m[place] - places.apart_m[place, here, None]
    slope_m = np.einsum("psi,pi->ps", places.toward, across)
    along_m = slope_m[place] + slope_m[place, here, None]
    distance = turned + late_m**2 / (along_m**2 + echoes.gate_m2[echo, None] + places.beside_m[place] ** 2 + extra_m**2)
    expected, power = reflectivity[place, None] * places.gain[place, here], echoes.power[echo, None]
    is_alike = (power < alike * expected) & ((places.depth[place, here, None] < 0) | (alike * power > expected))
    entry, emitter = np.nonzero((distance < gate) & is_alike)
    n_kept = min(len(entry), len(out))
    found[:, :n_kept] = np.stack([place[entry], echo[entry], emitter])[:, :n_kept]
    out[:n_kept] = distance[entry, emitter][:n_kept]
    return len(entry)


def find_maxima(amplitude: Real, is_near: Truths, column: Places, near: int, beside: int, out: Doubles) -> None:
    """Compute the highest amplitudes around bins of an image."""
    rows = (
        np.where(is_near[:, :, None], amplitude, 0).max(axis=1),
        np.broadcast_to(amplitude.max(axis=0), (len(column), amplitude.shape[1])),
    )
    for values, margin, each in zip(rows, (near, beside), out, strict=True):
        around = (column[..., None] + np.arange(-margin, margin + 1)).clip(0, amplitude.shape[1] - 1)
        each[:] = values[np.arange(len(column))[:, None, None], around].max(axis=2)


def find_arrivals(
    origin_m: Doubles,
    sent_m: Doubles,
    sensor_m: Doubles,
    ahead: Doubles,
    is_flat: Truths,
    receiver: Places,
    direction: Doubles,
    path_m: Doubles,
    within_m: float,
    within_rad: float,
    found: Places,
) -> int:
    """Find the echoes that fit sound from given places, by path and direction."""
    to_m = origin_m[:, :, None] - sensor_m
    apart_m = np.maximum(np.linalg.norm(to_m, axis=3), NEAREST_M)
    late_m = path_m.T - (apart_m[:, :, receiver] + sent_m[:, :, None])
    source, emitter, echo = np.nonzero(np.abs(late_m) < within_m)  # False for NaN.
    here = receiver[echo]
    toward = to_m[source, emitter, here] / apart_m[source, emitter, here, None]
    depth = np.einsum("mi,mi->m", toward, ahead[here])
    seen = toward - 2 * np.minimum(depth, 0.0)[:, None] * ahead[here]
    turn = np.linalg.norm(seen - direction[echo], axis=1)  # For small angles, the chord is the angle.
    is_near = (turn < within_rad / np.maximum(np.abs(depth), LEAST_COSINE)) & (is_flat[here] | (depth > 0))
    matches = np.flatnonzero(is_near)
    kept = matches[: found.shape[1]]
    found[:, : len(kept)] = source[kept], emitter[kept], echo[kept]
    return len(matches)


def see_places(place_m: Doubles, sensors: ViewingSensors, out: SeenPlaces) -> None:
    """Compute how the sensors of a platform see places."""
    away_m = place_m[:, None] - sensors.sensor_m
    apart_m = np.maximum(np.linalg.norm(away_m, axis=2), SPREADING_M)
    toward = away_m / apart_m[..., None]
    depth = np.einsum("psi,si->ps", toward, sensors.ahead)
    out.apart_m[:], out.toward[:], out.depth[:] = apart_m, toward, depth
    out.seen[:] = toward - 2 * np.where(sensors.is_flat, np.minimum(depth, 0.0), 0.0)[..., None] * sensors.ahead
    cosine = np.linspace(-1.0, 1.0, sensors.patterns.shape[2])
    path_m = np.linspace(0.0, LAST_PATH_M, sensors.lost.shape[1])
    powers = [
        np.stack([np.interp(each, cosine, pattern) for each, pattern in zip(depth.T, several, strict=True)], axis=1)
        for several in sensors.patterns
    ]
    out.gain[:] = 0.0
    for receiver, model in enumerate(sensors.model):
        if model >= 0:
            back_m = apart_m[:, receiver, None]
            spread = np.exp(np.interp(apart_m + back_m, path_m, sensors.lost[model])) / (apart_m * back_m) ** 2
            out.gain[:, receiver] = np.where(powers[model] > AUDIBLE, powers[model], 0.0) * spread
    out.radiated[:] = powers[0]
    for emitter, (each, beside_m) in enumerate(zip(depth.T, sensors.beside_m, strict=True)):
        out.beside_m[:, emitter] = np.interp(each, cosine, beside_m)


def overlap_echoes(
    path_m: Doubles,
    power: Doubles,
    direction: Doubles,
    receiver: Places,
    heard_m: Doubles,
    toward: Doubles,
    loudness: Doubles,
    is_other: Truths,
    ahead: Doubles,
    pulse_m: Doubles,
    beam: Doubles,
    out: Doubles,
) -> None:
    """Compute how much the echoes of reflectors disturb others."""
    facing, width_m, width = ahead[receiver], pulse_m[receiver, None, None], beam[receiver, None]
    late_m = np.abs(heard_m[:, None] - path_m.swapaxes(0, 1)[receiver])
    turned = toward[:, None] - direction.swapaxes(0, 1)[receiver]
    # A flat array observes directions in its plane, so its beam is wider to the side.
    along = np.einsum("eri,ei->er", turned, facing)
    across = np.sqrt(np.maximum(0.0, np.einsum("eri,eri->er", turned, turned) - along**2))
    near = (1 + (late_m / width_m) ** 2) ** -1.75 * np.exp(-((across / width) ** 2))[..., None]
    apart_m = np.maximum(0.0, late_m - SPREAD * width_m * (across / width)[..., None])
    aside = SIDE_LOBES * (1 + (apart_m / width_m) ** 2) ** -1.75 * (across > width)[..., None]
    strength = power.swapaxes(0, 1)[receiver] / loudness[:, None, None]
    ratio, side = (
        np.where(is_other & (each * strength > DISTURBING), np.minimum(each * strength, 1.0), 0.0)  # False for NaN.
        for each in (near, aside)
    )
    out[0], is_any = ratio.sum(axis=2), ratio + side > 0
    out[1] = np.where(is_any, (ratio + side) * np.minimum(SHIFT * late_m, width_m) ** 2, 0.0).sum(axis=2)
    facing_to = np.maximum(np.einsum("ei,ei->e", toward, facing), GRAZING)[:, None]
    angle_rad2 = out[0] * (SHIFT * np.minimum(across, width)) ** 2 + side.sum(axis=2) * (TILT * width) ** 2
    out[2] = angle_rad2 / facing_to**2

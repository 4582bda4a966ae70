"""Pairs of emitter and receiver: echoes of each cell, and cells that can cause each pixel."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import Receiver
from ertis_numba.fusion.rig import Emitters, MountedSensor

__all__ = ["Hypothesis", "Pair", "hypothesis", "pair_of"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Places = NDArray[np.uint32]

_LIT_DB: Final = (-16.0, -10.0)  # Radiated power below which a cell is not imaged, and above which it is fully.
_LIFT_DB: Final = -8.0  # Radiated power below which images are not amplified further, since side lobes would grow.
_BOUND_DB: Final = -6.0  # Radiated power above which a missing echo shows that a cell is empty.
_BOUND_COSINE: Final = math.cos(math.radians(60.0))
_CONFIRM_DB: Final = -13.0
_CONFIRM_COSINE: Final = math.cos(math.radians(80.0))
_APART_STEPS: Final = 6.0  # Difference of paths that separates two echoes, and a margin for errors of directions.
_NEAREST_M: Final = 0.05


class Pair(NamedTuple):
    """Echoes (entry,) of one emitter at one receiver, for the cells that both can see.

    ``first`` and ``second`` are pixels of two neighbouring directions in a flat image, ``share`` the weight of the
    second. ``gain`` is relative to a point reflector at 1 m ahead, ``lifted`` the same with the limited correction of
    the emitter's directivity. ``weight`` fades towards the limits of what the pair can see. ``bounds``: a missing echo
    shows that a cell is empty; ``confirms``: an echo confirms a reflector.
    """

    emitter: int
    receiver: int
    cell: Places
    step: Places
    first: Places
    second: Places
    share: Singles
    gain: Singles
    lifted: Singles
    weight: Singles
    bounds: NDArray[np.bool_]
    confirms: NDArray[np.bool_]


class Hypothesis(NamedTuple):
    """Cells in which a reflector would cause an echo in each pixel of a receiver.

    With ``is_mirrored``, reflectors are behind a flat array, which cannot distinguish them. ``begin`` (direction,) is
    the first half-step with a possible echo, ``bounds`` (direction + 1,) are those of entries, one for each half-step,
    with ``half_cell`` and ``half_gain``, 0 if none is possible. ``cell`` (pixel,) of the middle is -1 for none, with
    ``place_m`` and ``gain`` there.
    """

    emitter: int
    is_mirrored: bool
    begin: Places
    bounds: Places
    half_cell: Places
    half_gain: Singles
    cell: NDArray[np.int64]
    place_m: Singles
    gain: Singles


def pair_of(
    positions_m: Floats,
    sensors: tuple[MountedSensor, ...],
    emitters: Emitters,
    receiver: Receiver,
    *,
    emitter: int,
    number: int,
    late_m: float,
    deaf: NDArray[np.bool_],
) -> Pair:
    """Return the echoes of one emitter at one receiver, ``number``, with direct sound at the steps ``deaf``.

    ``late_m`` is the path of sound between the emission of the receiver and that of the emitter, negative if it is
    earlier.
    """
    sent, heard = sensors[emitter].local_m(positions_m), sensors[number].local_m(positions_m)
    from_m, to_m = np.linalg.norm(sent, axis=1), np.linalg.norm(heard, axis=1)
    radiated = emitters.power(sent[:, 0] / np.maximum(from_m, _NEAREST_M), emitter)
    cosine = heard[:, 0] / np.maximum(to_m, _NEAREST_M)
    step = np.floor((from_m + to_m + late_m) / 2 / receiver.step_m).astype(np.int64)
    beam = receiver.beam(heard)
    lit = ((10 * np.log10(radiated) - _LIT_DB[0]) / (_LIT_DB[1] - _LIT_DB[0])).clip(0, 1)
    weight = lit * cosine
    audible = receiver.has_range & ~deaf
    seen = (
        beam.inside
        & (step >= 0)
        & (step < receiver.n_steps)
        & (weight > 0)
        & (to_m > _NEAREST_M)
        & (from_m > _NEAREST_M)
    )
    seen &= audible[step.clip(0, receiver.n_steps - 1)]
    cell = np.flatnonzero(seen)
    # An echo at the range of the receiver's own echo cannot be distinguished from it, and confirms nothing.
    is_apart = (emitter == number) | (np.abs(from_m - to_m)[cell] > _APART_STEPS * receiver.step_m)
    spreading = emitters.spreading(from_m, to_m)
    radiated, cosine, step = radiated[cell], cosine[cell], step[cell]
    return Pair(
        emitter,
        number,
        cell.astype(np.uint32),
        step.astype(np.uint32),
        (beam.first[cell] * receiver.n_steps + step).astype(np.uint32),
        (beam.second[cell] * receiver.n_steps + step).astype(np.uint32),
        beam.share[cell],
        (radiated * spreading[cell]).astype(np.float32),
        (np.maximum(radiated, 10 ** (_LIFT_DB / 10)) * spreading[cell]).astype(np.float32),
        weight[cell].astype(np.float32),
        (radiated > 10 ** (_BOUND_DB / 10)) & (cosine > _BOUND_COSINE),
        (radiated > 10 ** (_CONFIRM_DB / 10)) & (cosine > _CONFIRM_COSINE) & is_apart,
    )


def hypothesis(
    grid: PolarGrid,
    sensors: tuple[MountedSensor, ...],
    emitters: Emitters,
    receiver: Receiver,
    *,
    emitter: int,
    late_m: float,
    is_mirrored: bool,
) -> Hypothesis:
    """Return the cells whose reflectors, behind if ``is_mirrored``, cause echoes of an emitter in a receiver's pixels.

    A pixel covers paths of one step. Where emitter and receiver face each other, its begin, middle and end lead to
    cells far apart, so there are entries for all half-steps.
    Sound of path L that arrives from the direction u has met a reflector at ``s u``, where ``s + |s u − d| = L`` and d
    is the emitter, as seen from the receiver. Hence ``s = (L² − |d|²) / (2 (L − u·d))``.
    """
    mounting = receiver.mounting
    toward = receiver.directions * np.array([-1.0 if is_mirrored else 1.0, 1.0, 1.0])
    directions = toward @ mounting.rotation.T
    offset_m = sensors[emitter].translation_m - mounting.translation_m
    apart_m = float(np.linalg.norm(offset_m))
    path_m = np.arange(2 * receiver.n_steps + 1) * receiver.step_m - late_m
    beyond = path_m**2 - apart_m**2
    to_m = beyond / np.maximum(2 * (path_m - (directions @ offset_m)[:, None]), 1e-6)
    place_m = mounting.translation_m + to_m[..., None] * directions[:, None]
    sent_m = (place_m - sensors[emitter].translation_m) @ sensors[emitter].rotation
    from_m = np.linalg.norm(sent_m, axis=-1)
    radiated = emitters.power(sent_m[..., 0] / np.maximum(from_m, _NEAREST_M), emitter)
    cell = np.where((beyond > 0) & (to_m > _NEAREST_M), grid.cell_of(place_m), -1)
    is_audible = (cell >= 0) & (radiated > kernels.AUDIBLE)
    gain = np.where(is_audible, radiated * emitters.spreading(from_m, to_m), 0.0).astype(np.float32)
    begin, end = is_audible.argmax(axis=1), gain.shape[1] - is_audible[:, ::-1].argmax(axis=1)
    count = np.where(is_audible.any(axis=1), end - begin, 0)
    half = np.arange(gain.shape[1])
    chosen = (half >= begin[:, None]) & (half < (begin + count)[:, None])
    return Hypothesis(
        emitter,
        is_mirrored,
        begin.astype(np.uint32),
        np.concatenate([[0], np.cumsum(count)]).astype(np.uint32),
        cell[chosen].clip(0).astype(np.uint32),
        gain[chosen],
        cell[:, 1::2].reshape(-1),
        place_m[:, 1::2].reshape(-1, 3).astype(np.float32),
        gain[:, 1::2].reshape(-1),
    )

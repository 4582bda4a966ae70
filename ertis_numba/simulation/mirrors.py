"""Mirror images in walls, and occlusion by walls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.bounds import require_few_mirrors
from ertis_numba.simulation.snapshot import Mirror, ReceiverPose, TransmitterPose

__all__ = ["Seen", "Views", "blocked", "images", "reflected"]

Floats = NDArray[np.float64]
End = TypeVar("End", TransmitterPose, ReceiverPose)
_SKIN = 1e-9  # of a leg's length: a leg that only touches a wall does not cross it
# The path from a sensor over two walls back to itself meets exactly their common edge. With a small offset, one order
# of the two walls is valid in a corner of a room, and none at the corner of a box.
_NUDGE_M = np.array([1.1e-7, 1.7e-7, 2.3e-7])


_Chain = tuple[tuple[int, ...], tuple[Any, ...]]  # walls, and the end point with its images in them


@dataclass(frozen=True, slots=True, eq=False)
class Seen(Generic[End]):
    """One end of the paths to some places, direct or mirrored in walls.

    Attributes
    ----------
    end : TransmitterPose or ReceiverPose
        The end itself or its mirror image.
    exists : (place,) bool
        True if all mirror points lie on their walls.
    corners_m : (corner, place, axis) float64
        Corners of the paths from the end to the places, both included.
    mirrors : tuple of int
        The wall at each inner corner.
    """

    end: End
    exists: NDArray[np.bool_]
    corners_m: Floats
    mirrors: tuple[int, ...]

    def to_corners_m(self, places: NDArray[np.intp]) -> Floats:
        """Return the distances from the end to the mirror points along the paths: (wall, place) float64."""
        legs_m = np.sqrt(np.sum(np.diff(self.corners_m[:, places], axis=0) ** 2, axis=-1))
        return np.asarray(np.cumsum(legs_m, axis=0)[:-1])


Views = tuple[tuple[Seen[TransmitterPose], ...], tuple[Seen[ReceiverPose], ...], tuple[Seen[TransmitterPose], ...]]
"""Emitter and microphones as seen from the targets, and the emitter as seen from the microphones.

Each tuple starts with the end itself; its mirror images may follow."""


def images(end: End, places_m: Floats, mirrors: Sequence[Mirror], largest: int) -> list[Seen[End]]:
    """Return an end and its images of up to ``largest`` reflections that are visible from some place.

    The image of an image is ``p' = p - 2 ((p - q)·n) n`` (J. B. Allen, D. A. Berkley, Image method for efficiently
    simulating small-room acoustics, JASA 65, 1979). It is valid where every mirror point lies within its wall
    (J. Borish, Extension of the image model to arbitrary polyhedra, JASA 75, 1984).

    Parameters
    ----------
    end : TransmitterPose or ReceiverPose
    places_m : (place, axis) float64
    mirrors : sequence of Mirror
    largest : int
        Maximum number of reflections.

    Raises
    ------
    ArgumentError
        There are too many chains of walls.
    """
    n_places = len(places_m)
    require_few_mirrors(len(mirrors), largest, n_places)
    straight = np.stack([np.broadcast_to(_position(end), places_m.shape), places_m])
    found = [Seen(end, np.ones(n_places, dtype=np.bool_), straight, ())]
    chains: list[_Chain] = [((), (end,))]
    for _ in range(largest):
        chains = _longer(chains, mirrors)
        for walls, ends in chains:
            exists, corners_m = _corners(ends, [mirrors[number] for number in walls], places_m + _NUDGE_M)
            if exists.any():
                found.append(Seen(ends[-1], exists, corners_m, walls))
    return found


def reflected(end: End, mirror: Mirror) -> End:
    """Return the image of an end in one more wall."""
    normal: Floats = mirror.axes[0]
    sway_m_s = 2 * (mirror.velocity_m_s @ normal) * normal
    velocity_m_s = _turned(end.velocity_m_s, normal) + sway_m_s
    sways_m_s = (*(_turned(earlier, normal) for earlier in end.sways_m_s), sway_m_s)
    reflection = end.reflection * mirror.reflection
    # From an emitter the sound meets the walls in the order of the images; to a microphone, in the reverse order.
    if isinstance(end, TransmitterPose):
        return replace(
            end,
            position_m=_image(end.position_m, mirror),
            velocity_m_s=velocity_m_s,
            facing=_turned(end.facing, normal),
            sways_m_s=sways_m_s,
            walls=(*end.walls, mirror.name),
            reflection=reflection,
        )
    return replace(
        end,
        positions_m=_image(end.positions_m, mirror),
        centre_m=_image(end.centre_m, mirror),
        velocity_m_s=velocity_m_s,
        axes=_turned(end.axes, normal),
        sways_m_s=sways_m_s,
        walls=(mirror.name, *end.walls),
        reflection=reflection,
    )


def blocked(seen: Seen[End], mirrors: Sequence[Mirror]) -> NDArray[np.bool_]:
    """Return True for places whose path is blocked by a wall: (place,) bool.

    A leg is blocked by every wall that it crosses, except the walls at which it begins or ends.
    """
    stopped = np.zeros(seen.corners_m.shape[1], dtype=np.bool_)
    touched = (-1, *seen.mirrors, -1)
    for leg, (start_m, stop_m) in enumerate(zip(seen.corners_m[:-1], seen.corners_m[1:], strict=True)):
        for number, mirror in enumerate(mirrors):
            if number not in touched[leg : leg + 2]:
                share, point_m = _crossing(start_m, stop_m, mirror)
                stopped |= _crossed(share, point_m, mirror)
    return stopped


def _longer(chains: list[_Chain], mirrors: Sequence[Mirror]) -> list[_Chain]:
    """Return every chain extended by one more image, in each wall except its last."""
    return [
        ((*walls, number), (*ends, reflected(ends[-1], mirror)))
        for walls, ends in chains
        for number, mirror in enumerate(mirrors)
        if walls[-1:] != (number,)
    ]


def _corners(ends: Sequence[End], walls: Sequence[Mirror], places_m: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """Trace the sound back from the places over the walls to the end itself."""
    exists = np.ones(len(places_m), dtype=np.bool_)
    corners_m = [places_m]
    for image, mirror in zip(ends[:0:-1], walls[::-1], strict=True):
        share, point_m = _crossing(corners_m[-1], np.broadcast_to(_position(image), places_m.shape), mirror)
        exists &= _crossed(share, point_m, mirror)
        corners_m.append(point_m)
    corners_m.append(np.broadcast_to(_position(ends[0]), places_m.shape))
    return exists, np.stack(corners_m[::-1])


def _crossing(start_m: Floats, stop_m: Floats, mirror: Mirror) -> tuple[Floats, Floats]:
    """Return the crossings of lines with the plane of a wall: (place,) and (place, axis) float64.

    The first array holds the fraction of the line, −1 for lines parallel to the plane. The second holds the points.
    """
    before = (start_m - mirror.point_m) @ mirror.axes[0]
    after = (stop_m - mirror.point_m) @ mirror.axes[0]
    apart = before - after
    share = np.divide(before, apart, out=np.full_like(before, -1.0), where=apart != 0)
    return share, start_m + share[:, None] * (stop_m - start_m)


def _crossed(share: Floats, point_m: Floats, mirror: Mirror) -> NDArray[np.bool_]:
    """Return True for lines that cross the wall itself; the arguments are from `_crossing`: (place,) bool."""
    aside_m = np.abs((point_m - mirror.point_m) @ mirror.axes[1:].T)
    inside = np.all(aside_m <= mirror.half_size_m, axis=-1)
    return np.asarray(inside & (share > _SKIN) & (share < 1 - _SKIN))


def _position(end: TransmitterPose | ReceiverPose) -> Floats:
    return end.position_m if isinstance(end, TransmitterPose) else end.centre_m


def _image(points_m: Floats, mirror: Mirror) -> Floats:
    return np.asarray(mirror.point_m + _turned(points_m - mirror.point_m, mirror.axes[0]))


def _turned(vectors: Floats, normal: Floats) -> Floats:
    return np.asarray(vectors - 2 * (vectors @ normal)[..., None] * normal)

"""Mirror images in walls, and occlusion by walls."""

import operator
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.scene_size_limits import require_few_mirrors
from ertis_numba.simulation.snapshot import Mirrors, Receivers, Transmitters

__all__ = ["Seen", "Views", "blocked", "images"]

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
End = TypeVar("End", Transmitters, Receivers)
_SKIN = 1e-9  # of a leg's length: a leg that only touches a wall does not cross it
# The path from a sensor over two walls back to itself meets exactly their common edge. With a small offset, one order
# of the two walls is valid in a corner of a room, and none at the corner of a box.
_NUDGE_M = np.array([1.1e-7, 1.7e-7, 2.3e-7])
_AT_ONCE = 2**16  # chains × places that are traced at a time
_NO_WALL = -1


@dataclass(frozen=True, slots=True, eq=False)
class Seen(Generic[End]):
    """Ways from one end of sound paths to some places, direct or mirrored in walls.

    ``image`` and ``place`` (way,) are joined. ``mirrors`` (wall, way) are the walls from the end on, `_NO_WALL` beyond
    the last; ``corners_m`` (corner, way, axis) include both ends, and repeat the place beyond the last wall.
    """

    ends: End
    image: Indices
    place: Indices
    mirrors: Indices
    corners_m: Floats

    def __len__(self) -> int:
        return len(self.image)

    @property
    def n_mirrors(self) -> Indices:
        """Number of walls of each way: (way,) int."""
        return np.asarray(np.sum(self.mirrors != _NO_WALL, axis=0))

    @property
    def images(self) -> End:
        """The end or its mirror image, one per way."""
        return self.ends.chosen(self.image)

    def to_corners_m(self) -> Floats:
        """Return the distances from the end to the mirror points along the ways: (wall, way) float64."""
        legs_m = np.sqrt(np.sum(np.diff(self.corners_m, axis=0) ** 2, axis=-1))
        return np.asarray(np.cumsum(legs_m, axis=0)[:-1])

    def chosen(self, ways: Indices | NDArray[np.bool_]) -> Self:
        """Return a selection of ways, by index or by a mask."""
        return replace(
            self,
            image=self.image[ways],
            place=self.place[ways],
            mirrors=self.mirrors[:, ways],
            corners_m=self.corners_m[:, ways],
        )


Views = tuple[Seen[Transmitters], Seen[Receivers], Seen[Transmitters]]
"""Emitter and microphones as seen from the targets, and the emitter as seen from the microphones."""


def images(end: End, places_m: Floats, mirrors: Mirrors, largest: int) -> Seen[End]:
    """Return the ways to an end and to its images of up to ``largest`` reflections that are visible from some place."""
    # They are visible where every mirror point lies within its wall (J. B. Allen, D. A. Berkley, 1979; J. Borish,
    # 1984).
    n_places = len(places_m)
    require_few_mirrors(len(mirrors), largest, n_places)
    straight = np.stack([np.broadcast_to(end.centre_m, places_m.shape), places_m])
    ends, image, place = [end], [np.zeros(n_places, dtype=np.intp)], [np.arange(n_places)]
    walls, corners_m = [np.zeros((0, n_places), dtype=np.intp)], [straight]
    chains, tips_m = np.zeros((0, 1), dtype=np.intp), end.centre_m[None]
    n_images = 1
    for _ in range(largest if len(mirrors) else 0):
        chains, tips_m = _longer(chains, tips_m, mirrors)
        for part in _parts(chains.shape[1], n_places):
            chain, there, traced_m = _traced(chains[:, part], tips_m[:, part], mirrors, places_m + _NUDGE_M)
            visible, own = np.unique(chain, return_inverse=True)
            numbers = chains[:, part][:, visible]
            ends.append(_reflected(end, numbers, mirrors))
            image.append(n_images + own)
            place.append(there)
            walls.append(numbers[:, own])
            corners_m.append(traced_m)
            n_images += len(visible)
    depth = max(len(each) for each in walls)
    return Seen(
        ends=_joined(ends, depth),
        image=np.concatenate(image),
        place=np.concatenate(place),
        mirrors=np.concatenate([_deeper(each, depth, _NO_WALL) for each in walls], axis=1),
        corners_m=_repeated(corners_m, depth + 2),
    )


def blocked(seen: Seen[End], mirrors: Mirrors) -> NDArray[np.bool_]:
    """Return True for ways (way,) of which a leg crosses a wall, except the walls at which it begins or ends."""
    stopped = np.zeros(len(seen), dtype=np.bool_)
    touched = np.pad(seen.mirrors, ((1, 1), (0, 0)), constant_values=_NO_WALL)
    for leg, (start_m, stop_m) in enumerate(zip(seen.corners_m[:-1], seen.corners_m[1:], strict=True)):
        for number in range(len(mirrors)):
            share, point_m = _crossing(start_m, stop_m, mirrors, number)
            crossed = _crossed(share, point_m, mirrors, number)
            stopped |= crossed & np.all(touched[leg : leg + 2] != number, axis=0)
    return stopped


def _parts(n_chains: int, n_places: int) -> Iterator[slice]:
    step = max(1, _AT_ONCE // max(1, n_places))
    return (slice(first, first + step) for first in range(0, n_chains, step))


def _longer(chains: Indices, tips_m: Floats, mirrors: Mirrors) -> tuple[Indices, Floats]:
    """Extend chains (wall, chain) and their images (image, chain, axis) by one more wall, except their last."""
    number = np.tile(np.arange(len(mirrors)), chains.shape[1])
    chain = np.repeat(np.arange(chains.shape[1]), len(mirrors))
    if len(chains):
        new = chains[-1, chain] != number
        number, chain = number[new], chain[new]
    before_m = tips_m[:, chain]
    tip_m = _mirrored(before_m[-1], mirrors.points_m[number], mirrors.axes[number, 0])
    return np.concatenate([chains[:, chain], number[None]]), np.concatenate([before_m, tip_m[None]])


def _traced(chains: Indices, tips_m: Floats, mirrors: Mirrors, places_m: Floats) -> tuple[Indices, Indices, Floats]:
    """Trace the sound back from the places to the end: chain and place (way,), and corners (corner, way, axis)."""
    chain = np.repeat(np.arange(chains.shape[1]), len(places_m))
    place = np.tile(np.arange(len(places_m)), chains.shape[1])
    corners_m = places_m[place][None]
    for walls, images_m in zip(chains[::-1], tips_m[:0:-1], strict=True):
        number = walls[chain]
        share, point_m = _crossing(corners_m[0], images_m[chain], mirrors, number)
        hit = _crossed(share, point_m, mirrors, number)
        chain, place = chain[hit], place[hit]
        corners_m = np.concatenate([point_m[None, hit], corners_m[:, hit]])
    return chain, place, np.concatenate([tips_m[:1, chain], corners_m])


def _reflected(end: End, chains: Indices, mirrors: Mirrors) -> End:
    """Return the images of an end in chains of walls, (wall, image)."""
    ends = end.chosen(np.zeros(chains.shape[1], dtype=np.intp))
    for number in chains:
        ends = _reflected_once(ends, mirrors, number)
    return ends


def _reflected_once(ends: End, mirrors: Mirrors, number: Indices) -> End:
    """Return the image of each end in one more wall."""
    normal, points_m = mirrors.axes[number, 0], mirrors.points_m[number]
    sway_m_s = 2 * _along(mirrors.velocities_m_s[number], normal)[..., None] * normal
    velocity_m_s = _turned(ends.velocity_m_s, normal) + sway_m_s
    sways_m_s = np.concatenate([_turned(ends.sways_m_s, normal), sway_m_s[None]])
    reflection = ends.reflection * mirrors.reflection[number]
    names = [(mirrors.names[each],) for each in number]
    # From an emitter the sound meets the walls in the order of the images; to a microphone, in the reverse order.
    if isinstance(ends, Transmitters):
        return replace(
            ends,
            position_m=_mirrored(ends.position_m, points_m, normal),
            velocity_m_s=velocity_m_s,
            facing=_turned(ends.facing, normal),
            sways_m_s=sways_m_s,
            walls=tuple(map(operator.add, ends.walls, names)),
            reflection=reflection,
        )
    return replace(
        ends,
        positions_m=_mirrored(ends.positions_m, points_m[:, None], normal[:, None]),
        centre_m=_mirrored(ends.centre_m, points_m, normal),
        velocity_m_s=velocity_m_s,
        spin_rad_s=-_turned(ends.spin_rad_s, normal),  # a mirror image turns the other way about its normal
        axes=_turned(ends.axes, normal[:, None]),
        sways_m_s=sways_m_s,
        walls=tuple(map(operator.add, names, ends.walls)),
        reflection=reflection,
    )


def _joined(ends: list[End], depth: int) -> End:
    """Return all images as one structure, with ``depth`` walls."""
    first = ends[0]
    names = set(first.__slots__) - {"walls", "sways_m_s"}
    return replace(
        first,
        walls=tuple(walls for each in ends for walls in each.walls),
        sways_m_s=np.concatenate([_deeper(each.sways_m_s, depth, 0.0) for each in ends], axis=1),
        **{name: np.concatenate([getattr(each, name) for each in ends]) for name in names},
    )


def _deeper(values: NDArray[Any], depth: int, filler: float) -> NDArray[Any]:
    """Return an array whose first axis is extended to ``depth``."""
    more = np.full((depth - len(values), *values.shape[1:]), filler, dtype=values.dtype)
    return np.concatenate([values, more])


def _repeated(corners_m: list[Floats], n_corners: int) -> Floats:
    """Return all corners as one array, with the last of each repeated: (corner, way, axis) float64."""
    extended = [np.pad(each, ((0, n_corners - len(each)), (0, 0), (0, 0)), mode="edge") for each in corners_m]
    return np.concatenate(extended, axis=1)


def _crossing(start_m: Floats, stop_m: Floats, mirrors: Mirrors, number: Indices | int) -> tuple[Floats, Floats]:
    """Return crossings of lines with walls' planes: fraction of a line (way,), −1 if parallel; point (way, axis)."""
    points_m, normal = mirrors.points_m[number], mirrors.axes[number, 0]
    before = _along(start_m - points_m, normal)
    apart = before - _along(stop_m - points_m, normal)
    share = np.divide(before, apart, out=np.full_like(before, -1.0), where=apart != 0)
    return share, start_m + share[:, None] * (stop_m - start_m)


def _crossed(share: Floats, point_m: Floats, mirrors: Mirrors, number: Indices | int) -> NDArray[np.bool_]:
    """Return True for lines that cross the wall itself; the arguments are those and the results of `_crossing`."""
    from_m, half_sizes_m = point_m - mirrors.points_m[number], mirrors.half_sizes_m[number]
    inside = [np.abs(_along(from_m, mirrors.axes[number, side])) <= half_sizes_m[..., side - 1] for side in (1, 2)]
    return np.asarray(inside[0] & inside[1] & (share > _SKIN) & (share < 1 - _SKIN))


def _mirrored(places_m: Floats, points_m: Floats, normal: Floats) -> Floats:
    return np.asarray(points_m + _turned(places_m - points_m, normal))


def _turned(vectors: Floats, normal: Floats) -> Floats:
    return np.asarray(vectors - 2 * _along(vectors, normal)[..., None] * normal)


def _along(vectors: Floats, normal: Floats) -> Floats:
    return np.asarray(np.einsum("...x,...x->...", vectors, normal))

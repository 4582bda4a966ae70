"""Sound paths: from an emitter, directly or over a target, to every microphone."""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.mirrors import Seen
from ertis_numba.simulation.scene_size_limits import require_few_paths
from ertis_numba.simulation.snapshot import Receivers, Targets, Transmitters

__all__ = ["Paths", "by_targets", "pairs", "turning", "unit", "without_target"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths between emitters and sets of microphones, or between their mirror images, one image of both per path.

    - ``targets``: one per path, or none: paths without targets are direct, counted as the second leg.
    - ``first_m``, ``second_m`` (path, mic): lengths of the legs before and after the target.
    - ``leaving``, ``arriving`` (path, mic, axis): unit vectors of the sound along the legs, between the mirror images.
    - ``transmitter_corners_m``, ``receiver_corners_m`` (wall, path): distances of mirror points along the path.
    - ``surface``: True if legs end on the surface of spheres, not at the centres.
    """

    transmitter: Transmitters
    receiver: Receivers
    targets: Targets
    first_m: Floats
    second_m: Floats
    leaving: Floats
    arriving: Floats
    transmitter_corners_m: Floats
    receiver_corners_m: Floats
    surface: bool = False

    def __len__(self) -> int:
        return len(self.first_m)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """The target of each path, and the walls before and after it."""
        targets: list[tuple[str, ...]] = [(name,) for name in self.targets.names] or [()] * len(self)
        ways = zip(self.transmitter.walls, targets, self.receiver.walls, strict=True)
        return tuple(" > ".join((*before, *name, *after)) or "direct sound" for before, name, after in ways)

    @property
    def length_m(self) -> Floats:
        """Total length of each path: (path, mic) float64."""
        return self.first_m + self.second_m

    @property
    def reflection(self) -> Floats:
        """Amplitude reflection factor of all walls of each path: (path,) float64."""
        return self.transmitter.reflection * self.receiver.reflection


def pairs(
    firsts: Seen[Transmitters], seconds: Seen[Receivers], largest: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the ways (path,) to and from each place that form a path of up to ``largest`` walls."""
    rank = seconds.place * (largest + 1) + seconds.n_mirrors
    sorted_ways = np.argsort(rank, kind="stable")
    rank = rank[sorted_ways]
    base = firsts.place * (largest + 1)
    start, stop = np.searchsorted(rank, base), np.searchsorted(rank, base + largest - firsts.n_mirrors, "right")
    counts = stop - start
    n_paths = int(counts.sum())
    require_few_paths(n_paths)
    one = np.repeat(np.arange(len(firsts)), counts)
    other = sorted_ways[np.arange(n_paths) + np.repeat(start - (np.cumsum(counts) - counts), counts)]
    order = np.lexsort((firsts.place[one], seconds.image[other], firsts.image[one]))
    return one[order], other[order]


def by_targets(first: Seen[Transmitters], second: Seen[Receivers], targets: Targets) -> Paths:
    """Return the paths over some targets, at least one; both arguments have one way per path to the same target."""
    return turning(first, second, targets, targets.positions_m[first.place, None, :], surface=False)


def turning(
    first: Seen[Transmitters], second: Seen[Receivers], targets: Targets, turns_m: Floats, *, surface: bool
) -> Paths:
    """Return the paths of `by_targets` that turn at the places ``turns_m``, (path, mic, axis)."""
    transmitter, receiver = first.images, second.images
    there_m = turns_m - transmitter.position_m[:, None]
    back_m = receiver.positions_m - turns_m
    shape = back_m.shape[:2]
    return Paths(
        transmitter=transmitter,
        receiver=receiver,
        targets=targets.chosen(first.place),
        first_m=np.broadcast_to(_length(there_m), shape),
        second_m=_length(back_m),
        leaving=np.broadcast_to(unit(there_m), back_m.shape),
        arriving=unit(back_m),
        transmitter_corners_m=first.to_corners_m(),
        receiver_corners_m=second.to_corners_m(),
        surface=surface,
    )


def without_target(
    transmitter: Transmitters, receiver: Receivers, targets: Targets, corners_m: Floats | None = None
) -> Paths:
    """Return direct paths from an emitter or its images, with mirror points at ``corners_m`` (wall, path) from it."""
    n_paths = len(transmitter.position_m)
    none = np.zeros((0, n_paths))
    way_m = receiver.positions_m - transmitter.position_m[:, None]
    return Paths(
        transmitter=transmitter,
        receiver=receiver.chosen(np.zeros(n_paths, dtype=np.intp)),
        targets=targets.chosen(np.arange(0)),
        first_m=np.zeros(way_m.shape[:2]),
        second_m=_length(way_m),
        leaving=unit(way_m),
        arriving=unit(way_m),
        transmitter_corners_m=none if corners_m is None else corners_m,
        receiver_corners_m=none,
    )


def unit(vectors: Floats) -> Floats:
    """Return vectors scaled to length 1; vectors of length 0 are unchanged."""
    length = _length(vectors)[..., None]
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0))


def _length(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt(np.sum(vectors**2, axis=-1)))

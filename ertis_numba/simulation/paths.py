"""Sound paths: from an emitter, directly or over a target, to every microphone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.mirrors import Seen
from ertis_numba.simulation.snapshot import ReceiverPose, Targets, TransmitterPose

__all__ = ["Paths", "by_targets", "turning", "unit", "without_target"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """Paths between one emitter and one set of microphones, or between their mirror images.

    Attributes
    ----------
    transmitter : TransmitterPose
    receiver : ReceiverPose
    targets : Targets
        One per path. Without targets there is one direct path, counted as the second leg.
    first_m, second_m : (path, mic) float64
        Lengths of the legs before and after the target.
    leaving, arriving : (path, mic, axis) float64
        Unit vectors along the first and the last leg, in the direction of the sound, between the mirror images.
    transmitter_corners_m, receiver_corners_m : (wall, path) float64
        Distances of the mirror points from either end, along the path.
    surface : bool
        True if legs end on the surface of spheres; False, the default, if they end at the centres.
    """

    transmitter: TransmitterPose
    receiver: ReceiverPose
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

    @property
    def names(self) -> tuple[str, ...]:
        """The target of each path, and the walls before and after it."""
        before, after = self.transmitter.walls, self.receiver.walls
        return tuple(" > ".join((*before, name, *after)) for name in self.targets.names) or (
            " > ".join((*before, *after)) or "direct sound",
        )

    @property
    def length_m(self) -> Floats:
        """Total length of each path: (path, mic) float64."""
        return self.first_m + self.second_m

    @property
    def reflection(self) -> float:
        """Amplitude reflection factor of all walls of the paths."""
        return self.transmitter.reflection * self.receiver.reflection


def by_targets(
    first: Seen[TransmitterPose], second: Seen[ReceiverPose], targets: Targets, chosen: NDArray[np.intp]
) -> Paths:
    """Return the paths over some targets, at least one.

    Parameters
    ----------
    first, second : Seen
        Emitter and microphones, or their mirror images.
    targets : Targets
        All targets of the scene.
    chosen : (path,) int
        Indices of the targets to use.
    """
    return turning(first, second, targets, chosen, targets.positions_m[chosen, None, :], surface=False)


def turning(
    first: Seen[TransmitterPose],
    second: Seen[ReceiverPose],
    targets: Targets,
    chosen: NDArray[np.intp],
    turns_m: Floats,
    *,
    surface: bool,
) -> Paths:
    """Return the paths that turn at the places ``turns_m``, (path, mic, axis).

    The other arguments are those of `by_targets`.
    """
    transmitter, receiver = first.end, second.end
    there_m = turns_m - transmitter.position_m
    back_m = receiver.positions_m - turns_m
    shape = back_m.shape[:2]
    return Paths(
        transmitter=transmitter,
        receiver=receiver,
        targets=targets.chosen(chosen),
        first_m=np.broadcast_to(_length(there_m), shape),
        second_m=_length(back_m),
        leaving=np.broadcast_to(unit(there_m), back_m.shape),
        arriving=unit(back_m),
        transmitter_corners_m=first.to_corners_m(chosen),
        receiver_corners_m=second.to_corners_m(chosen),
        surface=surface,
    )


def without_target(
    transmitter: TransmitterPose, receiver: ReceiverPose, targets: Targets, corners_m: Floats | None = None
) -> Paths:
    """Return the direct path from an emitter or its mirror image to the microphones.

    Parameters
    ----------
    transmitter : TransmitterPose
    receiver : ReceiverPose
    targets : Targets
        All targets of the scene.
    corners_m : (wall, 1) float64, optional
        Distances of the mirror points from the emitter, along the path.
    """
    none = np.zeros((0, 1))
    way_m = (receiver.positions_m - transmitter.position_m)[None]
    return Paths(
        transmitter=transmitter,
        receiver=receiver,
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

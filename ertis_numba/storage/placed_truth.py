"""Ground truth of the sensors of one platform, in the frame of their fused images or of a map."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ertis_numba.analysis.compare import visible
from ertis_numba.analysis.compare_places import joined, positions_m
from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.frames import Energyscape, Reflector, Surfaces, Trajectory
from ertis_numba.simulation import Scene
from ertis_numba.simulation.surfaces import surfaces_of
from ertis_numba.storage.recording import Mounting
from ertis_numba.storage.truth import GroundTruth

__all__ = ["PlacedTruth", "surfaces_at"]

Floats = NDArray[np.float64]
_BETWEEN_WALLS: Final = " > "  # In names of paths over several surfaces.
_NS_PER_S: Final = 1e9
_DIFFERS_M: Final = 2e-3  # Difference of poses from those of the scene that is stated.
_DIFFERS_DEG: Final = 0.1


def surfaces_at(truth: GroundTruth, row: int, time_ns: int) -> Surfaces:
    """Return the scene's surfaces in the frame of a row of ground truth; SettingsError: the scene has other keys."""
    position_m, rotation_xyzw = truth.frames[row]
    surfaces = surfaces_of(_scene_of(truth.scene), time_ns / _NS_PER_S)
    return surfaces.seen_from(np.array(position_m), Rotation.from_quat(rotation_xyzw).as_matrix())


@functools.lru_cache(maxsize=2)
def _scene_of(text: str) -> Scene:
    """Return the scene of a ground truth, which all of its rows share."""
    return Scene.from_toml(text, find_line=False)


class PlacedTruth:
    """Ground truth of the sensors of one platform, which grows with each pulse."""

    # Reflectors are echoes of own calls over a single surface. `trajectory` has the poses in the frame of a map, to
    # which the scene is moved if they are not its own. `missing` is the reason why there is no ground truth.

    def __init__(
        self, readers: Sequence[Any], mountings: Mapping[str, Mounting], trajectory: Trajectory | None = None
    ) -> None:
        self._truths: dict[str, GroundTruth] = {reader.sensor: reader.truth for reader in readers if reader.truth}
        self._mountings, self._trajectory, self._is_map = mountings, trajectory, trajectory is not None
        self._scene, self.missing = _common_scene(readers)
        self.is_partial = bool(self.missing and self._truths)
        self._rows: list[list[Reflector]] = []  # Of each pulse, in the scene.
        self._true: list[list[tuple[Floats, Rotation]]] = []  # Poses of the sensors of each pulse in the scene, …
        self._given: list[list[tuple[Floats, Rotation]]] = []  # … and in the frame of the images or of the map.

    def add(self, images: Mapping[str, Energyscape], rows: Mapping[str, int]) -> None:
        """Add one pulse: images by sensor, and their indices in the files."""
        if self._scene is None:
            return
        place_m, turn = np.zeros(3), Rotation.identity()
        if self._trajectory is not None:
            pose = self._trajectory.at([min(image.stamp.timestamp_ns for image in images.values())])
            place_m, turn = pose.position_m[0], Rotation.from_quat(pose.rotation_xyzw[0])
        found: list[Reflector] = []
        true, given = [], []
        for name, image in images.items():
            reflectors = self._truths[name].reflectors[rows[name]]
            shown = [
                each
                for each, is_shown in zip(reflectors, visible(image, reflectors), strict=True)
                if is_shown and _BETWEEN_WALLS not in each.name
            ]
            moving = self._scene.pose_of(self._scene.sensor(name), image.stamp.timestamp_ns / _NS_PER_S)
            true.append((moving.position_m, Rotation.from_matrix(moving.rotation)))
            found += _moved(shown, *true[-1])
            mounted_m, mounted = self._mountings[name]
            given.append((place_m + turn.apply(mounted_m), turn * Rotation.from_quat(mounted)))
        self._rows.append(joined(found, math.inf))  # A wall is one reflector.
        self._true.append(true)
        self._given.append(given)

    def truth(self, height_m: tuple[float, float] | None = None) -> GroundTruth | None:
        """Return the ground truth of all pulses between heights in the platform's or the map's frame, if any."""
        if self._scene is None or not self._rows:
            return None
        first = next(iter(self._truths.values()))
        low_m, high_m = (-math.inf, math.inf) if height_m is None else height_m
        poses, rows = self._poses(), []
        for row, (place_m, turn) in zip(self._rows, poses, strict=True):
            back = turn.inv()
            found = _moved(row, -back.apply(place_m), back)
            heights_m = positions_m(found)[:, 2]
            rows.append(tuple(each for each, z in zip(found, heights_m, strict=True) if low_m <= z <= high_m))
        return GroundTruth(
            scene=first.scene,
            seed=first.seed,
            reflectors=tuple(rows),
            left_out=first.left_out,
            frames=tuple((tuple(place_m.tolist()), tuple(turn.as_quat().tolist())) for place_m, turn in poses),
        )

    def _poses(self) -> list[tuple[Floats, Rotation]]:
        """Return the pose of the frame of each pulse in the scene."""
        if not self._is_map:
            return [_aligned(*pair) for pair in zip(self._true, self._given, strict=True)]
        true, given = ([pose for poses in several for pose in poses] for several in (self._true, self._given))
        return [_aligned(true, given)] * len(self._rows)

    def note(self) -> str | None:
        """Return a note if mountings or poses are not those of the scene, else None."""
        if not self._true:
            return None
        poses = self._poses()
        apart_m = max(
            float(np.linalg.norm(place_m + turn.apply(there_m) - here_m))
            for (place_m, turn), true, given in zip(poses, self._true, self._given, strict=True)
            for (here_m, _), (there_m, _) in zip(true, given, strict=True)
        )
        moved_m = float(np.linalg.norm(poses[0][0])) if self._is_map else 0.0
        moved_deg = math.degrees(poses[0][1].magnitude()) if self._is_map else 0.0
        if max(moved_m, apart_m) < _DIFFERS_M and moved_deg < _DIFFERS_DEG:
            return None
        return (
            f"{'poses' if self._is_map else 'mountings'} are not those of the simulated scene. The ground truth is "
            f"moved to fit them, and sensors remain up to {100 * apart_m:.2g} cm away from their places in it"
        )


def _common_scene(readers: Sequence[Any]) -> tuple[Scene | None, str]:
    """Return the scene of all recordings, or None and the reason."""
    simulated = [reader for reader in readers if reader.truth is not None]
    if not simulated:
        return None, "no recording is simulated"
    for reader in readers:
        if reader.truth is None:
            return None, f"sensor {reader.sensor} of {reader.path} has none"
    scenes = []
    for reader in simulated:
        try:
            scenes.append(_scene_of(reader.truth.scene))
            scenes[-1].sensor(reader.sensor)
        except (SettingsError, ArgumentError) as error:
            return None, f"the scene of sensor {reader.sensor} of {reader.path} cannot be used ({error})"
    places = [
        (scene.platform, scene.rate_hz, *scene.things(), [(each.name, *each.quaternion()) for each in scene.sensors])
        for scene in scenes
    ]
    for reader, place in zip(simulated, places, strict=True):
        if place != places[0]:
            return None, f"sensors {simulated[0].sensor} and {reader.sensor} come from different scenes"
    return scenes[0], ""


def _moved(reflectors: Sequence[Reflector], place_m: Floats, turn: Rotation) -> list[Reflector]:
    """Return reflectors in another frame, from the pose of their own frame in it."""
    if not reflectors:
        return []
    found_m = place_m + turn.apply(positions_m(reflectors))
    velocity_m_s = turn.apply([each.velocity_m_s for each in reflectors]).tolist()
    return [
        Reflector(
            name=each.name,
            azimuth_deg=math.degrees(math.atan2(y, x)),
            elevation_deg=math.degrees(math.atan2(z, math.hypot(x, y))),
            range_m=math.hypot(x, y, z),
            level_db=each.level_db,
            velocity_m_s=(velocity[0], velocity[1], velocity[2]),
        )
        for each, (x, y, z), velocity in zip(reflectors, found_m.tolist(), velocity_m_s, strict=True)
    ]


def _aligned(
    true: Sequence[tuple[Floats, Rotation]], given: Sequence[tuple[Floats, Rotation]]
) -> tuple[Floats, Rotation]:
    """Return the pose of the given frame in the true one, from poses of the same objects in both."""
    turn = Rotation.concatenate([one * other.inv() for (_, one), (_, other) in zip(true, given, strict=True)]).mean()
    true_m, given_m = (np.mean([place_m for place_m, _ in poses], axis=0) for poses in (true, given))
    return true_m - turn.apply(given_m), turn

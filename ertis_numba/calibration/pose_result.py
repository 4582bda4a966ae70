"""Result of a calibration of poses."""

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["PoseCalibration", "SensorPose"]

_INTERVAL = 1.96  # half of a 95 % interval in standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class SensorPose:
    """Pose of a sensor relative to the reference sensor.

    The covariance (6, 6) is that of x, y and z in metres, and of a small rotation about the x, y and z axes of the
    sensor in radians; 0 for the reference.
    """

    translation_m: NDArray[np.float64]
    rotation_xyzw: NDArray[np.float64]  # unit quaternion, frame of the sensor to that of the reference
    covariance: NDArray[np.float64]
    residual_m: float  # root mean square of measured minus fitted paths of the waves that were heard
    n_reflectors: int  # in common with other sensors
    n_waves: int  # heard, including calls of other sensors

    @property
    def translation_interval_m(self) -> NDArray[np.float64]:
        """Half of the 95 % intervals of x, y and z, in metres: (axis,) float64."""
        return np.asarray(_INTERVAL * np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def rotation_interval_deg(self) -> NDArray[np.float64]:
        """Half of the 95 % intervals of rotations about the axes of the sensor, in degrees: (axis,) float64."""
        return np.asarray(np.degrees(_INTERVAL * np.sqrt(np.diag(self.covariance)[3:])))

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation matrix from the frame of the sensor to that of the reference: (3, 3) float64."""
        x, y, z, w = self.rotation_xyzw
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    @property
    def yaw_pitch_roll_deg(self) -> tuple[float, float, float]:
        """Rotation to the left, then nose up, then clockwise as seen from behind, in degrees."""
        matrix = self.rotation
        pitch = np.arcsin(np.clip(matrix[2, 0], -1, 1))
        if np.hypot(matrix[0, 0], matrix[1, 0]) < 1e-9:  # Straight up or down, only yaw and roll together are defined.
            yaw, roll = np.arctan2(-matrix[0, 1], matrix[1, 1]), 0.0
        else:
            yaw, roll = np.arctan2(matrix[1, 0], matrix[0, 0]), np.arctan2(matrix[2, 1], matrix[2, 2])
        return float(np.degrees(yaw)), float(np.degrees(pitch)), float(np.degrees(roll))

    @property
    def yaw_pitch_roll_interval_deg(self) -> NDArray[np.float64]:
        """Half of the 95 % intervals of yaw, pitch and roll, in degrees: (angle,) float64."""
        _, pitch, roll = np.radians(self.yaw_pitch_roll_deg)
        across = np.array([0.0, np.sin(roll), np.cos(roll)]) / max(float(np.cos(pitch)), 1e-6)
        slopes = np.array([across, [0.0, -np.cos(roll), np.sin(roll)], [1.0, 0.0, 0.0] - np.sin(pitch) * across])
        return np.asarray(np.degrees(_INTERVAL * np.sqrt(np.diag(slopes @ self.covariance[3:, 3:] @ slopes.T))))


@dataclass(frozen=True, slots=True, eq=False)
class PoseCalibration:
    """Poses of several sensors on one platform, as measured by the sensors."""

    reference: str  # sensor whose frame the poses refer to
    poses: dict[str, SensorPose]
    reflectors_m: NDArray[np.float64]  # (reflector, axis), heard by several sensors
    n_measurements: int  # SYNC pulses with measurements of more than one sensor
    unused: tuple[int, ...]  # SYNC pulses in which no new reflector was found
    not_observable: tuple[str, ...]  # quantities that the recordings cannot determine, with remedies

    @property
    def mounting(self) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Position and quaternion of each sensor, as `write_recording` accepts them."""
        return {name: (pose.translation_m, pose.rotation_xyzw) for name, pose in self.poses.items()}

    def to_toml(self) -> str:
        """Return the poses as the ``[[sensors]]`` of a scene, which ``ertis capture --mounting`` reads."""
        found = f"from {len(self.reflectors_m)} reflectors; ± is half of a 95 % interval."
        lines = [
            f"# Mountings of sensors relative to {self.reference}, by 'ertis sensors calibrate --poses',",
            f"# {found}",
        ]
        for name, pose in self.poses.items():
            angles = zip(("yaw", "pitch", "roll"), pose.yaw_pitch_roll_deg, strict=True)
            places = ", ".join(f"{value:.6f}" for value in pose.translation_m)
            moved = ", ".join(f"{1e3 * value:.2f}" for value in pose.translation_interval_m)
            turned = [f"{value:.3f}" for value in pose.yaw_pitch_roll_interval_deg]
            lines += ["", "[[sensors]]", f"name = {json.dumps(name)}", f"position_m = [{places}]  # ± {moved} mm"]
            lines += [
                f"{angle}_deg = {value:.5f}  # ± {interval}"
                for (angle, value), interval in zip(angles, turned, strict=True)
            ]
        return "\n".join(lines) + "\n"

"""Motion of a platform from the images of its sensors: velocity and odometry."""

from ertis_numba.motion.compensation import compensate_motion
from ertis_numba.motion.odometry import Odometry
from ertis_numba.motion.planar_pose import PlanarPose
from ertis_numba.motion.velocity import EgoVelocity, ego_velocity

__all__ = ["EgoVelocity", "Odometry", "PlanarPose", "compensate_motion", "ego_velocity"]

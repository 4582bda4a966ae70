"""Live participant of a ROS 2 system, on machines with and without ROS."""

from ertis_numba.ros.participant import Participant, interfaces
from ertis_numba.ros.publisher import RosPublisher

__all__ = ["Participant", "RosPublisher", "interfaces"]

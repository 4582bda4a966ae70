"""Live participant of a ROS 2 system, on machines with and without ROS."""

from ertis_numba.ros.participant import Participant, Topic, interfaces
from ertis_numba.ros.publisher import RosPublisher
from ertis_numba.ros.publishing_settings import PublishingSettings, WatchedSettings

__all__ = ["Participant", "PublishingSettings", "RosPublisher", "Topic", "WatchedSettings", "interfaces"]

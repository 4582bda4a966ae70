"""Store the poses of a ROS 2 robot in the recordings of a central node.

The node reads the odometry of the robot, and sends each pose to the central node, which stores it with the measurements
of the sensors on the robot. It needs rclpy, and no other part of ROS. The clocks of ROS and of the sensor nodes must
agree::

    ertis record -o RECORDINGS &
    ertis capture --port front --port left --to tcp://127.0.0.1:5601 &
    python examples/7_poses_from_ros.py /odom tcp://127.0.0.1:5601 front left
"""

import signal
import sys
import threading

import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ertis_numba.base.errors import ArgumentError, RefusedError
from ertis_numba.network.pose_publisher import PosePublisher

TURN_S = 0.1


class PoseForwarder(Node):
    """Node that sends odometry to a central node."""

    def __init__(self, topic: str, publisher: PosePublisher) -> None:
        super().__init__("ertis_pose_forwarder")
        self._publisher = publisher
        self.create_subscription(Odometry, topic, self._send, 50)

    def _send(self, odometry: Odometry) -> None:
        stamp, pose = odometry.header.stamp, odometry.pose.pose
        place, turn = pose.position, pose.orientation
        covariance = odometry.pose.covariance.reshape(6, 6)
        try:
            self._publisher.send(
                stamp.sec * 10**9 + stamp.nanosec,
                (place.x, place.y, place.z),
                (turn.x, turn.y, turn.z, turn.w),
                covariance if covariance.any() else None,  # ROS programs leave an unknown covariance at 0.
            )
        except (ArgumentError, RefusedError) as error:  # An invalid pose, such as a zero quaternion, is not sent.
            self.get_logger().error(str(error), throttle_duration_sec=1.0)


def main(topic: str, address: str, *sensors: str) -> None:
    """Forward poses until the program is interrupted."""
    # A KeyboardInterrupt could come while rclpy converts a message, and end as another error.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    try:
        with PosePublisher(address, sensors, source="odometry") as publisher:
            forwarder = PoseForwarder(topic, publisher)
            while not ended.is_set():
                rclpy.spin_once(forwarder, timeout_sec=TURN_S)
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])

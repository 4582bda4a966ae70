"""Drive a ROS 2 robot forwards, and stop it in front of a wall that the sonar sees.

The node reads the laser scan of a sensor, and publishes velocities. It stops if an echo within the width of the robot
is nearer than `STOP_M`, and if no scan has arrived for half a second. It needs rclpy, and no other part of ROS::

    ertis serve &
    ertis capture --port front --to tcp://127.0.0.1:5601 &
    ertis ros tcp://127.0.0.1:5602 --floor -60 &
    python examples/6_stop_in_ros.py /front/scan
"""

import math
import sys
import time

import rclpy
from geometry_msgs.msg import Twist
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

STOP_M = 0.8
SPEED_M_S = 0.5
HALF_WIDTH_M = 0.3
SILENCE_S = 0.5
PERIOD_S = 0.05


def distance_ahead_m(scan: LaserScan) -> float:
    """Return the distance ahead of the nearest echo within the width of the robot; infinity without one."""
    nearest_m = math.inf
    for number, range_m in enumerate(scan.ranges):
        angle = scan.angle_min + number * scan.angle_increment
        if math.isfinite(range_m) and abs(range_m * math.sin(angle)) < HALF_WIDTH_M:
            nearest_m = min(nearest_m, range_m * math.cos(angle))
    return nearest_m


class StopBeforeWalls(Node):
    """Node that publishes ``cmd_vel`` at a fixed rate."""

    def __init__(self, topic: str) -> None:
        super().__init__("stop_before_walls")
        self._distance_m, self._seen_s = 0.0, -math.inf
        self._velocity = self.create_publisher(Twist, "cmd_vel", 1)
        self.create_subscription(LaserScan, topic, self._see, 1)
        self.create_timer(PERIOD_S, self._drive)

    def _see(self, scan: LaserScan) -> None:
        self._distance_m, self._seen_s = distance_ahead_m(scan), time.monotonic()

    def _drive(self) -> None:
        message = Twist()
        if time.monotonic() - self._seen_s < SILENCE_S and self._distance_m > STOP_M:
            message.linear.x = SPEED_M_S
        self._velocity.publish(message)


def main(topic: str) -> None:
    """Drive until the program is interrupted."""
    rclpy.init()
    try:
        rclpy.spin(StopBeforeWalls(topic))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])

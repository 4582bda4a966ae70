"""Drive a ROS 2 robot forwards, and stop it in front of a wall that the sonar sees.

The node reads the laser scan of a sensor, and publishes velocities. It stops if an echo within the width of the robot
is nearer than `STOP_M`, and if no scan has arrived for half a second. It then waits for a farther echo: the sensor does
not see a wall that is nearer than its first range, so that a scan without echoes may mean that the wall is very near.
For the same reason, begin with the way ahead free. It needs rclpy, and no other part of ROS::

    ertis serve &
    ertis capture --port front --settings NEAR.toml --to tcp://127.0.0.1:5601 &   # range_m = [0.3, 5.0]
    ertis ros tcp://127.0.0.1:5602 --floor -60 &
    python examples/6_stop_in_ros.py /front/scan
"""

import math
import signal
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import Twist
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import LaserScan

STOP_M = 0.8
SPEED_M_S = 0.5
HALF_WIDTH_M = 0.3
SILENCE_S = 0.5
PERIOD_S = 0.05
ARRIVAL_S = 1.0


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
        distance_m = distance_ahead_m(scan)
        self._seen_s = time.monotonic()
        if math.isinf(distance_m) and 0 < self._distance_m <= STOP_M:
            return  # The wall has come too near to be seen.
        self._distance_m = distance_m if scan.range_min < STOP_M else 0.0

    def _drive(self) -> None:
        message = Twist()
        if time.monotonic() - self._seen_s < SILENCE_S and self._distance_m > STOP_M:
            message.linear.x = SPEED_M_S
        self._velocity.publish(message)

    def stop(self) -> None:
        """Publish a velocity of 0, and wait until it has arrived: robots keep the last velocity that they received."""
        self._velocity.publish(Twist())
        self._velocity.wait_for_all_acked(Duration(seconds=ARRIVAL_S))  # Messages under way would end with the node.


def main(topic: str) -> None:
    """Drive until the program is interrupted."""
    # By default, signals end rclpy before the robot can be stopped.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    # A KeyboardInterrupt could come while rclpy converts a message, and end as another error.
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    node = StopBeforeWalls(topic)
    try:
        while not ended.is_set():
            rclpy.spin_once(node)
    finally:
        node.stop()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Limit a vehicle's speed by the nearest obstacle in its way: go, slow or stop.

It stops at once, and goes on only when its way has been clear for some images, and by more than what stops it: an echo
that comes and goes does not make it jerk. No image from one of its sensors for half a second is a reason to stop, too,
and so is a clock that is half a second away from this machine's. What echoes more than 20 dB weaker than the strongest
reflector of an image is no point of its cloud: beside a wall, a thin pole is not seen::

    ertis serve &
    ertis capture --port front --to tcp://127.0.0.1:5601 &
    python examples/2_safety_stop.py tcp://127.0.0.1:5602 front
"""

import sys
import time

import numpy as np

import ertis_numba as ertis

STOP_M, SLOW_M = 0.8, 1.6
CLEARER = 1.25  # by which a band must be exceeded to leave it
CLEAR_IMAGES = 3
HALF_WIDTH_M = 0.4
SILENCE_S = 0.5
SPEEDS = ("stop", "slow", "go")


class Way:
    """State of the way ahead, from one sensor."""

    def __init__(self) -> None:
        self.speed = 0
        self._seen_s = -np.inf
        self._clear = 0

    def see(self, nearest_m: float, now_s: float) -> None:
        """Update the distance of the nearest obstacle in the way."""
        self._seen_s = now_s
        allowed = int(nearest_m > STOP_M) + int(nearest_m > SLOW_M)
        if allowed <= self.speed:
            self.speed, self._clear = allowed, 0
            return
        is_clear = nearest_m > CLEARER * (STOP_M, SLOW_M)[self.speed]
        self._clear = self._clear + 1 if is_clear else 0
        if self._clear >= CLEAR_IMAGES:
            self.speed, self._clear = self.speed + 1, 0

    def wait(self, now_s: float) -> None:
        """Stop if nothing was seen for too long."""
        if now_s - self._seen_s > SILENCE_S:
            self.speed, self._clear = 0, 0


def nearest_in_way_m(cloud: ertis.PointCloud) -> float:
    """Return how far ahead the nearest point between both sides of the vehicle is."""
    x, y, _ = cloud.position_m.T
    return float(np.min(x[(x > 0) & (np.abs(y) < HALF_WIDTH_M)], initial=np.inf))


def main(address: str, *sensors: str) -> None:
    """Print the speed whenever it changes."""
    ways, reported = {sensor: Way() for sensor in sensors}, ""
    with ertis.Subscriber(address, sensors=sensors, products=["points"]) as subscriber:
        while not subscriber.closed:
            cloud = subscriber.receive(timeout_s=0.1)
            # An image that took long to come, or comes from a clock that is ahead, says nothing about now.
            if cloud is not None and abs(time.time_ns() - cloud.stamp.timestamp_ns) < 1e9 * SILENCE_S:
                ways[cloud.stamp.sensor].see(nearest_in_way_m(cloud), time.monotonic())
            for way in ways.values():
                way.wait(time.monotonic())
            speed = SPEEDS[min(way.speed for way in ways.values())]
            if speed != reported:
                print(speed, flush=True)
                reported = speed


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("give the address of a central node and the sensors that look ahead")
    try:
        main(*sys.argv[1:])
    except KeyboardInterrupt:
        print("stop")

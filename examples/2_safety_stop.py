"""Print the allowed speed of a vehicle (go, slow or stop) from the nearest obstacle in its path.

The vehicle stops at once. It drives on only after several images with a clear path, and at a larger distance than the
one that stops it, so that a flickering echo does not make it jerk. It also stops if one of its sensors sends no image
for half a second, or if the sensor's clock differs from this machine's by half a second. After a near obstacle
disappears, it waits for a farther echo, because the sensor does not see obstacles nearer than its first range. This is
no proof: an obstacle that is too near may leave farther ones visible beside it. A point cloud omits echoes more than
20 dB below the strongest reflector of an image: a thin pole beside a wall is not detected::

    ertis serve &
    ertis capture --port front --settings NEAR.toml --to tcp://127.0.0.1:5601 &   # range_m = [0.3, 5.0]
    python examples/2_safety_stop.py tcp://127.0.0.1:5602 front
"""

import sys
import time

import numpy as np

import ertis_numba as ertis

STOP_M, SLOW_M = 0.8, 1.6
CLEARER = 1.25  # factor by which a distance limit must be exceeded to drive faster
CLEAR_IMAGES = 3
HALF_WIDTH_M = 0.4
SILENCE_S = 0.5
SPEEDS = ("stop", "slow", "go")


class Way:
    """Allowed speed according to one sensor."""

    def __init__(self) -> None:
        self.speed = 0
        self._seen_s = -np.inf
        self._clear = 0
        self._last_m = np.inf  # distance of the last obstacle that was seen

    def see(self, nearest_m: float, now_s: float) -> None:
        """Update the speed with the distance of the nearest obstacle."""
        self._seen_s = now_s
        if nearest_m < np.inf:
            self._last_m = nearest_m
        allowed = int(nearest_m > STOP_M) + int(nearest_m > SLOW_M)
        if allowed <= self.speed:
            self.speed, self._clear = allowed, 0
            return
        is_hidden = nearest_m == np.inf and self._last_m <= STOP_M  # perhaps nearer than the first range
        is_clear = nearest_m > CLEARER * (STOP_M, SLOW_M)[self.speed] and not is_hidden
        self._clear = self._clear + 1 if is_clear else 0
        if self._clear >= CLEAR_IMAGES:
            self.speed, self._clear = self.speed + 1, 0

    def wait(self, now_s: float) -> None:
        """Stop if no image has arrived for too long."""
        if now_s - self._seen_s > SILENCE_S:
            self.speed, self._clear = 0, 0


def nearest_in_way_m(cloud: ertis.PointCloud) -> float:
    """Return the distance ahead of the nearest point within the width of the vehicle; infinity without one."""
    x, y, _ = cloud.position_m.T
    return float(np.min(x[(x > 0) & (np.abs(y) < HALF_WIDTH_M)], initial=np.inf))


def main(address: str, *sensors: str) -> None:
    """Print the speed whenever it changes."""
    ways, reported = {sensor: Way() for sensor in sensors}, ""
    with ertis.Subscriber(address, sensors=sensors, products=["points"]) as subscriber:
        while not subscriber.closed:
            cloud = subscriber.receive(timeout_s=0.1)
            # Ignore late images and images from a clock that is ahead, because they do not show the present.
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
        sys.exit("pass the address of a central node and the names of the sensors that face ahead")
    try:
        main(*sys.argv[1:])
    except KeyboardInterrupt:
        print("stop")

"""Log the points of all sensors of a platform to one table, in the frame of the platform.

The table is a CSV file, or an NPZ file for NumPy. It appears complete when the log ends, after a given number of clouds
or with Ctrl-C::

    ertis serve &
    ertis capture --port front --port left --to tcp://127.0.0.1:5601 --mounting examples/platform.toml &
    python examples/4_log_points.py tcp://127.0.0.1:5602 points.csv 100
"""

import csv
import sys
from pathlib import Path

import numpy as np

import ertis_numba as ertis
from ertis_numba.base.atomic_files import atomic_write

COLUMNS = ("timestamp_ns", "sensor", "sequence", "x_m", "y_m", "z_m", "amplitude")


class Log:
    """Log of point clouds in memory, written at the end."""

    def __init__(self) -> None:
        self.clouds: list[ertis.PointCloud] = []

    def save(self, path: Path) -> None:
        """Write the table; the file appears only when it is complete."""
        with atomic_write(path, overwrite=True) as part:
            if path.suffix == ".npz":
                with part.open("wb") as file:
                    np.savez_compressed(file, **self._columns())
                return
            with part.open("w", newline="") as text:
                table = csv.writer(text)
                table.writerow(COLUMNS)
                table.writerows(zip(*(column.tolist() for column in self._columns().values()), strict=True))

    def _columns(self) -> dict[str, np.ndarray]:
        counts = [len(cloud) for cloud in self.clouds]
        stamps = [cloud.stamp for cloud in self.clouds]
        nothing = np.empty((0, 3), np.float32)
        position_m = np.concatenate([nothing, *(cloud.on_platform_m() for cloud in self.clouds)])
        amplitude = np.concatenate([nothing[:, 0], *(cloud.amplitude for cloud in self.clouds)])
        times_ns = np.repeat(np.array([stamp.timestamp_ns for stamp in stamps], np.int64), counts)
        sensors = np.repeat(np.array([stamp.sensor for stamp in stamps], np.str_), counts)
        sequences = np.repeat(np.array([stamp.sequence for stamp in stamps], np.int64), counts)
        return dict(zip(COLUMNS, (times_ns, sensors, sequences, *position_m.T, amplitude), strict=True))


def main(address: str, path: str, largest: str = "0") -> None:
    """Log clouds until their number reaches ``largest``, or until Ctrl-C; 0 means no limit."""
    log, n = Log(), int(largest)
    with ertis.Subscriber(address, products=["points"]) as subscriber:
        try:
            for cloud in subscriber:
                log.clouds.append(cloud)
                if len(log.clouds) == n:
                    break
        except KeyboardInterrupt:
            pass
        dropped = subscriber.counts.dropped
    log.save(Path(path))
    print(f"{path}: {sum(map(len, log.clouds))} points of {len(log.clouds)} clouds, {dropped} clouds dropped")


if __name__ == "__main__":
    if len(sys.argv) not in {3, 4}:
        sys.exit("pass the address of a central node, a file (.csv or .npz) and, optionally, a number of clouds")
    main(*sys.argv[1:])

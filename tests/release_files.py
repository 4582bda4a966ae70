"""Small files of a release for the tests of later ones: ``python -m tests.release_files tests/kept/X.Y.Z.tar.gz``.

The contents follow from the functions of this module, which later releases must not change. Files of HDF5 consist
mostly of empty chunks, so an archive is a tenth of their size.
"""

import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np

from ertis_numba import AcousticMap, Energyscape, Measurement, OccupancyMap, Settings, Stamp, Trajectory, write_map
from ertis_numba.journal import Journal, JournalEntry
from ertis_numba.settings import Array, Processing, Recording
from ertis_numba.simulation import Point, Scene
from ertis_numba.storage import RecordingWriter, write_acoustic_maps, write_energyscapes

SETTINGS = Settings(
    recording=Recording(n_samples=4096),
    processing=Processing(directions="2d:7", range_m=(0.05, 0.1), wavefront="plane"),
    array=Array(layout="line", positions_m=tuple((0.0, 0.004 * mic, 0.0) for mic in range(8)), word_bits=8),
)
START_NS = 1_700_000_000_123_456_789
AZIMUTH_RAD = np.radians([-45.0, 0.0, 45.0])
ELEVATION_RAD = np.radians([0.0, 10.0, 0.0])
RANGE_M = np.linspace(0.05, 0.1, 11)
BAND_HZ = np.array([[20_000.0, 30_000.0], [30_000.0, 50_000.0]])
LOG_ODDS = np.array([[-3.0, 0.0, 0.5], [2.0, -1.0, 4.0]])
GAP = ("left", 12, 14, "the disk was full", 5)
ROTATION_XYZW = (0.0, 0.0, 0.6, 0.8)


def stamp(sensor, index):
    """Return the stamp of a measurement."""
    return Stamp(
        sensor=sensor,
        sequence=10 + index,
        sync_count=200 + index,
        timestamp_ns=START_NS + 50_000_000 * index,
        timestamp_uncertainty_ns=400 + index,
        session_id=5,
        behaviour=("active", "passive")[index],
    )


def samples(index):
    """Return the PDM samples of a measurement: a counter with another step for each index."""
    return (np.arange(4096) * (2 * index + 3) % 251).astype(np.uint8)


def amplitude(index):
    """Return the amplitudes of an image, which float32 represents exactly: (direction, range)."""
    return (np.arange(33, dtype=np.float32).reshape(3, 11) + 1) / 64 * (index + 1)


def measurements(sensor):
    """Return two measurements of a sensor."""
    return [Measurement(samples(index), SETTINGS, stamp(sensor, index)) for index in range(2)]


def images():
    """Return two images of a sensor."""
    axes = (AZIMUTH_RAD, ELEVATION_RAD, RANGE_M)
    return [Energyscape(amplitude(index), *axes, SETTINGS, stamp("left", index)) for index in range(2)]


def poses():
    """Return a trajectory of two poses."""
    times_ns = START_NS + 50_000_000 * np.arange(2)
    positions_m = np.array([[0.5, 1.0, 2.0], [1.0, 1.0, 2.0]])
    return Trajectory(times_ns, positions_m, np.tile(ROTATION_XYZW, (2, 1)), source="odom")


def occupancy_map():
    """Return an occupancy map."""
    return OccupancyMap(LOG_ODDS, (-1.0, 2.0), 0.5, n_groups=7, time_ns=START_NS)


def acoustic_map():
    """Return an acoustic map of two bands."""
    power = (np.arange(6, dtype=np.float32).reshape(3, 2) + 1) / 64
    return AcousticMap(power, AZIMUTH_RAD, ELEVATION_RAD, BAND_HZ, SETTINGS, stamp("left", 0))


def scene():
    """Return a scene of one reflector."""
    return Scene(points=(Point(range_m=1.5, azimuth_deg=20.0),))


def write(folder):
    """Write all files to an empty folder."""
    mounting = {"left": ((0.1, 0.2, 0.3), ROTATION_XYZW)}
    for name, given in (("recording.h5", None), ("recording_with_poses.h5", poses())):
        with RecordingWriter(folder / name, mounting=mounting, poses=given) as writer:
            for measurement in measurements("left") if given else [*measurements("left"), *measurements("right")]:
                writer.write(measurement)
            writer.note_gap(*GAP)
    write_energyscapes(folder / "images.h5", images(), mounting=mounting)
    write_acoustic_maps(folder / "sound.h5", [acoustic_map()])
    write_map(folder / "map.h5", occupancy_map())
    with Journal.create(folder / "recording.h5.journal", target="recording.h5", source="test") as journal:
        journal.add_sensor("left", SETTINGS, firmware="1.2.3")
        journal.append([JournalEntry(each, monotonic_ns=1_000) for each in measurements("left")])
    (folder / "settings.toml").write_text(SETTINGS.to_toml(), "utf-8")
    (folder / "scene.toml").write_text(scene().to_toml(), "utf-8")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place, tarfile.open(sys.argv[1], "x:gz") as archive:
        write(Path(place))
        for each in sorted(Path(place).iterdir()):
            archive.add(each, each.name)

"""Point clouds in PLY, PCD and CSV, as readers without shared code see them."""

import csv
from pathlib import Path

import numpy as np
import plyfile
import pytest

import ertis_numba as ertis
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Stamp
from ertis_numba.geometry import Grid
from ertis_numba.interop import FORMATS, export
from tests.files import image, with_echoes

REFLECTORS = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
TURNED = ((1.0, 2.0, 3.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))  # a quarter turn to the left
FINDING = {"top": 40, "min_level_db": -60.0}


def images(sensor="eRTIS-7", count=2, **stamp):
    """Planar images of noise and a reflector, with large numbers in their stamps."""
    return [
        image(seed=seed + 1).replace(
            stamp=Stamp(
                sensor=sensor,
                **{
                    "sequence": 4_000_000_000 + seed,
                    "session_id": 2**62 + seed,
                    "sync_count": 2**40 + seed,
                    "timestamp_ns": 1_700_000_000_123_456_789 + seed,
                }
                | stamp,
            )
        )
        for seed in range(count)
    ]


def expected(given, **mounting):
    """Clouds that the point stage finds in the images."""
    return [
        PointExtractor(each.settings, Grid(each.azimuth_rad, each.elevation_rad), **FINDING)(each).replace(**mounting)
        for each in given
    ]


def read_ply(path):
    data = plyfile.PlyData.read(path)
    return data["vertex"].data, data.comments


def read_pcd(path):
    from pypcd4 import PointCloud as Pcd  # noqa: PLC0415 - it imports pandas, which few tests need

    cloud = Pcd.from_path(path)
    lines = path.read_bytes().partition(b"DATA")[0].decode().splitlines()
    return cloud.pc_data, [line.removeprefix("# ") for line in lines if line.startswith("#")]


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize(("kind", "read"), [("ply", read_ply), ("pcd", read_pcd)])
def test_clouds_come_back_bit_by_bit(tmp_path, kind, read, text):
    given = [with_echoes(each) for each in (*images("left"), *images("right", 1, sequence=7))]
    (path,) = export(
        tmp_path / f"a.{kind}", given, text=text, mounting=dict.fromkeys(("left", "right"), TURNED), **FINDING
    )
    points, comments = read(path)
    assert points.dtype.names == FORMATS[kind].fields
    assert {"frame base_link", "sensor 0 left", "sensor 1 right"} <= set(comments)
    clouds = expected(given, translation_m=TURNED[0], rotation_xyzw=TURNED[1])
    assert len(points) == sum(map(len, clouds)) > 60
    where = np.concatenate([cloud.on_platform_m() for cloud in clouds]).astype(points["x"].dtype)
    assert np.array_equal(np.column_stack([points[axis] for axis in "xyz"]), where)
    assert points["x"].dtype == (np.float64 if kind == "ply" else np.float32)
    assert np.array_equal(points["intensity"], np.concatenate([cloud.amplitude for cloud in clouds]))
    uncertainty_m = np.column_stack([points["uncertainty_range"], points["uncertainty_across"]])
    assert np.array_equal(uncertainty_m, np.concatenate([cloud.uncertainty_m for cloud in clouds]))
    assert np.ptp(uncertainty_m[:, 1]) > 0
    counts = [len(cloud) for cloud in clouds]
    assert np.array_equal(points["sensor"], np.repeat([0, 0, 1], counts))
    assert np.array_equal(points["sequence"], np.repeat([4_000_000_000, 4_000_000_001, 7], counts))
    times_ns = points["sec"].astype(np.int64) * 1_000_000_000 + points["nanosec"]
    assert np.array_equal(times_ns, np.repeat([each.stamp.timestamp_ns for each in given], counts))


def test_csv_points_come_back(tmp_path):
    given = images('left, and"right')  # which a recording would refuse
    (path,) = export(tmp_path / "a.csv", given, **FINDING)
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    assert tuple(head) == FORMATS["csv"].fields
    clouds = expected(given)
    columns = dict(zip(head, zip(*rows, strict=True), strict=True))
    assert set(columns["sensor"]) == {'left, and"right'}
    stamps = [cloud.stamp for cloud in clouds for _ in range(len(cloud))]
    for name in ("session_id", "sequence", "sync_count", "timestamp_ns"):
        assert [int(cell) for cell in columns[name]] == [getattr(stamp, name) for stamp in stamps]
    where = np.concatenate([cloud.position_m for cloud in clouds])
    uncertainty_m = np.concatenate([cloud.uncertainty_m for cloud in clouds])
    amplitude = np.concatenate([cloud.amplitude for cloud in clouds])
    wanted = np.column_stack([where, amplitude, uncertainty_m])
    names = ("x_m", "y_m", "z_m", "amplitude", "uncertainty_range_m", "uncertainty_across_m")
    assert np.array_equal(np.column_stack([np.array(columns[name], dtype=np.float32) for name in names]), wanted)


@pytest.mark.parametrize("timestamp_ns", [-1, 2_300_000_000_000_000_000])
def test_csv_stores_times_before_1970_and_after_2106(tmp_path, timestamp_ns):
    """CSV times are int64 nanoseconds; times of ROS are limited."""
    (path,) = export(tmp_path / "a.csv", images(count=1, timestamp_ns=timestamp_ns), top=1)
    with path.open(newline="") as file:
        assert [int(row["timestamp_ns"]) for row in csv.DictReader(file)] == [timestamp_ns]


def test_exported_cloud_has_the_nearest_reflector_in_place(tmp_path):
    """The test runs from the samples of a scene to a cloud that another program reads."""
    with ertis.open_recording(REFLECTORS) as recording:
        pipeline = ertis.Pipeline(recording.settings)
        export(tmp_path / "a.ply", [pipeline.process(recording[0])])
    points, _ = read_ply(tmp_path / "a.ply")
    first = points[0]
    range_m = float(np.hypot(first["x"], first["y"]))
    assert range_m == pytest.approx(1.15, abs=0.005)
    assert np.degrees(np.arctan2(first["y"], first["x"])) == pytest.approx(-38.0, abs=0.5)
    assert first["z"] == 0


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(("kind", "read"), [("ply", read_ply), ("pcd", read_pcd)])
def test_silence_gives_an_empty_cloud(tmp_path, kind, read, text):
    silent = image().replace(amplitude=np.zeros_like(image().amplitude))
    (path,) = export(tmp_path / f"a.{kind}", [silent], text=text)
    if kind == "pcd" and text:  # which that reader cannot read
        assert path.read_text().endswith("POINTS 0\nDATA ascii\n")
        return
    points, comments = read(path)
    assert len(points) == 0
    assert "frame sensor" in comments


def test_unknown_mounting_gives_points_in_the_sensor_frame(tmp_path):
    given = images("left", 1)
    export(tmp_path / "a.ply", given, **FINDING)
    points, comments = read_ply(tmp_path / "a.ply")
    assert "frame left" in comments
    assert np.array_equal(points["x"], expected(given)[0].position_m[:, 0])


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        ([], {}, "no energyscape is passed; pass at least one"),
        ([*images("left"), *images("right")], {}, "the mountings of sensors left, right on their platform are unknown"),
        (images(sequence=2**32), {}, "sequence of a measurement is 4294967296, above the limit of the format; use csv"),
        (images(timestamp_ns=-1), {}, "has the time -1 ns, outside 1970 to 2038; use npz or csv"),
        (images(timestamp_ns=2**62), {}, "outside 1970 to 2038"),
        (images("Grüße"), {}, "sensor name 'Grüße' cannot name a group in a file; use letters, digits and _"),
        (images("a\nelement face 9"), {}, r"sensor name 'a\\nelement face 9' cannot name a group in a file"),
        (images(), {"top": 0}, "top is 0; use a whole number of at least 1"),
        (images(), {"mounting": {"eRTIS-7": ((0, 0, 0), (0, 0, 0, 2))}}, "has length 2; use a unit quaternion"),
    ],
)
@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_point_export_refuses_invalid_input(tmp_path, kind, given, options, message):
    with pytest.raises(ArgumentError, match=message):
        export(tmp_path / f"a.{kind}", given, **options)
    assert list(tmp_path.iterdir()) == []

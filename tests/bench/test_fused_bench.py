"""Benchmarks of fusion and of live maps, with short measurements, fill their tables."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.network.sender import SETTINGS
from ertis_bench.network_trials import fused_receiver, live_fusion, live_maps
from ertis_bench.network_trials.fused_receiver import FusedReceiverJob
from ertis_bench.network_trials.map_viewer import MapViewerJob, n_wrong
from ertis_bench.platform_trials import (
    broken_emitters,
    clock_checks,
    differing_calls,
    emission_delays,
    fused_scans,
    wall_reflections,
)
from ertis_bench.platform_trials.reflecting_scenes import ReflectingScene
from ertis_bench.platform_trials.rendered_rooms import (
    Face,
    Room,
    images_of,
    mounted,
    nearest_m,
    rendered,
    settings_of,
    wall,
)
from ertis_cli.main import cli

from ertis_numba.frames import Measurement, PointCloud
from ertis_numba.fusion import Fuser
from ertis_numba.network.fused_subscriber import FusedArrival
from ertis_numba.passive import AcousticCamera
from tests.publishing import image

MARKER = "ertis bench network --only fusion"
AHEAD = (0.0, 0.0, 0.0, 1.0)
MOUNTINGS = {"front": ((0.2, 0.0, 0.0), AHEAD), "back": ((-0.2, 0.0, 0.0), AHEAD)}


def test_fused_bench_counts_and_checks_all_pulses(tmp_path, monkeypatch):
    for name, value in {"START_S": 0.5, "_N_MEASUREMENTS": 2, "_WARM_UP": 3}.items():
        monkeypatch.setattr(live_fusion, name, value)
    target = tmp_path / "page.md"
    target.write_text(f"<!-- {MARKER} -->\nold\n<!-- /{MARKER} -->\n", "utf-8")
    options = ["--duration", "2", "--json", "--quiet", "--folder", str(tmp_path), "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "network", "--only", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    (row,) = json.loads(done.stdout)["rows"]
    assert row["pulses"] == 20
    assert row["fused"] + row["skipped"] <= row["pulses"]
    assert 0 < row["checked"] <= row["fused"]
    assert row["wrong"] == 0
    assert row["published"] + sum(row["dropped"].values()) == 80
    text = target.read_text("utf-8")
    assert f"20 pulses sent, {row['fused']} fused, {row['skipped']} skipped" in text
    assert "words of noise" not in text


@pytest.mark.parametrize(("gain", "share", "wrong"), [(1.0, 1.0, 0), (1.0, 0.99, 1), (0.5, 1.0, 1)])
def test_fused_bench_finds_wrong_images(tmp_path, gain, share, wrong):
    images = {name: image(sensor=name, reflectors=[(20.0, 1.5, 0.1)]) for name in MOUNTINGS}
    fused = Fuser(MOUNTINGS, **fused_receiver.SPACINGS)(images.values())
    fused.image.amplitude[:] *= share
    expected = tmp_path / "expected.npz"
    np.savez(expected, **{name: gain * each.amplitude[None] for name, each in images.items()})
    job = FusedReceiverJob(address="", diary="", keys=("", ""), expected=str(expected), mountings=MOUNTINGS)
    found = fused_receiver.checked(job, [FusedArrival(fused, images, 0, 0, 0)])
    assert found == {"checked": 1, "wrong": wrong}


def test_calls_bench_compares_equal_and_different_calls(tmp_path, monkeypatch):
    monkeypatch.setattr(differing_calls, "EMITTERS_M", (0.0,))
    target = tmp_path / "page.md"
    marker = "ertis bench fusion --only calls"
    target.write_text(f"<!-- {marker} -->\nold\n<!-- /{marker} -->\n", "utf-8")
    options = ["--only", "calls", "--count", "1", "--seed", "1000", "--json", "--quiet", "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    report = json.loads(done.stdout)
    equal, different, pairs = report["calls"]
    assert (equal["n_images"], different["n_images"], pairs["n_images"]) == (4, 4, 16)
    assert equal["spurious"] <= different["spurious"]  # Unconfirmed points are not counted.
    assert all(0 < each["located"] <= each["reflectors"] == 10 for each in report["calls"])
    low_db, high_db = report["suppression_db"]
    assert 0 < low_db < high_db
    assert "| omnidirectional | different, an image for each pair | 16 |" in target.read_text("utf-8")


def test_clocks_bench_counts_false_warnings_and_found_faults(tmp_path, monkeypatch):
    monkeypatch.setattr(clock_checks, "EMITTERS_M", (0.0,))
    target = tmp_path / "page.md"
    marker = "ertis bench fusion --only clocks"
    target.write_text(f"<!-- {marker} -->\nold\n<!-- /{marker} -->\n", "utf-8")
    options = ["--only", "clocks", "--count", "2", "--seed", "5", "--json", "--quiet", "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    (row,) = json.loads(done.stdout)["clocks"]
    assert (row["heard"], row["accused"], row["found_clocks"], row["found_mountings"]) == (12, 0, 2, 2)
    assert row["clock_rms_us"] < 5
    assert "| omnidirectional | 12.0 of 12 | 0 of 2 | 2 of 2 (" in target.read_text("utf-8")


@pytest.mark.parametrize(
    ("fault", "expected"),
    [({"clock_us": -50.0}, (1, 0)), ({"moved_m": (0.0, 0.05, 0.0)}, (0, 1)), ({}, (0, 0))],
)
def test_clocks_bench_counts_each_fault_as_its_own(monkeypatch, fault, expected):
    """Every trial has the same fault, so that only the finds of its kind count."""
    monkeypatch.setattr(clock_checks, "EMITTERS_M", (0.0,))
    trial = clock_checks.PlatformTrial("left", **fault)
    monkeypatch.setattr(clock_checks, "_trials", lambda *_: (trial, trial, trial))
    (row,) = clock_checks.run(count=1, seed=5, say=lambda _: None)["clocks"]
    assert (row["found_clocks"], row["found_mountings"]) == expected
    assert row["accused"] == max(expected)


def test_maps_bench_counts_and_checks_maps_of_a_live_view(tmp_path, monkeypatch):
    monkeypatch.setattr(live_maps, "_WARM_UP", 5)
    target = tmp_path / "page.md"
    marker = "ertis bench network --only maps"
    target.write_text(f"<!-- {marker} -->\nold\n<!-- /{marker} -->\n", "utf-8")
    options = ["--duration", "2", "--json", "--quiet", "--folder", str(tmp_path), "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "network", "--only", "maps", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    (row,) = json.loads(done.stdout)["rows"]
    assert row["sent"] == row["published"] + sum(row["dropped"].values()) == 80
    assert row["maps"] + row["maps_dropped"] == row["published"]
    assert 0 < row["checked"] <= row["maps"] + 20
    assert row["wrong"] == 0
    assert f"80 measurements sent, {row['published']} published" in target.read_text("utf-8")


@pytest.mark.parametrize(("gain", "wrong"), [(1.0, 0), (1.001, 1)])
def test_maps_bench_finds_wrong_maps(tmp_path, gain, wrong):
    words = np.random.default_rng(1).integers(0, 2**32, (1, SETTINGS.recording.n_samples), dtype=np.uint32)
    np.save(tmp_path / "words.npy", words)
    with AcousticCamera(SETTINGS.replace(**{"processing.mode": "passive"}), check=False) as camera:
        found = camera.process(Measurement(words[0], camera.settings))
    job = MapViewerJob(address="", keys=("", ""), words=str(tmp_path / "words.npy"), stated="")
    assert n_wrong(job, [found.replace(power=gain * found.power)]) == wrong


def test_delays_bench_compares_delays(tmp_path, monkeypatch):
    monkeypatch.setattr(emission_delays, "EMITTERS_M", (0.012,))
    monkeypatch.setattr(emission_delays, "_DELAYS_MS", (0.0, 1.0))
    target = tmp_path / "page.md"
    marker = "ertis bench fusion --only delays"
    target.write_text(f"<!-- {marker} -->\nold\n<!-- /{marker} -->\n", "utf-8")
    options = ["--only", "delays", "--count", "1", "--seed", "1000", "--json", "--quiet", "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    together, apart = json.loads(done.stdout)["delays"]
    assert (together["spurious"], apart["spurious"]) == (0, 0)
    assert together["rms_m"] != apart["rms_m"]
    assert "| 12 mm | 1 ms | " in target.read_text("utf-8")


def test_scans_of_confirmed_reflectors_are_compared_with_rays(tmp_path, monkeypatch):
    monkeypatch.setattr(fused_scans, "EMITTERS_M", (0.012,))
    target = tmp_path / "page.md"
    marker = "ertis bench fusion --only scans"
    target.write_text(f"<!-- {marker} -->\nold\n<!-- /{marker} -->\n", "utf-8")
    options = ["--only", "scans", "--count", "2", "--seed", "5010", "--json", "--quiet", "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    (row,) = json.loads(done.stdout)["scans"]
    assert (row["off"], row["nearer"]) == (0, 0)
    assert row["beams"] >= row["shown"] > 0.5 * row["posts"]
    assert "| 12 mm | " in target.read_text("utf-8")


def test_rays_meet_the_nearest_surface():
    face = Face(np.array([2.0, -1.0]), np.array([2.0, 1.0]), 0.5)
    room = Room(np.array([[1.0, 0.0], [0.0, 3.0]]), np.zeros(2), (face,))
    rays_rad = np.array([0.0, 0.3, np.pi / 2, np.pi])
    np.testing.assert_allclose(nearest_m(room, rays_rad), [1.0, 2 / np.cos(0.3), 3.0, np.inf])


@pytest.mark.parametrize("diameter_m", [0.012, 0.0])
def test_rendered_sound_arrives_when_mirror_images_predict(diameter_m):
    """The echo of a wall comes from the mirror image of the sensor, as far behind the wall."""
    settings = settings_of()
    room = Room(np.empty((0, 2)), np.empty(0), (Face(np.array([1.5, -9.0]), np.array([1.5, 9.0]), 0.5),))
    sensors = mounted({"front": (0.2, 0.0, 0.0)})
    signals = rendered(sensors, settings, room, diameter_m=diameter_m, random=np.random.default_rng(0))
    image = images_of(signals, settings)["front"]
    direction, place = np.unravel_index(image.amplitude.argmax(), image.amplitude.shape)
    assert image.range_m[place] == pytest.approx(1.3, abs=0.01)
    assert image.azimuth_rad[direction] == pytest.approx(0.0, abs=0.04)


@pytest.mark.parametrize("reflections", [1, 2, 3])
def test_rendered_sound_meets_at_most_so_many_walls(reflections):
    """Sound between walls 1 m ahead and 0.8 m behind arrives over 2, 3.6 and 5.6 m."""
    settings = settings_of((0.3, 4.5))
    room = Room(np.empty((0, 2)), np.empty(0), (wall(0.0, 1.0, -1.0), wall(np.pi, 0.8, -1.0)))
    signals = rendered(
        mounted({"front": (0.0, 0.0, 0.0)}),
        settings,
        room,
        diameter_m=0.0,
        random=np.random.default_rng(0),
        reflections=reflections,
    )
    image = images_of(signals, settings)["front"]
    level = [image.select(range_m=(way_m / 2 - 0.02, way_m / 2 + 0.02)).amplitude.max() for way_m in (2.0, 3.6, 5.6)]
    is_heard = np.array(level) > 0.01 * level[0]
    assert is_heard.tolist() == [number < reflections for number in range(3)]


def test_rendered_corners_return_sound_equally_at_every_azimuth():
    """A corner of 90° returns sound to its source over both walls once, whatever the rounding errors."""
    signals = [
        rendered(
            mounted({"front": (0.0, 0.0, np.degrees(turn_rad))}),
            settings_of(),
            Room(np.empty((0, 2)), np.empty(0), (wall(turn_rad, 1.0, -1.0), wall(turn_rad + np.pi / 2, 1.3, -1.0))),
            diameter_m=0.0,
            random=np.random.default_rng(0),
        )["front"]
        for turn_rad in np.linspace(0, 6, 13)
    ]
    np.testing.assert_allclose(signals, np.broadcast_to(signals[0], np.shape(signals)), atol=1e-5)


def test_points_are_compared_with_posts_and_walls():
    room = Room(np.array([[1.0, 0.0], [0.0, -2.0]]), np.zeros(2), (wall(np.pi / 2, 1.5, -1.0),))
    place_m = np.array([[1.02, 0.01, 0], [0.03, 1.45, 0], [2.0, 0.5, 0], [0.0, -2.0, 0]], np.float32)
    uncertainty_m = np.full((4, 2), [0.01, 0.02], np.float32)
    confirmed = np.array([True, True, True, False])
    points = PointCloud(
        place_m, np.ones(4, np.float32), settings_of(), uncertainty_m=uncertainty_m, confirmed=confirmed
    )
    found, errors_m = wall_reflections.compared(points, ReflectingScene(1, "wall", 0, 0.0, room))
    assert found == {"pulses": 1, "beside": 1, "confirmed": 1, "posts": 2}
    np.testing.assert_allclose(errors_m, [[[0.0201, 0.0098], [0.01, 0.02]]], atol=1e-4)


def test_reflections_bench_counts_points_beside_all_surfaces(tmp_path, monkeypatch):
    monkeypatch.setattr(wall_reflections, "KINDS", ("wall",))
    target = tmp_path / "page.md"
    marker = "ertis bench fusion --only reflections"
    target.write_text(f"<!-- {marker} -->\nold\n<!-- /{marker} -->\n", "utf-8")
    options = ["--only", "reflections", "--count", "1", "--seed", "7", "--json", "--quiet", "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    whole, missing = json.loads(done.stdout)["reflections"]
    assert (whole["pulses"], missing["pulses"]) == (1, 3)
    assert (whole["beside"], missing["beside"], whole["posts"], missing["posts"]) == (0, 0, 2, 6)
    assert whole["confirmed"] > 0
    assert whole["rms_m"] <= whole["largest_m"] < 0.02
    text = target.read_text("utf-8")
    assert f"| all | 1 | 0 | {whole['confirmed']} of 2 | " in text
    assert "{" not in text


def test_emitters_bench_counts_broken_and_wrongly_stated_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(broken_emitters, "_N_PULSES", 1)
    target = tmp_path / "page.md"
    marker = "ertis bench fusion --only emitters"
    target.write_text(f"<!-- {marker} -->\nold\n<!-- /{marker} -->\n", "utf-8")
    options = ["--only", "emitters", "--count", "1", "--seed", "104", "--json", "--quiet", "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    row, _ = json.loads(done.stdout)["emitters"]
    assert (row["platforms"], row["pulses"], row["accused"], row["contradicted"], row["others"]) == (1, 1, 0, 0, 0)
    assert (row["diameter_m"], row["sensors"], row["named"], row["stated"]) == (0.0, 3, 1, 1)
    assert "| omnidirectional | " in target.read_text("utf-8")

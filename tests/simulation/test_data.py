"""The shipped recordings, rebuilt and processed; the scenes of the gallery and the text of its page."""

import dataclasses
import functools
import hashlib
import importlib.util
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from ertis_bench.platform_trials.furnished_rooms import hall
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.analysis.compare import compare
from ertis_numba.analysis.detect import find_peaks
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive import AcousticCamera
from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import Scene, load_scene
from ertis_numba.simulation.arrivals import arrivals
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.snapshot import snapshot
from ertis_numba.simulation.stopwatch import CostStopwatch
from ertis_numba.storage import open_recording
from tests.pages import page

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "data" / "synthetic"
NAMES = ("line", "reflectors", "reflectors_3d")


def test_shipped_data_has_all_scenes_and_is_small():
    assert {path.stem for path in FOLDER.glob("*.toml")} == set(NAMES)
    assert sum(path.stat().st_size for path in FOLDER.iterdir() if path.is_file()) < 3e6


def test_shipped_files_match_sha256sums():
    lines = (FOLDER / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in (line.split("  ") for line in lines)}
    assert set(sums) == {f"{name}.{kind}" for name in NAMES for kind in ("h5", "json", "toml")}
    for name, digest in sums.items():
        assert hashlib.sha256((FOLDER / name).read_bytes()).hexdigest() == digest, f"{name}: run make data"


@pytest.mark.parametrize("name", NAMES)
def test_shipped_recording_equals_its_simulated_scene(name):
    scene = load_scene(FOLDER / f"{name}.toml")
    report = json.loads((FOLDER / f"{name}.json").read_text())
    with open_recording(FOLDER / f"{name}.h5") as recording:
        (measurement,) = recording
        truth = recording.truth
    simulator = Simulator(scene)
    assert_array_equal(measurement.data, simulator.render().data)
    (reported,) = report["sensors"]
    assert hashlib.sha256(measurement.data.tobytes()).hexdigest() == reported["words_sha256"]
    decided = Scene.from_toml(truth.scene)
    assert decided.replace(effects=scene.effects) == scene
    assert {effect for effect, on in decided.effects.items() if on} == simulator.plan.active
    assert (truth.seed, report["seed"]) == (scene.seed, scene.seed)
    reflectors = simulator.reflectors()
    assert len(scene.points) == len(reflectors) == len(reported["reflectors"])
    (stored,) = truth.reflectors
    for field in ("name", "azimuth_deg", "elevation_deg", "range_m", "level_db"):
        wanted = [getattr(reflector, field) for reflector in reflectors]
        for given in (
            [getattr(reflector, field) for reflector in stored],
            [row[field] for row in reported["reflectors"]],
        ):
            assert given == wanted if field == "name" else np.allclose(given, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("method", ["fast", "paper"])
def test_image_of_shipped_recording_shows_its_reflectors(name, method):
    """Positions and relative levels agree; the far field and integer delays of the paper cost some accuracy."""
    with open_recording(FOLDER / f"{name}.h5") as recording:
        settings = recording.settings.replace(processing=recording.settings.processing.replace(method=method))
        image = Pipeline(settings, predict=method == "fast").process(recording[0])
    found = find_peaks(image, top=None)
    expected = json.loads((FOLDER / f"{name}.json").read_text())["sensors"][0]["reflectors"]
    angle_deg, range_m, level_db = (0.2, 0.001, 0.3) if method == "fast" else (2.0, 0.01, 1.0)
    for wanted in expected:
        near = min(found, key=lambda peak: abs(peak.range_m - wanted["range_m"]) - peak.level_db / 100)
        assert abs(near.azimuth_deg - wanted["azimuth_deg"]) < angle_deg
        if name == "line":  # which cannot observe it
            assert math.isnan(near.elevation_deg)
        else:
            assert abs(near.elevation_deg - wanted["elevation_deg"]) < angle_deg
        assert abs(near.range_m - wanted["range_m"]) < range_m
        assert abs(near.level_db - wanted["level_db"]) < level_db
    if method == "fast":
        assert len(find_peaks(image)) == len(expected)  # one peak per reflector, none for a side lobe
    strongest = sorted(peak.range_m for peak in found[: len(expected)])
    assert_allclose(strongest, sorted(wanted["range_m"] for wanted in expected), atol=range_m)


def script(name):
    """Return a script of the folder above as a module."""
    spec = importlib.util.spec_from_file_location(name, FOLDER.parent / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_data_build_is_reproducible(tmp_path):
    script("build").build(tmp_path)
    for name in NAMES:
        assert (tmp_path / f"{name}.json").read_text() == (FOLDER / f"{name}.json").read_text()
    sums = (tmp_path / "SHA256SUMS").read_text().splitlines()
    assert {line.split("  ")[1] for line in sums} == {f"{name}.{kind}" for name in NAMES for kind in ("h5", "json")}


# ---- the gallery -----------------------------------------------------------------------------------

PAGE = page("gallery")
CALLED_FOR = {
    "corridor": {"walls", "occlusion", "doppler", "emitter_directivity"},
    "faulty_array": {"microphone_noise", "microphone_spread", "microphone_faults"},
    "hall": {"cross_emission", "doppler", "emitter_directivity", "microphone_noise"},
    "moving_platform": {"cross_emission", "doppler", "emitter_directivity", "microphone_noise", "walls"},
    "moving_person": {"doppler", "target_size", "interference", "ambient_noise", "microphone_noise"},
    "shelf_of_bottles": {"walls", "target_size", "emitter_directivity"},
    "two_facing_sensors": {"cross_emission", "sync_delay", "emitter_directivity"},
}
SCENES = sorted(CALLED_FOR)
SOUNDS = {
    "bats": {"spreading", "absorption", "emitter_directivity", "doppler", "interference", "ambient_noise"},
    "leak": {"spreading", "absorption", "interference", "ambient_noise"},
}
"""Scenes without echoes, whose images show nothing, and effects that they need."""


def page_text_of(name):
    """Return the text of the page about a scene, between its markers."""
    return PAGE.partition(f"<!-- scene {name} -->")[2].partition(f"<!-- /scene {name} -->")[0]


def test_gallery_shows_all_scenes():
    assert {path.stem for path in (FOLDER / "scenes").glob("*.toml")} == {*SCENES, *SOUNDS}
    assert all(f"[{name}.toml](../../data/synthetic/scenes/{name}.toml)" in PAGE for name in (*SCENES, *SOUNDS))
    assert sorted(re.findall(r"^<!-- scene (\w+) -->$", PAGE, re.MULTILINE)) == SCENES
    pictures = set(re.findall(r"\]\(\.\./(pictures/gallery/\w+\.png)\)", PAGE))
    folder = ROOT / "docs" / "pictures" / "gallery"
    assert {ROOT / "docs" / picture for picture in pictures} == set(folder.iterdir())
    assert max(path.stat().st_size for path in folder.iterdir()) <= 150_000


def test_gallery_update_rejects_page_without_markers():
    gallery = script("gallery")
    assert sorted(gallery.SHOWN) == SCENES
    reported = gallery.replaced("a <!-- scene x -->old<!-- /scene x --> b", "scene x", "new")
    assert reported == "a <!-- scene x -->\nnew\n<!-- /scene x --> b"
    with pytest.raises(SystemExit, match="the page has no markers for 'scene y'; add <!-- scene y --> and"):
        gallery.replaced(reported, "scene y", "new")


def test_hall_is_written_by_its_script():
    path = FOLDER / "scenes" / "hall.toml"
    assert script("hall").text() == path.read_text()
    assert load_scene(path) == hall(1)


@functools.cache
def scene_and_plan(name):
    """Return the scene and the plan of its first measurement; later measurements may need more effects."""
    scene = load_scene(FOLDER / "scenes" / f"{name}.toml")
    return scene, make_plan(scene.replace(count=1))


@pytest.mark.parametrize("name", SCENES)
def test_gallery_page_lists_active_effects_of_each_scene(name):
    reported = dict(re.findall(r"^\| `(\w+)` \| (on|off) \|", page_text_of(name), re.MULTILINE))
    on = {effect for effect, state in reported.items() if state == "on"}
    assert CALLED_FOR[name] <= on
    scene, plan = scene_and_plan(name)
    assert not scene.effects
    assert plan.active <= on


@pytest.mark.parametrize("name", SCENES)
def test_image_of_gallery_scene_shows_most_reflectors(name):
    scene, plan = scene_and_plan(name)
    for sensor in scene.sensors:
        simulator = Simulator(scene, sensor=sensor.name, plan=plan)
        settings = sensor.settings().replace(processing=sensor.processing.replace(directions="2d:31"))
        image = Pipeline(settings, predict=False).process(dataclasses.replace(simulator.render(), settings=settings))
        assert 1e-3 < simulator.loudest < 0.5  # higher levels overload the modulators
        assert np.isfinite(image.amplitude).all()
        found = compare(image, simulator.reflectors(), min_level_db=-6.0)
        assert len(found.matched) > len(found.missed)


@pytest.mark.parametrize("name", SOUNDS)
def test_scene_of_sources_needs_the_effects_on_its_sound(name):
    scene, plan = scene_and_plan(name)
    assert not scene.effects
    assert all(sensor.emitter.silent for sensor in scene.sensors)
    assert SOUNDS[name] <= plan.active
    for sensor in scene.sensors:
        simulator = Simulator(scene, sensor=sensor.name, plan=plan)
        signals = simulator.signals(0)
        assert 1e-3 < np.abs(signals).max() < 0.5
        assert {each.kind for each in simulator.sources()} <= {"noise", "sonar"}
        assert len(simulator.sources()) == 2


def test_acoustic_map_of_the_leak_is_loudest_in_its_direction():
    """The leak exceeds the machine above 20 kHz; 3000 directions are 2.6 degrees apart."""
    scene, plan = scene_and_plan("leak")
    simulator = Simulator(scene, plan=plan)
    leak, machine = simulator.sources()
    bands_hz = ((10e3, 14e3), (35e3, 55e3))
    settings = scene.sensor().settings().replace("passive.bands_hz", bands_hz)
    camera = AcousticCamera(settings, check=False)
    for index in range(2):
        camera.add(dataclasses.replace(simulator.render(index), settings=settings))
    for found, true in zip(camera.map().loudest(), (machine, leak), strict=True):
        assert abs(math.degrees(found.azimuth_rad) - true.azimuth_deg) < 3.0
        assert abs(math.degrees(found.elevation_rad) - true.elevation_deg) < 3.0


def test_calls_of_both_bats_arrive_with_their_doppler_factors():
    scene, plan = scene_and_plan("bats")
    speed_m_s = sound_speed_m_s(scene.sensor().air)
    received = {sonar.call: 0 for sonar in scene.sonars}
    for index in range(scene.count):
        shot = snapshot(scene, scene.sensor(), index / scene.rate_hz)
        for entry in arrivals(shot, plan.active, np.array([30e3]), CostStopwatch()):
            place = next(sonar for sonar in scene.sonars if sonar.call == entry.call)
            away_m_s = place.velocity_at(shot.time_s) @ place.position_at(shot.time_s)
            away_m_s /= np.linalg.norm(place.position_at(shot.time_s))
            assert_allclose((entry.stretch - 1) * speed_m_s, away_m_s, atol=1.0)  # the bat turns while calls travel
            received[entry.call] += len(entry.delay_s)
    assert min(received.values()) > 5

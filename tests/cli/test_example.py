"""Files that `ertis example` writes and the demonstration that `ertis demo` runs."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path, PurePath
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli import _examples, demo
from ertis_cli.main import cli
from scipy.io import wavfile

from ertis_numba.simulation import load_scene
from ertis_numba.storage import open_recording

ROOT = Path(__file__).parents[2]


def run(*words, code=0):
    done = CliRunner().invoke(cli, [str(word) for word in words])
    assert done.exit_code == code, (done.output, done.exception)
    return done


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_example_lists_every_file_with_a_sentence():
    listed = json.loads(run("example", "--json").stdout)["examples"]
    assert [each["name"] for each in listed] == sorted(_examples.examples())
    assert all(each["description"].endswith(".") and len(each["description"]) > 20 for each in listed)
    assert "corridor.toml" in run("example").stdout


def test_every_example_equals_its_source_file():
    sources = {path.name: path for path in (*(ROOT / "examples").iterdir(), *(ROOT / "data").rglob("*"))}
    for name, item in _examples.examples().items():
        assert item.read_bytes() == sources[re.sub(r"\.(h5|wav)$", ".toml", name)].read_bytes()


def test_every_recording_of_the_repository_is_an_example():
    recordings = {path.name: path for path in (ROOT / "data").rglob("*.h5")}
    examples = _examples.examples()
    assert set(recordings) == {name for name in examples if name.endswith(".h5")}
    assert all(_examples.is_written(path, examples[name]) for name, path in recordings.items())


def test_example_copies_a_scene_and_simulates_its_recording(monkeypatch):
    monkeypatch.setenv("ERTIS_SIMULATE_SEED", "7")
    assert "reflectors.h5: 1 measurement, 5 reflectors" in run("example", "reflectors").stderr
    report = json.loads((ROOT / "data" / "synthetic" / "reflectors.json").read_text("utf-8"))
    assert _examples.words_sha256(Path("reflectors.h5"), "sensor") == report["sensors"][0]["words_sha256"]
    assert len(load_scene("reflectors.toml").points) == 5
    run("example", "platform.toml", "-o", ".")
    assert {path.name for path in Path().iterdir()} == {"reflectors.h5", "reflectors.toml", "platform.toml"}


def test_example_writes_sound_with_one_channel_per_microphone():
    """The post at 1.2 m ahead and 0.3 m to the left reaches the microphone farthest to the left first."""
    run("example", "echoes")
    rate_hz, samples = wavfile.read("echoes.wav")
    n_before, n_echo = (round(rate_hz * time_s) for time_s in (2 * np.hypot(1.2, 0.3) / 343.2 - 1e-4, 2.2e-3))
    echo = samples[n_before : n_before + n_echo].astype(float)
    assert np.std(echo) > 5 * np.std(samples[n_before - n_echo : n_before].astype(float))
    lags = np.argmax(np.fft.irfft(np.fft.rfft(echo, axis=0) * np.fft.rfft(echo[:, -1:], axis=0).conj(), axis=0), axis=0)
    np.testing.assert_allclose(lags, rate_hz / 343.2 * 0.2425 * np.linspace(0.028, 0, 8), atol=0.6)
    assert "echoes.wav: unchanged" in run("example", "echoes.wav").stderr
    Path("echoes.wav").write_bytes(b"other")
    assert "echoes.wav" in run("example", "echoes", code=1).stderr


def test_every_copied_scene_can_be_loaded():
    scenes = [name for name in _examples.examples() if PurePath(name).suffix == ".toml"]
    scenes = [
        name
        for name in scenes
        if name
        not in {"every_settings_key.toml", "every_layout_key.toml", "layout_in_metres.toml", "own_waveform.toml"}
    ]
    run("example", *scenes)
    for name in scenes:
        assert load_scene(name).sensors


def test_example_overwrites_only_with_force():
    Path("line.toml").write_text("mine")
    assert (
        "line.toml exists; choose another name, or replace the file (--force)" in run("example", "line", code=1).stderr
    )
    assert Path("line.toml").read_text() == "mine"
    assert not Path("line.h5").exists()
    run("example", "line", "--force")
    again = json.loads(run("example", "line", "--json").stdout)  # an identical copy is no conflict
    assert again == {"files": ["line.h5", "line.toml"], "written": []}
    shutil.copy(ROOT / "data" / "synthetic" / "reflectors.h5", "line.h5")
    assert "line.h5 exists" in run("example", "line", code=1).stderr
    Path("line.h5").write_text("mine")
    assert "line.h5 exists" in run("example", "line", code=1).stderr


def test_example_suggests_a_name():
    assert "example 'coridor' does not exist; did you mean 'corridor'?" in run("example", "coridor", code=1).stderr


def test_demo_keeps_files_of_an_earlier_demo():
    folder = Path("demo")
    folder.mkdir()
    (folder / "image.png").write_text("mine")
    reported = run("demo", code=1).stderr
    assert "image.png exists; choose another folder (--output), or overwrite it (--force)" in reported
    assert (folder / "image.png").read_text() == "mine"


def test_demo_writes_recording_and_picture_of_four_sensors(tmp_path, monkeypatch):
    """Each sensor renders one measurement instead of the thirty of the shipped scene.

    Nodes run as processes, and commands that end by themselves in this process.
    """
    ran = []

    def run_here(command, *, env, **_):
        assert command[:3] == [sys.executable, "-m", "ertis_cli"]
        ran.append(" ".join(command[3:5]) if command[3] == "sensors" else command[3])
        return SimpleNamespace(returncode=CliRunner(env=env).invoke(cli, command[3:]).exit_code)

    scene = tmp_path / "small.toml"
    scene.write_text(_examples.examples()["platform.toml"].read_text("utf-8").replace("count = 30", "count = 1"))
    monkeypatch.setattr(_examples, "named", lambda name: {name: scene})
    replaced = SimpleNamespace(**vars(subprocess) | {"run": run_here})
    monkeypatch.setattr(demo, "subprocess", replaced)
    monkeypatch.setenv("ERTIS_SERVE_WORKERS", "1")
    run("demo", "-n", "2", "--quiet")
    assert ran == ["sensors list", "capture", "sensors status", "verify", "fuse", "peaks", "plot"]
    (recording,) = Path("demo/recordings").glob("*.h5")
    assert 1 <= len(open_recording(recording, sensor="front")) <= 2
    assert Path("demo/image.png").stat().st_size > 10_000
    assert "energyscape" in Path("demo/heard.jsonl").read_text("utf-8")

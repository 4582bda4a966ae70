"""``ertis sensors emulate`` as a separate process: output, measurements of its devices, and cleanup."""

import json
import os
import signal
import subprocess
import sys
import tracemalloc
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest
import serial
from click.testing import CliRunner
from ertis_cli._emulation import SceneRenderer
from ertis_cli.emulate import _Estimate, _get_ready, _render_all
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, SonarError
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.setup import Setup, call_codes, call_from_codes
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Call, Processing, Recording, Settings
from ertis_numba.simulation import Scene
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.engine import Engine
from ertis_numba.storage import open_recording, write_recording
from tests.emulated import N_SAMPLES, PATIENT, TIMEOUT_S, WORDS, ask, block, is_block, patient
from tests.files import noise

__all__ = ["patient"]  # A fixture, imported for use here.

pytestmark = PATIENT
MODULE = [sys.executable, "-m", "ertis_cli", "sensors", "emulate"]
SHORT = Settings(recording=Recording(n_samples=N_SAMPLES), processing=Processing(range_m=(0.3, 0.5)))
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@pytest.fixture
def recording(tmp_path):
    """A recording of two sensors, with two measurements and with one."""
    settings = Settings(recording=Recording(n_samples=N_SAMPLES), processing=Processing(range_m=(0.3, 0.5)))
    given = [("left", WORDS[0]), ("right", WORDS[1]), ("left", WORDS[2])]
    return write_recording(
        tmp_path / "rec.h5",
        [Measurement(words, settings, Stamp(sensor=name, sequence=index)) for index, (name, words) in enumerate(given)],
    )


@pytest.fixture
def emulate(tmp_path):
    """Start the command as a separate process and kill it after the test."""
    with ExitStack() as stack:

        def start(*arguments):
            process = stack.enter_context(
                subprocess.Popen(
                    [*MODULE, *(str(argument) for argument in arguments)],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    env=ENVIRONMENT | {"ERTIS_EMULATED_DIR": str(tmp_path / "links")},
                )
            )
            stack.callback(process.kill)
            return process

        yield start


def ended(process, number):
    process.send_signal(number)
    out, errors = process.communicate(timeout=TIMEOUT_S)
    return process.returncode, out, errors


def test_emulate_replays_a_recording(emulate, recording, tmp_path):
    log = tmp_path / "log"
    process = emulate(recording, "--sync-rate", 50, "--log", log, "--fault", "short_reads=1", "--quiet")
    paths = [process.stdout.readline().rstrip() for _ in range(2)]
    links = [tmp_path / "links" / name for name in ("left", "right")]
    assert [str(link.readlink()) for link in links] == paths
    for path, given in zip(paths, ([WORDS[0], WORDS[2]], [WORDS[1]]), strict=True):
        with serial.Serial(path, timeout=TIMEOUT_S) as port:
            ask(port, b"!G,131072,0,0\n")
            for counter in range(3):
                port.write(b"!A,1,0,0\n")
                assert is_block(block(port), counter, given[counter % len(given)])
    with serial.Serial(paths[1], timeout=TIMEOUT_S) as port:
        ask(port, b"!J,1,1,0\n")
        assert [is_block(block(port), counter, WORDS[1]) for counter in (3, 4)] == [True, True]
    assert ended(process, signal.SIGTERM) == (143, "", "")
    assert not list((tmp_path / "links").iterdir())
    entries = [json.loads(line) for line in log.read_text().splitlines()][:8]
    assert [entry["name"] for entry in entries] == 3 * ["left"] + 5 * ["right"]


def test_emulate_unplugs_and_reconnects_its_devices(emulate, recording, tmp_path):
    link = tmp_path / "mine"
    process = emulate(recording, "--sensor", "left", "--link", link, "--unplug", "0:0.05", "--json")
    reported = json.loads(process.stdout.readline())
    assert (reported["sensor"], reported["link"], reported["port"][:5]) == ("left", str(link), "/dev/")
    assert process.stderr.readline().startswith("left reconnected: /dev/")
    with serial.Serial(str(link), timeout=TIMEOUT_S) as port:
        assert ask(port, b"!Y,0,0,0\n") == 0x010000
    second = emulate(recording, "--sensor", "left", "--link", link)
    assert second.communicate(timeout=TIMEOUT_S)[1] == (
        f"ertis: error: link {link} belongs to a running emulated device; end that one, or choose another name\n"
    )
    assert second.returncode == 1
    code, out, errors = ended(process, signal.SIGINT)
    assert (code, out) == (130, "")
    assert errors.strip() == "the emulated sensors have ended"
    assert not link.is_symlink()


@pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_emulate_in_background_obeys_signals(emulate, recording, tmp_path, number, code):
    """A shell starts background jobs with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = emulate(recording, "--sensor", "left")
    finally:
        signal.signal(signal.SIGINT, before)
    process.stdout.readline()
    assert ended(process, getattr(signal, number))[0] == code
    assert not (tmp_path / "links" / "left").is_symlink()


def test_emulate_replaces_the_link_of_a_killed_emulator(emulate, recording, tmp_path):
    link = tmp_path / "links" / "left"
    process = emulate(recording, "--sensor", "left")
    process.stdout.readline()
    ended(process, signal.SIGKILL)
    assert link.is_symlink()
    process = emulate(recording, "--sensor", "left")
    assert process.stdout.readline().rstrip() == str(link.readlink())
    assert ended(process, signal.SIGTERM)[0] == 143


WITHOUT_PSEUDO_TERMINALS = """
import sys
import serial  # which has a module of its own for Windows

for name in ("fcntl", "termios", "tty"):
    sys.modules[name] = None
import ertis_numba
from ertis_cli.main import main

print(ertis_numba.Emulator.__name__, ertis_numba.Setup.__name__, ertis_numba.SonarDriver.__name__, flush=True)
main()
"""


def test_emulate_reports_a_system_without_pseudo_terminals(recording, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_PSEUDO_TERMINALS, "sensors", "emulate", str(recording)],
        capture_output=True,
        text=True,
        check=False,
        env=ENVIRONMENT | {"ERTIS_EMULATED_DIR": str(tmp_path / "links")},
    )
    assert done.stdout == "Emulator Setup SonarDriver\n"
    assert done.stderr == ("ertis: error: this system has no pseudo terminals; emulate sensors on Linux or macOS\n")
    assert done.returncode == 1
    assert not (tmp_path / "links").exists()


SCENE = """
seed = 3
count = 2
[[sensors]]
name = "only"
recording.n_samples = 32768
processing.range_m = [0.3, 0.5]
electronics.noise_dbfs = -40.0
[[points]]
range_m = 0.4
"""


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--fault", "lose"], 2, "'lose' is not a fault; choose a kind and a probability, as in lose=0.01"),
        (["--fault", "loose=1"], 2, "--fault: kind of fault 'loose' is unknown (did you mean 'lose'?)"),
        (["--count", "3"], 2, "--count is for scenes; remove it for a recording"),
        (["--link", "here"], 2, "--link is for one device, but rec.h5 has 2 sensors; choose one with --sensor"),
        (
            ["--sensor", "left", "--link", "none/here"],
            1,
            "link none/here: folder none does not exist; create it or choose",
        ),
        (["--sensor", "middle"], 1, "rec.h5 has no sensor 'middle'; choose one of left, right"),
        (["--sync-rate", "0"], 2, "0.0 is not in the range 0.001<=x<=1000.0"),
        (["--unplug", "3"], 2, "'3' is not an interval"),
    ],
)
def test_emulate_rejects_invalid_options(recording, tmp_path, monkeypatch, options, code, message):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli, ["sensors", "emulate", str(recording), *options])
    assert (done.exit_code, done.stdout) == (code, "")
    assert message in done.stderr
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_emulate_rejects_unsupported_measurement_length(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    done = CliRunner().invoke(cli, ["sensors", "emulate", str(write_recording(tmp_path / "rec.h5", noise()))])
    assert (done.exit_code, done.stdout) == (1, "")
    assert "recording.n_samples is 40960, but a sensor measures multiples of 32768 up to 16777216" in done.stderr


def captured(port, settings):
    """Configure a device as ``ertis capture`` does, and measure once."""
    with SonarDriver.open(port) as sonar:
        sonar.configure(Setup.of(settings))
        return sonar.measure().data


def rejected(process, port, other, settings, message):
    """Check that a device rejects a call twice, although it keeps the call for the second attempt."""
    for _ in range(2):
        with pytest.raises(SonarError, match="'ertis sensors emulate' prints the reason"):
            captured(port, settings.replace(call=other))
        assert process.stderr.readline().startswith(f"ertis: warning: {message}")


def test_emulate_renders_a_scene_for_the_configured_call(emulate, tmp_path):
    """The device renders the call of its scene, calls of presets and other calls, and rejects unusable ones."""
    (tmp_path / "scene.toml").write_text(SCENE)
    process = emulate(tmp_path / "scene.toml", "--seed", 4, "--quiet")
    path = process.stdout.readline().rstrip()
    scene = Scene.from_toml(SCENE).replace(seed=4)
    (sensor,) = scene.sensors
    silent = scene.replace(sensors=(sensor.replace(emitter=sensor.emitter.replace(silent=True)),))
    with serial.Serial(path, timeout=TIMEOUT_S) as port:
        ask(port, b"!G,131072,0,0\n")
        for counter, active in enumerate((1, 1, 0, 1)):
            port.write(b"!A,%d,0,0\n" % active)
            heard = scene if active else silent  # all effects are on, as selecting the relevant ones is slow
            words = Engine(heard, heard.sensors[0], frozenset(EFFECTS)).render(counter % 2).data
            assert is_block(block(port), counter, words)
    settings = Settings.from_preset("short_20_80")
    sensor = sensor.replace(call=settings.call, recording=settings.recording, processing=settings.processing)
    engine = Engine(scene.replace(sensors=(sensor,)), sensor, frozenset(EFFECTS))
    assert np.array_equal(captured(path, settings), engine.render().data)
    settings = settings.replace(call=Call(start_frequency_hz=35_000.0, stop_frequency_hz=60_000.0))
    loaded = call_from_codes(call_codes(settings.call), settings.call.sample_rate_hz)
    engine = Engine(
        scene.replace(sensors=(sensor.replace(call=loaded),)), sensor.replace(call=loaded), frozenset(EFFECTS)
    )
    assert np.array_equal(captured(path, settings), engine.render().data)
    long = SHORT.call.replace(duration_s=10e-3)
    rejected(process, path, long, SHORT, "only received a call that cannot be rendered")
    assert len(captured(path, SHORT)) == N_SAMPLES
    assert ended(process, signal.SIGTERM) == (143, "", "")


def test_delayed_call_is_found_in_the_codes_of_a_sensor():
    call = Call(delay_s=12e-3)
    codes = call_codes(call)
    assert (codes[:5400] == 2048).all()
    found = call_from_codes(codes, call.sample_rate_hz)
    assert found.start_s > 11.9e-3
    assert np.abs(call_samples(found)[:6500] - call_samples(call)[:6500]).max() < 2e-3
    assert Setup.of(Settings(call=call)).codes.tolist() == codes.tolist()
    with pytest.raises(ArgumentError, match=r"call has 68626 samples, .* call.delay_s and call.duration_s that add up"):
        Setup.of(Settings(call=Call(delay_s=0.15)))


def test_emulate_rejects_a_call_without_measurements(emulate, recording):
    process = emulate(recording, "--sensor", "left", "--quiet")
    port = process.stdout.readline().rstrip()
    message = "left was recorded with a call of 50 to 25 kHz in 2.5 ms and 32768 samples at 4.5 MHz"
    rejected(process, port, Call(start_frequency_hz=25_000.0, stop_frequency_hz=50_000.0), SHORT, message)
    assert len(captured(port, SHORT)) == N_SAMPLES
    assert ended(process, signal.SIGTERM) == (143, "", "")


def test_emulate_reports_a_point_on_a_sensor(emulate, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE + "[[points]]\nposition_m = [0.0, 0.0, 0.0]\n")
    process = emulate(tmp_path / "scene.toml")
    process.stdout.readline()
    _, _, errors = ended(process, signal.SIGTERM)
    assert "note: points[1] is 0 mm from an emitter or a microphone of only" in errors
    assert "rendering 2 measurements with a call, and as many without ..." in errors
    assert not any("rehears" in line or "Traceback" in line for line in errors.splitlines())


def test_emulate_renders_a_scene_before_answering_pulses(emulate, tmp_path):
    """With a SYNC line, the port exists before rendering starts, and every pulse gets its measurement."""
    (tmp_path / "scene.toml").write_text(SCENE)
    process = emulate(tmp_path / "scene.toml", "--sync-rate", 5)
    with SonarDriver.open(process.stdout.readline().rstrip()) as sonar:
        sonar.configure(Setup.of(SHORT))
        sonar.arm()
        blocks = sonar.listen(stop=lambda: False, timeout_s=TIMEOUT_S)
        words = [next(blocks).data for _ in range(3)]
    scene = Scene.from_toml(SCENE)
    engine = Engine(scene, scene.sensors[0], frozenset(EFFECTS))
    assert all(np.array_equal(came, engine.render(index % 2).data) for index, came in enumerate(words))
    assert "rendering 2 measurements of each sensor as pulses come" in ended(process, signal.SIGINT)[2]


def test_capture_waits_for_a_port(emulate, recording, tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "links"))
    with pytest.raises(SonarError, match="serial port 'left'"):
        SonarDriver.open("left")
    command = ["capture", "--port", "left", "-n", "2", "--settings", str(tmp_path / "settings.toml"), "--no-check-bits"]
    command += ["-o", str(tmp_path / "new.h5"), "--mounting", str(tmp_path / "where.toml"), "--json", "--quiet"]
    (tmp_path / "settings.toml").write_text(
        f"[recording]\nn_samples = {N_SAMPLES}\n[processing]\nrange_m = [0.3, 0.5]\n"
    )
    (tmp_path / "where.toml").write_text('[[sensors]]\nname = "left"\nposition_m = [1.0, 2.0, 3.0]\n')
    refused = CliRunner().invoke(cli, command)
    assert (refused.exit_code, "serial port 'left'" in refused.stderr) == (1, True)
    emulate(recording, "--sensor", "left")
    done = CliRunner().invoke(cli, [*command, "--wait", str(TIMEOUT_S)])
    assert done.exit_code == 0, done.stderr
    with open_recording(tmp_path / "new.h5") as made:
        assert made.translation_m.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("silent", [False, True])
def test_rendering_in_advance_leaves_nothing_to_render(silent, monkeypatch):
    """A device that renders a measurement while it records loses it on a busy machine."""
    scene = Scene.from_toml(SCENE)
    scene = scene.replace(sensors=tuple(each.replace("emitter.silent", silent) for each in scene.sensors))
    renderer, rendered = SceneRenderer(scene), []
    render = Engine.render
    monkeypatch.setattr(Engine, "render", lambda *given: rendered.append(given[1:]) or render(*given))
    _render_all(renderer, ["only"], quiet=True)
    assert len(rendered) == scene.count * (1 if silent else 2)
    words = {active: renderer.of("only", active=active) for active in (True, False)}
    assert [np.array_equal(words[True][index], words[False][index]) for index in range(scene.count)] == [silent] * 2
    assert len(rendered) == scene.count * (1 if silent else 2)


def test_rendering_begins_without_a_list_of_all_measurements():
    """The estimate of a long rendering follows the first measurements, so nothing of that length may come before."""

    def words(*_, **__):
        raise EOFError

    renderer = SimpleNamespace(count=1_000_000, emits=True, words=words)
    tracemalloc.start()
    try:
        with pytest.raises(EOFError):
            _render_all(renderer, ["only"], quiet=True)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("n_steps", "reported"),
    [
        (200_000, ["rendering takes about 833 min and 800.0 GB of memory; a smaller --count takes less"]),
        (200, ["rendering takes about 48 s and 800 MB of memory; a smaller --count takes less"]),
        (40, []),
    ],
)
def test_emulate_estimates_a_long_rendering(n_steps, reported):
    """Each measurement takes 0.25 s, and the first of two sensors 30 s."""
    elapsed_s = iter([30.0, 60.0, *(60.0 + 0.25 * step for step in range(1, n_steps))])
    estimate = _Estimate(n_steps, n_first=2, clock=lambda: next(elapsed_s))
    assert list(filter(None, (estimate.after(4_000_000) for _ in range(n_steps)))) == reported


def test_passive_capture_of_a_scene_loses_no_measurement(emulate, tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "links"))
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "settings.toml").write_text(SHORT.to_toml())
    emulate(tmp_path / "scene.toml", "--quiet").stdout.readline()
    command = ["capture", "--port", "only", "--passive", "-n", "10", "--rate", "10", "--quiet"]
    command += ["--settings", str(tmp_path / "settings.toml"), "-o", str(tmp_path / "new.h5")]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 0, done.stderr
    with open_recording(tmp_path / "new.h5") as made:
        assert (len(made), made.gaps) == (10, ())
        assert {stamp.behaviour for stamp in made.stamps()} == {"passive"}


@pytest.mark.parametrize(
    ("recorded", "requested", "remedy"), [("active", "passive", "without"), ("passive", "active", "with")]
)
def test_emulate_reports_a_behaviour_that_the_recording_lacks(emulate, tmp_path, recorded, requested, remedy):
    """The device warns once, and not about measurements with the behaviour of the recording."""
    stamps = [Stamp(sensor="left", sequence=index, behaviour=recorded) for index in range(2)]
    path = write_recording(
        tmp_path / "rec.h5", [Measurement(words, SHORT, stamp) for words, stamp in zip(WORDS, stamps, strict=False)]
    )
    process = emulate(path, "--quiet")
    emitted = {"active": b"!A,1,0,0\n", "passive": b"!A,0,0,0\n"}
    with serial.Serial(process.stdout.readline().rstrip(), timeout=TIMEOUT_S) as port:
        ask(port, b"!G,131072,0,0\n")
        for counter, behaviour in enumerate((recorded, requested, requested, recorded)):
            port.write(emitted[behaviour])
            assert is_block(block(port), counter, WORDS[counter % 2])
    assert ended(process, signal.SIGTERM)[2] == (
        f"ertis: warning: left: the requested measurements are {requested}, but those of the recording are {recorded} "
        f"and cannot change; capture {remedy} --passive, or emulate the scene\n"
    )


class Unrenderable(list):
    """Measurements of a scene that cannot be rendered."""

    def __getitem__(self, _):
        raise ArgumentError("spheres[0] is 0 m from emitter of sensor")


def test_pulse_preparation_survives_a_rendering_error():
    """The device renders the measurement again later and then reports the error."""
    registers = SimpleNamespace(armed=True, active=True, amplifier=True, n_codes=0)
    device = SimpleNamespace(name="sensor", error=None, registers=registers)
    _get_ready([device], {"sensor": (Unrenderable([0]), None, None)}, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--log", "{recording}"], "is no log of 'ertis sensors emulate'; choose another file"),
        (["--sensor", ""], "--sensor is empty; write a value, or leave it out"),
    ],
)
def test_foolish_options_are_refused_before_a_device_starts(recording, arguments, message):
    before = recording.read_bytes()
    done = CliRunner().invoke(
        cli, ["sensors", "emulate", str(recording), *(each.format(recording=recording) for each in arguments)]
    )
    assert done.exit_code != 0
    assert message in done.stderr
    assert recording.read_bytes() == before

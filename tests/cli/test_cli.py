"""Commands: results on stdout, messages on stderr, and exit codes."""

import ast
import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli import _toml_reference, options
from ertis_cli.main import COMMANDS, cli

from ertis_numba import kernels
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.settings import PRESETS, Air, Array
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from tests.files import SMALL, image, noise

MODULE = [sys.executable, "-m", "ertis_cli"]
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
ROOT = Path(__file__).parents[2]
LAYOUT = ["--layout", "eRTIS_v3D1", "--preset", "short_25_50"]
DEVIATIONS = ("angle_sd_deg", "range_sd_m", "level_sd_db")
FAST = ["--range", "0.5:1.2", "--directions", "2d:9"]


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def report(*arguments):
    return json.loads(run(*arguments, "--json").stdout)


@pytest.fixture
def raw(tmp_path):
    path = tmp_path / "raw.bin"
    path.write_bytes(np.random.default_rng(3).integers(0, 2**32, 2 * 65_536, dtype="<u4").tobytes())
    return path


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "rec.h5", noise())


@pytest.fixture
def images(tmp_path):
    return write_energyscapes(tmp_path / "img.h5", [image(), image(seed=2)])


def test_import_process_peaks_and_plot_raw_samples(tmp_path, raw):
    rec, img, picture = (tmp_path / name for name in ("rec.h5", "img.h5", "picture.png"))
    assert (
        report("import", "signals", raw, "-o", rec, *LAYOUT, "--temperature", 12.5, "--humidity", 80)["measurements"]
        == 2
    )
    made = report("process", rec, "-o", img, *FAST)
    assert (made["measurements"], made["directions"], made["device"]) == (2, 9, "cpu")
    assert made["median_ms"] > 0
    assert report("peaks", img, "--top", 2)["peaks"] == []  # the samples are noise
    found = report("peaks", img, "--top", 2, "--all")["peaks"]
    assert [peak["measurement"] for peak in found] == [0, 0, 1, 1]
    places = {"azimuth_deg", "elevation_deg", "range_m"}
    assert set(found[0]) == {"sensor", "measurement", *places, "level_db", "level_dbfs", "grid_error_deg", *DEVIATIONS}
    run("plot", img, "-o", picture, "-m", 1)
    assert picture.read_bytes().startswith(b"\x89PNG")
    with open_recording(rec) as back:
        assert back.settings.air == Air(temperature_c=12.5, humidity_percent=80.0)
        assert np.array_equal(np.concatenate([m.data for m in back]), np.fromfile(raw, "<u4"))
    with open_energyscapes(img) as back:
        assert back.range_m[-1] <= 1.2
        assert back.attributes["source"] == "rec.h5"
    assert sorted(item.name for item in tmp_path.iterdir()) == ["img.h5", "picture.png", "raw.bin", "rec.h5"]


def test_default_outputs_are_beside_the_input(tmp_path, raw):
    run("import", "signals", raw, *LAYOUT)
    run("process", tmp_path / "raw.h5", *FAST)
    run("plot", tmp_path / "raw.energy.h5")
    names = sorted(item.name for item in tmp_path.iterdir())
    assert names == ["raw.bin", "raw.energy.h5", "raw.energy.png", "raw.h5"]


def test_import_appends_several_raw_files(tmp_path, raw):
    run("import", "signals", raw, raw, "-o", tmp_path / "rec.h5", *LAYOUT, "--sensor", "left")
    with open_recording(tmp_path / "rec.h5") as back:
        assert [m.stamp.sequence for m in back] == [0, 1, 2, 3]
        assert back.sensor == "left"


def test_json_output_is_one_object_on_stdout(recording, images, tmp_path):
    for arguments in (
        ["process", recording, "-o", tmp_path / "p.h5", *FAST],
        ["info", recording],
        ["info", images],
        ["peaks", images],
        ["plot", images],
    ):
        done = run(*arguments, "--json")
        assert done.stdout.count("\n") == 1
        assert isinstance(json.loads(done.stdout), dict)


def test_messages_go_to_stderr_unless_quiet(recording, tmp_path):
    done = run("process", recording, "-o", tmp_path / "a.h5", *FAST)
    assert done.stdout == ""
    assert "3 measurements, 9 directions" in done.stderr
    done = run("process", recording, "-o", tmp_path / "b.h5", *FAST, "--directions", "2d:31", "--quiet")
    assert done.stdout == ""
    assert re.fullmatch(r"ertis: warning: .*: the record contains no sweep above the noise, .*\n", done.stderr)


def test_info_reports_recordings_and_energyscapes(recording, images):
    held = report("info", recording)
    assert (held["kind"], held["measurements"], held["samples"], held["microphones"]) == ("recording", 3, 40_960, 32)
    assert held["first"] == "2023-11-14T22:13:20.123456789Z"
    assert held["simulated"] is False
    held = report("info", images)
    assert (held["kind"], held["measurements"], held["directions"], held["ranges"]) == ("energyscape", 2, 37, 400)
    assert ["directions", "37"] in [line.split() for line in run("info", images).stdout.splitlines()]


def test_info_reports_unknown_times_as_null(tmp_path):
    write_recording(tmp_path / "rec.h5", [Measurement(noise()[0].data, SMALL)])
    reported = report("info", tmp_path / "rec.h5")
    assert (reported["first"], reported["last"]) == (None, None)


def test_peaks_prints_a_table(images):
    lines = run("peaks", images, "-m", 1, "--top", 1).stdout.splitlines()
    places = ["azimuth_deg", "elevation_deg", "range_m"]
    assert lines[0].split() == ["sensor", "measurement", *places, "level_db", "level_dbfs", *DEVIATIONS]
    assert lines[1].split()[:2] == ["sensor", "1"]
    assert len(lines) == 2


def test_process_accepts_threads_device_method_and_dtype(recording, tmp_path):
    amplitudes = {}
    for name, extra in {
        "one": ["--threads", 1],
        "two": ["--threads", 2],
        "numpy": ["--device", "numpy"],
        "paper": ["--method", "paper"],
        "half": ["--dtype", "float16"],
        "levels": ["--dtype", "uint8"],
    }.items():
        run("process", recording, "-o", tmp_path / f"{name}.h5", *FAST, *extra)
        with open_energyscapes(tmp_path / f"{name}.h5") as back:
            amplitudes[name] = back[0].amplitude
    assert np.array_equal(amplitudes["one"], amplitudes["two"])
    np.testing.assert_allclose(amplitudes["half"], amplitudes["one"], rtol=2**-10, atol=1e-7)
    np.testing.assert_allclose(amplitudes["levels"], amplitudes["one"], rtol=0.03, atol=8e-7)
    np.testing.assert_allclose(amplitudes["numpy"], amplitudes["one"], atol=0.01 * amplitudes["one"].max())
    assert not np.array_equal(amplitudes["paper"], amplitudes["one"])


def test_rounding_beyond_the_budget_is_reported(recording, tmp_path):
    path = tmp_path / "img.h5"
    done = run("process", recording, "-o", path, *FAST, "--dtype", "uint8", "--max-error", -60)
    assert "uint8 rounds levels with an error of -35.6 dB, but accuracy.max_error_db is -60 dB; use" in done.stderr
    assert "uint8" not in run("process", recording, "-o", path, *FAST, "--dtype", "uint8", "--force").stderr
    (found,) = report("info", path)["sensors"]
    assert (found["level_step_db"], found["rounding_error_db"]) == (0.5, -35.59)  # 0.5 ln(10) / 20 / sqrt(12)
    run("export", path, "-o", tmp_path / "img.npz")
    with np.load(tmp_path / "img.npz") as arrays:
        assert arrays["level_step_db"] == 0.5


def test_process_limits_azimuth_of_a_grid(recording, tmp_path):
    run("process", recording, "-o", tmp_path / "img.h5", "--directions", "2d:3", "--azimuth", "-40:20", *FAST[:2])
    with open_energyscapes(tmp_path / "img.h5") as back:
        np.testing.assert_allclose(np.degrees(back.azimuth_rad), [-40, -10, 20])


def test_settings_file_changes_only_its_keys(recording, tmp_path):
    (tmp_path / "some.toml").write_text('[air]\ntemperature_c = 0.0\n[processing]\ndirections = "2d:5"\n')
    run("process", recording, "-o", tmp_path / "img.h5", "--settings", tmp_path / "some.toml", *FAST[:2])
    with open_energyscapes(tmp_path / "img.h5") as back:
        assert back.settings.air == SMALL.air.replace(temperature_c=0.0)
        assert back.settings.processing.directions == "2d:5"
        assert back.settings.processing.range_decimation == SMALL.processing.range_decimation
        assert len(back.azimuth_rad) == 5


def test_paths_in_settings_file_are_relative_to_that_file(recording, tmp_path, monkeypatch):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "some.toml").write_text('[array]\nlayout = "line.csv"\n[processing]\ndirections = "two.csv"\n')
    (folder / "line.csv").write_text("".join(f"{10 * channel}, 0\n" for channel in range(32)))
    (folder / "two.csv").write_text("-10, 0\n10, 0\n")
    monkeypatch.chdir(tmp_path)
    run("process", recording, "-o", "img.h5", "--settings", "mine/some.toml", *FAST[:2])
    with open_energyscapes(tmp_path / "img.h5") as back:
        assert back.settings.array.positions_m[1][1] - back.settings.array.positions_m[0][1] == pytest.approx(0.01)
        np.testing.assert_allclose(np.degrees(back.azimuth_rad), [-10, 10])
    words = np.zeros(SMALL.recording.n_samples, "<u4")
    (tmp_path / "a.bin").write_bytes(words.tobytes())
    (folder / "all.toml").write_text(SMALL.replace(array=Array(layout="line.csv")).to_toml())
    run("import", "signals", "a.bin", "--settings", "mine/all.toml", "-o", "a.h5")
    with open_recording(tmp_path / "a.h5") as imported:
        assert len(imported.settings.array.positions_m) == 32


def test_settings_file_replaces_an_array_as_a_whole(recording, tmp_path):
    (tmp_path / "some.toml").write_text('[array]\nlayout = "eRTIS_v2"\n')
    amplitudes = []
    for extra in ([], ["--settings", tmp_path / "some.toml"]):
        run("process", recording, "-o", tmp_path / "img.h5", *FAST, *extra, "--force")
        with open_energyscapes(tmp_path / "img.h5") as back:
            amplitudes.append(back[0].amplitude)
    assert back.settings.array.layout == "eRTIS_v2"
    assert not np.allclose(amplitudes[0], amplitudes[1])


def test_process_refuses_changing_air_without_settings(tmp_path):
    warm = SMALL.replace(air=Air(temperature_c=30.0))
    words = noise()[0].data
    write_recording(tmp_path / "rec.h5", [Measurement(words, SMALL), Measurement(words, warm, Stamp(sequence=1))])
    done = run("process", tmp_path / "rec.h5", *FAST, code=1)
    assert "measurement 1 was taken at 30 °C" in done.stderr
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]
    (tmp_path / "air.toml").write_text("[air]\ntemperature_c = 25.0\n")
    run("process", tmp_path / "rec.h5", *FAST, "--settings", tmp_path / "air.toml")


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_plot_writes_each_picture_format(recording, tmp_path, kind):
    run("plot", recording, "-o", tmp_path / f"a.{kind}", "--theme", "light", "--dynamic-range", 30, "--peaks", 0)
    assert (tmp_path / f"a.{kind}").stat().st_size > 10_000


def test_plot_overwrites_only_with_force(images, tmp_path):
    (tmp_path / "a.png").write_text("mine")
    assert "exists" in run("plot", images, "-o", tmp_path / "a.png", code=1).stderr
    assert (tmp_path / "a.png").read_text() == "mine"
    run("plot", images, "-o", tmp_path / "a.png", "--force")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_every_command_and_option_has_help():
    context = click.Context(cli, **cli.context_settings)
    for name, (_, about) in COMMANDS.items():
        command = cli.get_command(context, name)
        assert command.name == name
        assert command.help.splitlines()[0] == about
        assert run(name, "--help").stdout.startswith("Usage: ")
        members = command.commands.values() if isinstance(command, click.Group) else [command]
        for member in members:
            assert all(option.help for option in member.params if isinstance(option, click.Option)), member.name


def test_help_lists_all_commands():
    text = " ".join(run("--help").stdout.split())
    for name, (_, about) in COMMANDS.items():
        assert name in text
        assert about in text


def test_ertis_without_command_prints_usage():
    done = run(code=2)
    assert done.stdout == ""
    assert done.stderr.startswith("Usage: ertis [OPTIONS] COMMAND")


def test_closed_stdout_is_not_an_error(images):
    """In ``ertis info | head -1``, the reader closes the pipe early."""
    process = subprocess.Popen(
        [*MODULE, "info", images], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    process.stdout.close()
    assert process.stderr.read() == ""
    process.wait(timeout=60)
    process.stderr.close()


def test_import_help_lists_all_presets():
    text = run("import", "signals", "--help").stdout
    for preset in PRESETS:
        length, _, band = preset.partition("_")
        assert f"{length}_" in text
        assert band in text


def test_command_modules_import_libraries_lazily():
    """Modules of commands import only click, the standard library and small tables, so that help appears at once."""
    # They load no NumPy, as the next test checks.
    tables = {"ertis_numba.settings.beamformers", "ertis_numba.base.constants", "ertis_numba.base.units"}
    tables |= {"ertis_numba.settings.limits", "ertis_numba.settings.map_methods", "ertis_numba.interop.export_formats"}
    allowed = {*sys.stdlib_module_names, "click", "ertis_cli"}
    for path in set(Path(options.__file__).parent.glob("*.py")) - {Path(_toml_reference.__file__)}:
        for node in ast.parse(path.read_text()).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            assert {name.partition(".")[0] for name in names if name not in tables} <= allowed, path


def test_help_loads_no_heavy_library():
    code = "import sys; from ertis_cli.main import cli; cli.main(['--help'])"
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    loaded = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "click" in loaded
    assert not loaded & {"numba", "numpy", "scipy", "h5py", "matplotlib", "msgspec"}


@pytest.mark.parametrize("directions", ["90", "3000"])
def test_processing_loads_no_unused_library(tmp_path, directions):
    """SciPy would take a quarter of the time and 30 MB; of it, only its compiled transforms are used."""
    unused = {"matplotlib", "numpy.f2py", "scipy.fft", "scipy.linalg", "scipy.ndimage", "scipy.sparse", "scipy.spatial"}
    code = "import sys\nfrom ertis_cli.main import cli\ntry: cli.main(sys.argv[1:])\nfinally: print(*sys.modules)"
    recording = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors_3d.h5"
    command = ["process", recording, "-o", tmp_path / "image.h5", "--directions", directions]
    done = subprocess.run(
        [sys.executable, "-c", code, *command], env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    assert not unused & set(done.stdout.split())


def test_package_import_loads_no_heavy_library():
    code = "import sys, ertis_numba; ertis_numba.ErtisError, ertis_numba.__version__; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert not {"numba", "numpy", "scipy", "h5py", "matplotlib", "msgspec"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("time_s", "unused"), [("1e9", {"numba", "h5py", "matplotlib"}), ("1e300000", {"numba", "h5py", "scipy"})]
)
def test_reading_a_trajectory_loads_no_unused_library(tmp_path, time_s, unused):
    (tmp_path / "drive.tum").write_text(f"{time_s} 0 0 0 0 0 0 1\n1000000001 1 0 0 0 0 0 1\n")
    code = (
        "import sys, ertis_numba\n"
        "try: ertis_numba.read_trajectory(sys.argv[1])\n"
        "except ertis_numba.DataError: pass\n"
        "print(*sys.modules)"
    )
    command = [sys.executable, "-c", code, tmp_path / "drive.tum"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert not unused & set(done.stdout.split())


def test_version_option_prints_the_version():
    done = subprocess.run([*MODULE, "--version"], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("ertis ")


def test_error_of_a_command_is_one_line_on_stderr(images):
    command = [*MODULE, "info", images.with_name("none.h5")]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("ertis: error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signal_ends_import_and_removes_partial_file(tmp_path, number, code):
    with (tmp_path / "long.bin").open("wb") as file:
        file.truncate(4 * 65_536 * 8000)  # a sparse file, 2 GB of silence
    command = [*MODULE, "import", "signals", tmp_path / "long.bin", "-o", tmp_path / "rec.h5", *LAYOUT]
    process = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
    deadline_s = time.monotonic() + 60
    while not list(tmp_path.glob("*.part")):
        with pytest.raises(subprocess.TimeoutExpired):  # it still runs
            process.wait(0.01)
        assert time.monotonic() < deadline_s
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert errors.strip() == ("ertis: error: interrupted" if number == signal.SIGINT else "")
    assert [item.name for item in tmp_path.iterdir()] == ["long.bin"]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_in_a_weakref_callback_ends_the_process(number, code):
    """Python prints and then ignores an exception raised in the callback of a weak reference."""
    program = (
        "import signal, sys, weakref; from ertis_cli import _stop_signals; _stop_signals.obey_signals()\n"
        "class Dropped: pass\n"
        "item = Dropped()\n"
        f"reference = weakref.ref(item, lambda _: signal.raise_signal({number.value}))\n"
        "try:\n    del item\n    signal.sigtimedwait([], 60)\n    print('not obeyed')\n"
        "except KeyboardInterrupt:\n    sys.exit(130)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


SWALLOWED = (
    "import click, ctypes, signal; from ertis_cli import _stop_signals, main; _stop_signals.obey_signals()\n"
    "@click.command\n"
    "def compile():\n"
    "    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal({}))()\n"
    "    raise RuntimeError('no compiled object yet')\n"
    "main.COMMANDS['compile'] = ('__main__:compile', '')\n"
    "main.cli.main(['compile'])\n"
)
WHILE_IMPORTING = (
    "import signal, sys\n"
    "class Name:\n"
    "    def __set_name__(self, *_): signal.raise_signal({})\n"
    "class Loading:\n"
    "    def find_spec(self, name, *_):\n"
    "        if name == 'ertis_cli.main': type('Made', (), dict(name=Name()))\n"
    "sys.meta_path.insert(0, Loading())\n"
    "from ertis_cli.__main__ import main\n"
    "main()\n"
)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("program", [SWALLOWED, WHILE_IMPORTING], ids=["swallowed by a library", "while importing"])
def test_signal_hidden_by_another_error_prints_no_traceback(program, number, code):
    command = [sys.executable, "-c", program.format(number.value)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (code, ""), done.stderr
    assert done.stderr == ("ertis: error: interrupted\n" if number == signal.SIGINT else "")


@pytest.mark.parametrize("command", ["import signals", "simulate"])
def test_command_never_overwrites_its_input(tmp_path, command):
    path = tmp_path / "input.toml"
    path.write_bytes(b"\xaa" * 4 * 65_536 if command == "import signals" else b"seed = 1\n")
    before = path.read_bytes()
    arguments = [*command.split(), path, "-o", path, "--force", *(LAYOUT if command == "import signals" else [])]
    done = run(*arguments, code=1)
    assert "is the input itself; choose another name" in done.stderr
    assert path.read_bytes() == before


@pytest.mark.skipif(sys.platform != "linux", reason="file names are text elsewhere")
def test_import_accepts_file_name_that_is_not_utf8(tmp_path):
    raw = os.fsencode(tmp_path) + b"/b\xff.bin"
    Path(os.fsdecode(raw)).write_bytes(b"\xaa" * 4 * 65_536)
    run("import", "signals", os.fsdecode(raw), "-o", tmp_path / "rec.h5", *LAYOUT)  # as Python decodes an argument


def test_slow_work_prints_a_note(capsys):
    with options.note_when_slow("still working", after_s=0.0, quiet=False) as note:
        note.join()
    assert capsys.readouterr().err == "still working\n"
    with options.note_when_slow("still working", quiet=False):
        pass
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "command", ["process {} -o out.h5 --range 0.5:1 --directions 2d:3", "simulate scene.toml -o out.h5"]
)
def test_slow_start_note_does_not_mention_compiling(tmp_path, monkeypatch, command):
    """A slow start alone is no evidence of compilation."""
    reported = []

    @contextmanager
    def at_once(text, **_):
        reported.append(text)
        yield

    monkeypatch.setattr(options, "note_when_slow", at_once)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text("seed = 1\n")
    done = CliRunner().invoke(cli, command.format(ROOT / "data" / "synthetic" / "reflectors.h5").split())
    assert done.exit_code == 0, done.output
    assert reported[0] == "preparing ..."


def test_note_mentions_compiling_only_while_kernels_compile(capsys):
    import numba  # noqa: PLC0415

    kernels.load("cpu")
    for compiles in (True, False):
        with options.note_when_slow(options.PREPARING, quiet=False, after_s=60):
            numba.njit(lambda value: value + 1)(1) if compiles else None
        assert capsys.readouterr().err == (f"{options.COMPILING}\n" if compiles else "")


def test_warm_process_does_not_mention_compiling(recording, tmp_path):
    done = run("process", recording, "-o", tmp_path / "a.h5", *FAST)
    assert "compiles" not in done.stderr


def test_info_prints_air_and_times_with_units(recording):
    lines = run("info", recording).stdout.splitlines()
    reported = dict(re.split("  +", line, maxsplit=1) for line in lines)
    assert (reported["temperature"], reported["humidity"]) == ("20.0 °C", "50.0 %")
    assert reported["sound speed"] == "343.87 m/s"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{3})? UTC", reported["first"])
    held = report("info", recording)
    assert held["sound_speed_m_s"] == 343.87


def test_peaks_notes_that_one_microphone_has_no_directions(tmp_path):
    alone = SMALL.replace(array=SMALL.array.replace(layout="one", positions_m=((0.0, 0.0, 0.0),)))
    for settings, count in ((SMALL, 0), (alone, 1)):
        path = write_energyscapes(tmp_path / f"{count}.h5", [image(settings=settings)])
        stated = run("peaks", path).stderr
        assert stated.count("note: sensor sensor has one microphone; its images show ranges but no directions") == count

"""The code on the pages of the guide runs, and the pages name all public parts."""

import ast
import contextlib
import fnmatch
import pkgutil
import re
import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest
from scipy.io import wavfile

import ertis_numba
from ertis_numba import kernels
from ertis_numba.storage import GroundTruth, open_recording
from tests.pages import (
    DOCS,
    GUIDE,
    ROOT,
    commands_in,
    environment,
    in_background,
    page,
    python_in,
    run,
    run_code_here,
    run_here,
)
from tests.publishing import Publisher, cloud

RUN_BY = {
    ("accuracy", "$"): ["test_guide::test_commands_of_the_guide_run"],
    ("applications", "$"): ["test_applications_page::test_application_commands_of_the_page_run"],
    ("applications", "python"): ["test_applications_page::test_application_loop_of_the_page_runs"],
    ("batslam-format", "$"): ["test_batslam::test_commands_and_code_of_the_format_page_run"],
    ("batslam-format", "python"): ["test_batslam::test_commands_and_code_of_the_format_page_run"],
    ("beamformers", "$"): ["test_guide::test_commands_of_the_guide_run"],
    ("calibrate", "$"): ["test_calibrate_command::test_commands_and_code_of_the_page_run"],
    ("calibrate", "python"): ["test_calibrate_command::test_commands_and_code_of_the_page_run"],
    ("check", "$"): ["test_check::test_check_page_shows_the_printed_output"],
    ("check", "python"): ["test_check::test_check_page_shows_the_printed_output"],
    ("command-line", "$"): ["test_config::test_command_line_page_runs", "test_config::test_completion_for_each_shell"],
    ("concepts", "python"): ["test_guide::test_code_of_the_concepts_page_runs"],
    ("cuda", "$"): ["test_guide::test_commands_of_the_gpu_page_run"],
    ("cuda", "python"): ["test_guide::test_code_of_the_gpu_page_runs"],
    ("devices", "python"): ["test_word_stream::test_code_of_the_page_on_sensors_runs"],
    ("devices", "$"): ["test_readme::test_commands_of_the_devices_page_run"],
    ("export", "$"): ["test_export::test_export_page_commands_and_code_run"],
    ("export", "python"): ["test_export::test_export_page_commands_and_code_run"],
    ("first-hour", "$"): ["test_first_hour::test_first_hour_page_runs"],
    ("formats", "python"): ["test_guide::test_code_of_the_formats_page_runs"],
    ("from-rtisdev", "python"): ["test_rtisdev::test_replacements_run"],
    ("fusion", "$"): ["test_fusion::test_commands_and_code_of_the_page_run"],
    ("fusion", "python"): ["test_fusion::test_commands_and_code_of_the_page_run"],
    ("gallery", "$"): ["test_readme::test_gallery_starts_like_the_readme"],
    ("gpu", "$"): ["test_guide::test_commands_of_the_gpu_page_run"],
    ("install", "$"): [
        "test_without_numba::test_install_page_names_all_dependencies_but_numba_and_commands_that_run_without_it"
    ],
    ("health", "$"): ["test_health_commands::test_health_page_shows_the_printed_output"],
    ("mapping", "$"): ["test_map_command::test_commands_and_code_of_the_page_run"],
    ("mapping", "python"): ["test_map_command::test_commands_and_code_of_the_page_run"],
    ("many", "$"): [
        "test_many_docs::test_commands_of_the_page_run_in_order",
        "test_many_cluster::test_cluster_command_of_the_page_runs",
    ],
    ("many", "python"): ["test_many_docs::test_code_of_the_page_runs"],
    ("motion", "$"): ["test_odometry::test_commands_of_the_motion_page_run"],
    ("passive", "$"): ["test_acoustic_map_commands::test_commands_and_code_of_the_page_run"],
    ("passive", "python"): ["test_acoustic_map_commands::test_commands_and_code_of_the_page_run"],
    ("network", "$"): [
        "test_network_page::test_network_page_on_one_machine_runs",
        "test_network_page::test_network_page_on_several_machines_runs",
    ],
    ("nav2", "$"): ["test_guide::test_files_of_the_nav2_page_are_examples"],
    ("network", "python"): ["test_guide::test_code_of_the_network_page_runs"],
    ("numpy", "$"): ["test_numpy_page::test_page_has_short_examples"],
    ("numpy", "python"): [
        "test_numpy_page::test_page_examples_run",
        "test_numpy_page::test_own_beamformer_finds_the_reflectors",
    ],
    ("own-array", "$"): ["test_guide::test_own_array_page_runs"],
    ("own-array", "python"): ["test_guide::test_own_array_page_runs"],
    ("recordings", "$"): ["test_import_recorders::test_commands_of_the_page_run"],
    ("plots", "$"): ["test_plot::test_plot_commands_of_the_page_run"],
    ("plots", "python"): ["test_plot::test_plot_code_of_the_page_runs"],
    ("python", "python"): ["test_guide::test_import_loads_no_submodules"],
    ("quickstart", "$"): ["test_guide::test_quickstart_page_runs"],
    ("quickstart", "python"): ["test_guide::test_quickstart_page_runs"],
    ("ros", "$"): ["test_guide::test_commands_of_the_ros_page_run"],
    ("simulation", "$"): ["test_readme::test_commands_of_the_simulation_page_run"],
    ("simulation", "python"): ["test_readme::test_commands_of_the_simulation_page_run"],
    ("tour", "$"): ["test_readme::test_commands_of_the_readme_and_the_tour_run"],
    ("view", "$"): ["test_view_command::test_commands_of_the_page_on_the_view_run"],
    ("view", "python"): ["test_view_command::test_commands_of_the_page_on_the_view_run"],
}
"""Tests that run the code of each page: lines that begin with a prompt, or blocks of Python."""


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    (tmp_path / "data").symlink_to(ROOT / "data")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


# ---- all code is run --------------------------------------------------------------------------------


def test_all_code_of_the_guide_is_run():
    shown = set()
    for path in GUIDE:
        text = path.read_text("utf-8")
        shown |= {(path.stem, "$")} if re.search(r"^\w*\$ ", text, re.MULTILINE) else set()
        shown |= {(path.stem, "python")} if python_in(text) else set()
    assert shown == set(RUN_BY)


@pytest.mark.parametrize("about", RUN_BY, ids="-".join)
def test_tests_of_a_page_name_it(about):
    for named in RUN_BY[about]:
        file, name = named.split("::")
        (path,) = (ROOT / "tests").rglob(f"{file}.py")
        text = path.read_text("utf-8")
        assert name in {node.name for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)}
        assert f"{about[0]}.md" in text or f'"{about[0]}"' in text


# ---- pages without a file of tests of their own ------------------------------------------------------


def test_quickstart_page_runs(place):
    """The emulator replays the recording of its scene, which starts sooner."""
    text = page("quickstart").replace(
        "$ ertis sensors emulate reflectors.toml", "$ ertis sensors emulate reflectors.h5"
    )
    assert "$ ertis sensors emulate reflectors.h5" in text
    with contextlib.ExitStack() as background:
        for command in commands_in(text):
            if command.endswith("&"):
                background.enter_context(in_background(place, command))
            elif command != "doctor":  # test_doctor
                run_here(place, command)
    (code,) = python_in(text)
    assert "1.15 m at" in run_code_here(place, code)
    assert (place / "image.png").stat().st_size > 10_000
    assert len(open_recording(place / "CAPTURED.h5")) == 10


def test_own_array_page_runs(place):
    text = page("own-array")
    files = re.findall(r"`([\w.]+)`:\n\n```\w+\n(.*?)```", text, re.DOTALL)
    assert [name for name, _ in files] == [
        *("ring.csv", "ring8.toml", "mine.toml", "filter.toml", "scene.toml", "pcm.toml", "call.toml")
    ]
    for name, content in files:
        (place / name).write_text(content)
    numbers = np.random.default_rng(1).integers(-300, 300, (3_192, 8), dtype=np.int16)
    wavfile.write(place / "ECHOES.wav", 192_000, numbers)
    np.zeros(2 * 65_536, "<u4").tofile(place / "RING.bin")
    reported = [run_here(place, command) for command in commands_in(text)]
    assert re.search(r"\+14\.\d+ .* 1\.23\d ", reported[2])  # 1.2 m ahead and 0.3 m to the left
    assert re.search(r"\+14\.\d+ .* 1\.23\d ", reported[6])
    assert len(open_recording(place / "words.h5")) == 2
    assert ertis_numba.load_layout(place / "ring8.toml").word_bits == 8
    assert (open_recording(place / "echoes.h5")[0].data == numbers[192:]).all()
    filtering, code = python_in(text)
    run_code_here(place, filtering)
    taps = ertis_numba.Settings.load(place / "filter.toml").processing.pre_filter
    gain = np.abs(np.fft.rfft(taps, 4500))  # in steps of 100 Hz
    assert gain[390:411].max() < 0.01
    assert gain[[300, 360, 440, 500]] == pytest.approx(1, abs=0.01)
    run_code_here(place, code)
    assert open_recording(place / "mine.h5")[0].data.dtype == "u4"


@pytest.mark.parametrize("name", ["accuracy", "beamformers"])
def test_commands_of_the_guide_run(place, name):
    for command in commands_in(page(name)):
        run_here(place, command)
    assert (place / "REC.energy.h5").exists()


def test_files_of_the_nav2_page_are_examples(place):
    (command,) = commands_in(page("nav2"))
    run_here(place, command)
    for name in ("platform.toml", "nav2.yaml", "nav2.launch.py", "nav2.rviz"):
        assert (place / name).exists()


def test_code_of_the_concepts_page_runs(place):
    run_here(place, "example reflectors")
    (code,) = python_in(page("concepts"))
    reported = run_code_here(place, code + "\nprint(image.amplitude.shape[0])")
    assert reported.strip() == "81"


def test_commands_of_the_gpu_page_run():
    """The same as `make test` runs."""
    lines = re.findall(r"^\$ (.*?)\s+#", page("cuda") + page("gpu"), re.MULTILINE)
    legs = [line for line in lines if not line.startswith("pip install ")]
    assert len(legs) == 2
    recipes = (ROOT / "Makefile").read_text("utf-8")
    for leg in legs:
        *variables, _ = leg.split(".venv/bin/python -m pytest ")
        folder = leg.split()[-1]
        assert list((ROOT / folder).glob("test_*.py"))
        assert f"\t{variables[0]}$(PYTEST) {folder}" in recipes


def test_commands_of_the_ros_page_run(place):
    pytest.importorskip("mcap_ros2", reason="mcap comes with the extra ros")
    for command in commands_in(page("ros")):
        run_here(place, command)
    assert (place / "POINTS.mcap").stat().st_size > 1000


def test_code_of_the_gpu_page_runs(place):
    """On the CPU if there is no GPU."""
    (code,) = python_in(page("cuda"))
    assert code.count('"cuda"') == 1
    code = code.replace('"cuda"', '"cuda"' if "cuda" in kernels.usable() else '"cpu"')
    (place / "reflectors.h5").symlink_to(ROOT / "data" / "synthetic" / "reflectors.h5")
    reported = run_code_here(place, code + "\nprint(len(images), (images[0].amplitude == image.amplitude).all())")
    assert re.fullmatch(r"\d+ True\n", reported)


def test_code_of_the_formats_page_runs(place):
    """In a separate process, because netCDF-C and h5py each have their own HDF5."""
    (place / "REC.h5").symlink_to(ROOT / "data" / "synthetic" / "reflectors.h5")
    run_here(place, "process REC.h5 -o IMG.h5 --dtype uint8 --quiet")
    code, of_levels = python_in(page("formats"))
    (*_, last) = code.splitlines()
    reported = run(place, sys.executable, "-c", code.replace(last, f"print(dict({last}.sizes))")).stdout
    assert "'sample'" in reported
    reported = run(place, sys.executable, "-c", of_levels + "\nprint(level_db.dtype, float(level_db.max()))").stdout
    kind, highest_db = reported.split()
    assert kind.startswith("float")
    assert -30 < float(highest_db) < -28  # -28.9 dB


def test_code_of_the_network_page_runs(place):
    code, _ = python_in(page("network"))  # The other block is run by tests/network/test_configure.py.
    with Publisher() as publisher, publisher.playing([cloud(number) for number in range(3)]):
        code = code.replace("tcp://127.0.0.1:5602", publisher.address)
        words = [sys.executable, "-u", "-W", "error", "-c", code]
        with subprocess.Popen(words, cwd=place, env=environment(place), stdout=subprocess.PIPE, text=True) as process:
            lines = iter(process.stdout.readline, "")
            assert "2 [1. 0. 0.]\n" in lines  # reads up to it; there are no more
            process.terminate()


def test_import_loads_no_submodules(place):
    code = page("python").split("```python\n")[1].split("```")[0]
    modules = run(place, sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)").stdout.split()
    assert "ertis_numba" in modules
    assert not {"numpy", "scipy", "numba", "h5py", "zmq", "matplotlib"} & set(modules)


# ---- all names are listed ------------------------------------------------------------------------------


def public():
    """Paths on the page of the Python reference."""
    return re.findall(r"^\.\. auto\w+:: (ertis_numba[\w.]+)$", page("python"), re.MULTILINE)


def taught(text):
    """Paths of the package that a page names or that its code uses."""
    yield from re.findall(r"`(ertis_numba(?:\.\w+)+)`", text)
    for code in python_in(text):
        tree, homes = ast.parse(code), {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                homes |= {each.asname or each.name: f"{node.module}.{each.name}" for each in node.names}
            elif isinstance(node, ast.Import):
                homes |= {each.asname or each.name: each.name for each in node.names}
        homes = {name: path for name, path in homes.items() if path.startswith("ertis_numba")}
        yield from homes.values()
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in homes:
                yield f"{homes[node.value.id]}.{node.attr}"


def test_python_reference_lists_all_public_names():
    named = [path.removeprefix("ertis_numba.") for path in public()]
    assert sorted(name for name in named if "." not in name) == ertis_numba.__all__


def test_names_in_the_python_reference_are_exported():
    for path in public():
        home, _, name = path.rpartition(".")
        assert name in pkgutil.resolve_name(home).__all__, path


@pytest.mark.parametrize("path", [ROOT / "README.md", *GUIDE], ids=lambda path: path.stem)
def test_names_used_on_pages_are_public(path):
    """Any public path to the object is sufficient."""
    objects = {id(pkgutil.resolve_name(each)) for each in public()}
    homes = {each.rpartition(".")[0] for each in public()}
    for each in taught(path.read_text("utf-8")):
        meant = pkgutil.resolve_name(each)
        assert each in homes if isinstance(meant, ModuleType) else id(meant) in objects, each


def test_readers_have_the_documented_attributes():
    section = page("python").partition("## Files\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`.*?`) \|", section, re.MULTILINE)
    names = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert len(names) == 6
    with open_recording(ROOT / "data" / "synthetic" / "reflectors.h5") as recording:
        assert all(hasattr(recording, name) for name in names)
        assert isinstance(recording.truth, GroundTruth)


def test_every_page_is_in_the_table_of_contents():
    listed = " ".join(re.findall(r"```{toctree}\n(.*?)```", page("index"), re.DOTALL)).split()
    pages = {str(path.relative_to(DOCS).with_suffix("")) for path in GUIDE} - {"index"}
    assert {name for name in pages if not any(fnmatch.fnmatch(name, entry) for entry in listed)} == set()


def test_tables_updated_by_make_have_their_markers():
    """`make bench` and `make soak` would refuse a page without markers after minutes or hours."""
    lines = re.findall(r"ertis (bench [\w-]+)(.*)", (ROOT / "Makefile").read_text("utf-8"))
    updates = [(name, path) for name, rest in lines for path in re.findall(r"--update (\S+)", rest)]
    assert len(updates) > 10
    for name, path in updates:
        assert f"<!-- ertis {name}" in (ROOT / path).read_text("utf-8"), (name, path)

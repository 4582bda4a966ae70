"""The installed package is complete."""

import ast
import configparser
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_cli import _examples
from ertis_cli.bench import bench
from ertis_cli.main import cli

ROOT = Path(__file__).parents[2]
IN_THE_REPOSITORY_ONLY = {
    f"ertis_bench.{name}"
    for name in (
        "cpu_times",
        "error_trials",
        "gpu_trials",
        "health_trials",
        "network",
        "network_trials",
        "passive",
        "peers",
        "platform_trials",
        "simulation_trials",
    )
}
IN_THE_REPOSITORY_ONLY |= {"ertis_cli.source_benchmarks", "ertis_numba.kernels.benchmarks"}
IN_THE_WHEEL = {"accuracy", "paper"}


def test_every_package_is_listed():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    places = {
        "ertis_numba": "ertis_numba",
        "ertis_cli": "cli/ertis_cli",
        "ertis_bench": "bench/ertis_bench",
        "ertis_examples": "examples",
        "ertis_examples.synthetic": "data/synthetic",
    }
    found = {
        ".".join((name, *init.parent.relative_to(ROOT / place).parts))
        for name, place in places.items()
        for init in (ROOT / place).rglob("__init__.py")
    }
    assert found - listed == IN_THE_REPOSITORY_ONLY
    assert listed <= found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel as `pip install .` builds it, without a network, and without files that an earlier build has left."""
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "build.cfg").write_text(f"[build]\nbuild_base = {folder / 'build'}\n")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-build-isolation", "--no-deps", "--no-index"]
    environment = os.environ | {"DIST_EXTRA_CONFIG": str(folder / "build.cfg")}
    subprocess.run([*command, "--wheel-dir", folder, ROOT], env=environment, check=True, timeout=240)
    (path,) = folder.glob("*.whl")
    return path


def test_container_contains_every_package_and_installs_the_named_extras():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    copied = {line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")}
    folders = {line.partition("=")[2].split("/")[0].strip() for line in config["options"]["package_dir"].split("\n")}
    assert (folders - {""}) | {"setup.cfg", "pyproject.toml", "README.md", "LICENSE", "NOTICE", "ertis_numba"} <= copied
    container = (ROOT / "Containerfile").read_text()
    assert re.findall("^USER (.+)", container, re.MULTILINE)[-1] == "ertis"
    (install,) = re.findall(r"ARG EXTRAS\nUSER root\nRUN pip install --no-cache-dir (.+)", container)
    for extras, wanted in {"": "", "metrics": "[metrics]", "metrics,view": "[metrics,view]"}.items():
        script = f"ls() {{ echo /dist/a.whl; }}; EXTRAS={extras}; printf %s {install}"
        assert subprocess.check_output(["sh", "-c", script], text=True) == f"/dist/a.whl{wanted}"
    (named,) = re.findall("--build-arg EXTRAS=(.+?) ", container)
    assert named in config["options.extras_require"]


def test_wheel_contains_every_example(wheel):
    with zipfile.ZipFile(wheel) as archive:
        sizes = {Path(each.filename).name: each.file_size for each in archive.infolist() if "examples" in each.filename}
        layouts = {Path(name).name for name in archive.namelist() if "/layouts/" in name}
    examples = _examples.examples()
    assert {"reflectors.h5", "reflectors.toml", "platform.toml", "corridor.toml", "1_nearest_reflector.py"} <= set(
        examples
    )
    assert {item.name: len(item.read_bytes()) for item in examples.values()}.items() <= sizes.items()
    assert {f"{Path(name).stem}.json" for name in examples if name.endswith(".h5")} <= set(sizes)
    assert {path.name for path in (ROOT / "ertis_numba" / "layouts").glob("*.toml")} <= layouts


def lacks(module):
    """Return True for modules that the wheel lacks."""
    return any(f"{module}.".startswith(f"{name}.") for name in IN_THE_REPOSITORY_ONLY)


def test_benchmark_that_the_wheel_lacks_names_the_source_folder(monkeypatch):
    monkeypatch.setattr(bench, "commands", {name: bench.commands[name] for name in IN_THE_WHEEL})
    done = CliRunner().invoke(cli, ["bench", "fusion"])
    assert done.exit_code == 2
    assert done.stderr.startswith(
        "ertis: error: 'ertis bench fusion' is not in this installation, which has only paper and accuracy; run "
        "'pip install --editable .' in the source folder"
    )


def test_wheel_has_only_the_commands_of_its_benchmarks(wheel):
    with zipfile.ZipFile(wheel) as archive:
        assert not [name for name in archive.namelist() if name.startswith("ertis_cli/source_benchmarks")]


def test_benchmarks_in_the_wheel_need_nothing_that_it_lacks(wheel):
    with zipfile.ZipFile(wheel) as archive:
        sources = {name: archive.read(name).decode() for name in archive.namelist() if name.startswith("ertis_bench/")}
    assert {"ertis_bench/paper.py", "ertis_bench/accuracy.py"} <= sources.keys()
    for name, source in sources.items():
        used = {word for node in ast.walk(ast.parse(source)) for word in _modules(node)}
        assert not set(filter(lacks, used)), name


def _modules(node):
    """Return the modules that a node may import, and texts, which may be modules that a process runs."""
    if isinstance(node, ast.Import):
        return [each.name for each in node.names]
    if isinstance(node, ast.ImportFrom):
        return [f"{node.module}.{each.name}" for each in node.names]
    return [node.value] if isinstance(node, ast.Constant) and isinstance(node.value, str) else []


def test_wheel_is_small_and_contains_no_recording_and_no_test(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" not in name]
        sizes = {each.filename: each.compress_size for each in archive.infolist()}
    assert {name.partition("/")[0] for name in names} == {"ertis_bench", "ertis_cli", "ertis_examples", "ertis_numba"}
    assert {Path(name).suffix for name in names} <= {".json", ".py", ".pyi", ".rviz", ".toml", ".typed", ".yaml", ""}
    # A recording has a megabyte. Code grows with each feature, so that data are limited by themselves.
    assert sum(sizes[name] for name in names if Path(name).suffix not in {".py", ".pyi"}) <= 30e3
    assert wheel.stat().st_size <= 2.1e6

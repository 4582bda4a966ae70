"""The installed package is complete."""

import configparser
import subprocess
import sys
import zipfile
from pathlib import Path

from ertis_cli import _examples

ROOT = Path(__file__).parents[1]


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
    assert listed == found


def test_wheel_contains_every_example(tmp_path):
    """Built as `pip install .` builds it, without a network."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-build-isolation", "--no-deps", "--no-index"]
    subprocess.run([*command, "--wheel-dir", tmp_path, ROOT], check=True, timeout=240)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        sizes = {Path(each.filename).name: each.file_size for each in archive.infolist() if "examples" in each.filename}
        layouts = {Path(name).name for name in archive.namelist() if "/layouts/" in name}
    examples = _examples.examples()
    assert {"reflectors.h5", "reflectors.toml", "platform.toml", "corridor.toml", "1_nearest_reflector.py"} <= set(
        examples
    )
    assert {name: len(item.read_bytes()) for name, item in examples.items()}.items() <= sizes.items()
    assert {path.name for path in (ROOT / "ertis_numba" / "layouts").glob("*.toml")} <= layouts
    assert wheel.stat().st_size < 3e6

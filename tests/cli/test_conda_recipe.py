"""The recipe for conda states what the package states for pip."""

import configparser
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
CONDA_NAMES = {"matplotlib": "matplotlib-base"}
"""Packages that conda-forge names otherwise: its `matplotlib` also contains Qt."""


def test_recipe_requires_what_pip_installs():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())
    pinned = [each.split(">=") for each in config["options"]["install_requires"].split()]
    wanted = [f"{CONDA_NAMES.get(name, name.replace('_', '-'))} >={least}" for name, least in pinned]
    python, *required = recipe["requirements"]["run"]
    assert required == sorted(wanted)
    assert python.replace("${{ python_min }}", recipe["context"]["python_min"]) == (
        f"python {config['options']['python_requires']}"
    )
    assert recipe["context"]["version"] == config["metadata"]["version"]
    assert recipe["about"]["license"] == config["metadata"]["license"]
    assert recipe["about"]["license_file"] == config["metadata"]["license_files"].split()
    assert recipe["about"]["summary"] == config["metadata"]["description"]
    scripts = config["options.entry_points"]["console_scripts"].strip().splitlines()
    assert recipe["build"]["python"]["entry_points"] == scripts
    build_system = (ROOT / "pyproject.toml").read_text().partition("requires = [")[2].partition("]")[0]
    assert build_system.strip('"').replace(">=", " >=") in recipe["requirements"]["host"]

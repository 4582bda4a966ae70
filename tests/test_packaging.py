"""What is installed is everything there is."""

import configparser
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_package_is_listed():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    places = {"ertis_numba": ROOT, "ertis_cli": ROOT / "cli", "ertis_bench": ROOT / "bench"}
    found = {
        ".".join(init.parent.relative_to(place).parts)
        for name, place in places.items()
        for init in (place / name).rglob("__init__.py")
    }
    assert listed == found

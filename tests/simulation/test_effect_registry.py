"""Registry of effects: each effect changes recordings, and agrees with its module, its keys and the docs."""

import dataclasses
import pkgutil
import re
import typing
from pathlib import Path

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Processing, Recording
from ertis_numba.simulation import Scene, effects
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.effects import EFFECTS, INDISPENSABLE, Place
from ertis_numba.simulation.engine import Engine
from ertis_numba.simulation.loudness import peak_bound
from ertis_numba.simulation.snapshot import snapshot
from tests.scenes import THREE

PAGE = Path(__file__).parents[2] / "docs/explanation/simulator.md"
PLACES = [(name, place) for name, effect in EFFECTS.items() if name not in INDISPENSABLE for place in effect.places]


def example_of(name):
    """The effect's example, with three microphones, short PCM records and small images."""
    scene = Scene.from_toml(EFFECTS[name].example)
    small = {
        "array": THREE,
        "recording": Recording(n_samples=40_000, encoding="float32"),
        "processing": Processing(directions="2d:31", range_m=(0.1, 0.9)),
    }
    return scene.replace(sensors=tuple(sensor.replace(**small) for sensor in scene.sensors))


def rendered(scene, active):
    return [Engine(scene, sensor, frozenset(active)).render().data for sensor in scene.sensors]


def peak_bounds(scene, active):
    return [peak_bound(snapshot(scene, sensor, 0.0), frozenset(active)) for sensor in scene.sensors]


@pytest.mark.parametrize(("name", "place"), PLACES)
def test_effect_changes_the_recordings_of_its_example(name, place, monkeypatch):
    """The effect acts at one of its places, and all other effects are on. A place that nothing calls has no effect."""
    monkeypatch.setitem(EFFECTS, name, dataclasses.replace(EFFECTS[name], places=(place,)))
    scene, result = example_of(name), peak_bounds if place == "loudness" else rendered
    without, with_effect = result(scene, EFFECTS.keys() - {name}), result(scene, EFFECTS.keys())
    assert any(np.any(np.abs(a - b) > 1e-6) for a, b in zip(without, with_effect, strict=True))


@pytest.mark.parametrize("name", EFFECTS)
def test_effect_is_chosen_for_its_example(name):
    assert name in make_plan(example_of(name)).active


@pytest.mark.parametrize("name", INDISPENSABLE)
def test_indispensable_effect_cannot_be_switched_off(name):
    with pytest.raises(ArgumentError, match=f"effect '{name}' cannot be left out"):
        Scene(effects={name: False})


def test_effects_with_keys_apply_to_no_scene_without_them():
    for name, effect in EFFECTS.items():
        assert effect.may_apply(Scene()) == (not effect.keys), name


def test_modules_have_a_function_for_each_place_and_no_other():
    places = typing.get_args(Place)
    for name, effect in EFFECTS.items():
        if effect.places:
            defined = {*effects.module(name).__all__} & {*places}
            assert {*effect.places} == defined, name
            assert (name in INDISPENSABLE) != hasattr(effects.module(name), "estimate"), name
    documented = re.findall(r"^``(\w+)``", effects.__doc__, re.MULTILINE)
    assert documented == list(places)


def test_each_module_is_registered():
    modules = {each.name for each in pkgutil.iter_modules(effects.__path__) if not each.name.startswith("_")}
    assert modules == {name for name, effect in EFFECTS.items() if effect.places}


def test_page_on_the_simulator_lists_all_effects_in_order():
    table = PAGE.read_text(encoding="utf-8").split("| effect | equation |")[1].split("\n\n")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == list(EFFECTS)

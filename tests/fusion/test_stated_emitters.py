"""Contradictions between the stated diameter of emitters and the echoes of their calls."""

import functools
import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.fusion.emissions import is_much_better
from ertis_numba.storage import write_recording
from tests.small_platforms import images_of, mounted, random_reflectors, rendered, settings_of

PISTONS = "those of pistons, but omnidirectional emitters are assumed"
OMNIDIRECTIONAL = "those of omnidirectional emitters, but pistons are assumed"


@functools.cache
def images(seed, diameter_m, dead=None):
    places_m, strength_db = random_reflectors(seed)
    random = np.random.default_rng(seed)
    signals = rendered(
        mounted(), settings_of(), places_m, strength_db, diameter_m=diameter_m, random=random, dead=(dead,)
    )
    return tuple(images_of(signals, settings_of()).values())


def warning_of(pulse, stated_m):
    fuser = ertis.Fuser(mounted(), emitter_diameter_m=stated_m)
    fuser(pulse)
    return fuser.emitter_warning()


@pytest.mark.parametrize(("diameter_m", "other_m", "stated"), [(0.012, 0.0, PISTONS), (0.0, 0.012, OMNIDIRECTIONAL)])
def test_wrong_kind_of_emitters_is_warned_of(diameter_m, other_m, stated):
    pulse = images(600, diameter_m)
    assert warning_of(pulse, diameter_m) is None
    text = warning_of(pulse, other_m)
    assert stated in text
    assert text.startswith("the echoes contradict the mountings or the emitters")
    assert text.endswith(f", and if all are right, set emitter_diameter_m to {'their diameter' if diameter_m else '0'}")


@pytest.mark.parametrize("diameter_m", [0.0, 0.012])
def test_dead_emitter_does_not_contradict_the_settings(diameter_m):
    assert warning_of(images(600, diameter_m, "left"), diameter_m) is None


def test_emitters_are_not_judged_without_pulses_or_other_sensors():
    assert ertis.Fuser(mounted()).emitter_warning() is None
    one = ertis.Fuser(mounted(1), emitter_diameter_m=0.0)
    one(images(600, 0.012)[:1])
    assert one.emitter_warning() is None


def test_map_warns_of_wrong_emitters():
    mapper = ertis.Mapper(mounted(), emitter_diameter_m=0.0)
    mapper.add(images(600, 0.012), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    assert PISTONS in mapper.emitter_warning()


def test_process_warns_of_wrong_emitters_and_of_a_dead_one(tmp_path):
    places_m, strength_db = random_reflectors(502)
    signals = rendered(
        mounted(),
        settings_of(),
        places_m,
        strength_db,
        diameter_m=0.0,
        random=np.random.default_rng(0),
        dead=("front",),
    )
    measurements = [
        ertis.Measurement(
            signal, settings_of(), ertis.Stamp(sensor=name, sequence=0, sync_count=0, timestamp_ns=10**18)
        )
        for name, signal in signals.items()
    ]
    write_recording(tmp_path / "rec.h5", measurements, mounting=mounted())
    line = ["fuse", str(tmp_path / "rec.h5"), "--json", "-o", str(tmp_path / "fused.h5")]
    dead = json.loads(CliRunner().invoke(cli, [*line, "--emitter-diameter", "0"]).stdout)
    assert dead["unheard"] == {"front": 1}
    assert (
        "no sensor hears the call of front in 1 of 1 pulses; check its mounting, its emitter and its SYNC line"
        in dead["warnings"]
    )
    wrong = json.loads(CliRunner().invoke(cli, [*line, "--force"]).stdout)
    assert any(OMNIDIRECTIONAL in each for each in wrong["warnings"])


@pytest.mark.parametrize(("length", "other", "expected"), [(10, 60, True), (10, 20, False), (100, 130, False)])
def test_only_much_shorter_descriptions_contradict(length, other, expected):
    assert is_much_better(length, other) == expected

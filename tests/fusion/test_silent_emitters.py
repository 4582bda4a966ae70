"""Sensors whose emitters are broken, in scenes that are rendered without the simulator."""

import functools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.fusion.association import Reflectors
from ertis_numba.fusion.emissions import (
    EmissionCounts,
    ExpectedEchoes,
    PulseEvidence,
    best_evidence,
    cheapest,
    doubted,
    is_proven,
    silent_one,
    suspect,
    unproven_note,
)
from ertis_numba.ros.fused_points import FusedImages
from ertis_numba.simulation import load_scene
from ertis_numba.simulation.render import render
from ertis_numba.storage import write_recording
from tests.small_platforms import HEIGHT_M, images_of, mounted, random_reflectors, rendered, settings_of

PLACES_M = np.array([[1.6, 0.2, HEIGHT_M], [1.2, -1.0, HEIGHT_M], [-1.0, -1.3, HEIGHT_M]])
"""Reflectors in front, between front and right, and between back and right, but none before the left sensor."""


@functools.cache
def images(seed, number, diameter_m, dead=None, count=4):
    """Images of one pulse of a slowly moving platform among random reflectors, or those without one on the left."""
    places_m, strength_db = (PLACES_M, np.zeros(3)) if seed is None else random_reflectors(seed)
    signals = rendered(
        mounted(count),
        settings_of(),
        places_m - [0.02 * number, 0.03 * number, 0.0],
        strength_db,
        diameter_m=diameter_m,
        random=np.random.default_rng(number),
        dead=(dead,),
    )
    return tuple(images_of(signals, settings_of(), number).values())


def named(pulses, diameter_m, count=4):
    fuser = ertis.Fuser(mounted(count), emitter_diameter_m=diameter_m)
    return [fuser(each).unheard for each in pulses]


@pytest.mark.parametrize(("seed", "diameter_m", "dead"), [(506, 0.0, "front"), (501, 0.012, "right")])
def test_dead_emitter_is_named_within_three_pulses_until_it_recovers(seed, diameter_m, dead):
    """In the first scene, the echoes of neighbours also fit calls of the dead emitter."""
    healthy = [images(seed, number, diameter_m) for number in range(2)]
    broken = [images(seed, number, diameter_m, dead) for number in range(2, 5)]
    recovered = [images(seed, number, diameter_m) for number in range(5, 8)]
    found = named([*healthy, *broken, *recovered], diameter_m)
    assert found[:2] == [(), ()]
    assert found[4] == (dead,)
    assert set(found) == {(), (dead,)}
    assert found[-1] == ()


@pytest.mark.parametrize("diameter_m", [0.0, 0.012])
def test_sensor_with_nothing_before_it_is_not_dead(diameter_m):
    assert set(named([images(None, number, diameter_m) for number in range(3)], diameter_m)) == {()}


def test_sector_that_no_emission_reaches_is_stated_and_not_free():
    """Echoes of neighbours cannot show whether there is nothing on the left, or whether its emitter is dead."""
    nothing_m = np.append(PLACES_M, [[-1.5, 0.1, HEIGHT_M]], axis=0)
    for case, each in {"nothing": nothing_m, "dead": np.append(nothing_m, [[0.1, 1.7, HEIGHT_M]], axis=0)}.items():
        mapper = ertis.Mapper(mounted(), emitter_diameter_m=0.012)
        fuser = ertis.Fuser(mounted(), emitter_diameter_m=0.012)
        for number in range(3):
            signals = rendered(
                mounted(),
                settings_of(),
                each,
                np.zeros(len(each)),
                diameter_m=0.012,
                random=np.random.default_rng(number),
                dead=("left",) if case == "dead" else (),
            )
            group = [*images_of(signals, settings_of(), number).values()]
            fused = fuser(group)
            assert fused.unheard == ()
            assert fused.without_own_echo == ("left",)
            mapper.add(group, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), fused=fused)
        assert mapper.without_own_echo == {"left": 3}
        assert mapper.map.log_odds_at((0.0, 0.8)) == 0.0
        assert mapper.map.log_odds_at((0.8, 0.05)) < 0.0


@pytest.mark.parametrize("line", ["fuse FILE --json -o fused.h5", "map FILE --poses still.tum --json -o map.h5"])
def test_commands_state_sensors_without_an_echo_of_their_own(tmp_path, monkeypatch, line):
    """There is nothing on the left."""
    monkeypatch.chdir(tmp_path)
    settings, places_m = settings_of(diameter_m=0.012), np.append(PLACES_M, [[-1.5, 0.1, HEIGHT_M]], axis=0)
    signals = rendered(mounted(), settings, places_m, np.zeros(4), diameter_m=0.012, random=np.random.default_rng(0))
    stamps = {name: ertis.Stamp(sensor=name, sequence=0, sync_count=0, timestamp_ns=10**18) for name in signals}
    measurements = [ertis.Measurement(signal, settings, stamps[name]) for name, signal in signals.items()]
    write_recording(tmp_path / "rec.h5", measurements, mounting=mounted())
    (tmp_path / "still.tum").write_text("999999999.9 0 0 0 0 0 0 1\n1000000000.5 0 0 0 0 0 0 1\n")
    done = CliRunner().invoke(cli, line.replace("FILE", "rec.h5").split())
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["without_own_echo"] == {"left": 1}
    assert "note: no echo proves that these sensors emit: left in 1 of 1 pulse; if an emitter is broken" in done.stderr


def test_ros_states_sensors_without_an_echo_of_their_own():
    notes = []
    fused = FusedImages(notes.append)
    places_m = np.append(PLACES_M, [[-1.5, 0.1, HEIGHT_M]], axis=0)
    for number in range(4):
        signals = rendered(
            mounted(),
            settings_of(diameter_m=0.012),
            places_m,
            np.zeros(4),
            diameter_m=0.012,
            random=np.random.default_rng(number),
        )
        for image in images_of(signals, settings_of(diameter_m=0.012), number).values():
            fused.add(image, mounted())
    (note,) = notes
    assert note.startswith("SYNC pulse 2: no echo proves that these sensors emit: left; if an emitter is broken")


def test_emitters_that_echoes_show_are_not_stated():
    fuser = ertis.Fuser(mounted(), emitter_diameter_m=0.0)
    assert {fuser(images(506, number, 0.0)).without_own_echo for number in range(2)} == {()}


@pytest.mark.parametrize(("count", "expected"), [(3, {("left",)}), (2, {(), ("left",)})])
def test_right_one_of_few_sensors_is_named_or_none(count, expected):
    assert {named([images(502, number, 0.0, "left", count) for number in range(3)], 0.0, count)[-1]} <= expected


def test_points_of_a_dead_emitter_are_reflectors():
    """Echoes of neighbours in the image of a sensor that does not emit are not taken for its own."""
    places_m, _ = random_reflectors(502)
    fused = ertis.fuse(images(502, 0, 0.0, "front"), mounted(), emitter_diameter_m=0.0)
    assert fused.unheard == ("front",)
    apart_m = np.linalg.norm(fused.points.position_m[:, None] - places_m, axis=2).min(axis=1)
    assert len(apart_m) >= 8
    assert apart_m.max() < 0.03


def counts(heard, missed):
    return EmissionCounts(np.array(heard), np.array(missed))


@pytest.mark.parametrize(
    ("pulses", "known", "expected"),
    [
        ([counts([9, 9], [0, 0])], (), None),
        ([counts([9, 0], [0, 4])], (), 1),
        ([counts([9, 0], [0, 2])], (), None),  # too few
        ([counts([9, 0], [0, 2])] * 2, (), 1),  # several pulses
        ([counts([9, 30], [0, 4])], (), None),  # others have heard it
        ([counts([9, 0], [0, 4])], (1,), None),  # known
    ],
)
def test_emitter_is_suspected_if_its_silence_is_more_likely(pulses, known, expected):
    assert suspect(pulses, known) == expected


@pytest.mark.parametrize(
    ("costs", "missed", "expected"),
    [
        ((40, 2, 38), (8, 8, 8), 1),
        ((3, 2, 40), (8, 0, 8), 0),  # as good, but only one of them misses echoes
        ((3, 2, 40), (8, 8, 8), None),  # Two explanations are equally good.
        ((3, 2, 4), (0, 0, 0), None),
    ],
)
def test_silence_that_explains_most_is_named(costs, missed, expected):
    found = {number: counts([0, 0, 0], np.where(np.arange(3) == number, each, 0)) for number, each in enumerate(missed)}
    assert silent_one(0, counts([0] * 3, [8, 0, 0]), dict(enumerate(costs)), found) == expected


@pytest.mark.parametrize(
    ("joint", "other", "expected"),
    [
        (counts([0, 0], [8, 0]), counts([0, 0], [8, 8]), 0),  # Silence of the other one leaves the first unheard.
        (counts([0, 0], [8, 0]), counts([8, 0], [0, 8]), None),
        (counts([0, 8], [8, 0]), counts([8, 0], [0, 8]), 0),  # The other one is heard.
    ],
)
def test_equally_good_explanation_is_a_rival_if_others_do_not_contradict_it(joint, other, expected):
    assert silent_one(0, joint, {0: 2, 1: 2}, {0: counts([0, 3], [8, 0]), 1: other}) == expected


@pytest.mark.parametrize(
    ("counted", "cost", "expected"),
    [
        (counts([9, 3, 0], [0, 0, 0]), 20, {1, 2}),
        (counts([9, 9, 9], [0, 0, 4]), 20, {2}),
        (counts([9, 3, 0], [0, 0, 0]), 3, set()),  # There is little to explain better.
        (counts([0, 0], [0, 0]), 20, set()),  # of two, either one may be silent
    ],
)
def test_emitters_that_no_echo_shows_are_doubted(counted, cost, expected):
    assert doubted(range(len(counted.heard)), counted, cost) == expected


@pytest.mark.parametrize(
    ("joint", "costs", "expected"),
    [(20, {0: 18, 2: 5}, 2), (20, {0: 6, 2: 5}, None), (100, {1: 95}, None), (6, {1: 5}, None), (20, {}, None)],
)
def test_silence_must_explain_echoes_clearly_better(joint, costs, expected):
    assert cheapest(joint, costs) == expected


@pytest.mark.parametrize(
    ("n_unexplained", "confirmed", "heard", "expected"),
    [
        (1, [False, False], [False, False], True),  # no sound over several surfaces
        (2, [True, True], [False, False], True),
        (2, [True, False], [False, False], False),  # The other reflector may not exist, …
        (2, [True, True], [True, False], False),  # … or this one shows the call.
    ],
)
def test_sound_over_several_surfaces_does_not_prove_that_a_piston_is_silent(n_unexplained, confirmed, heard, expected):
    """Two reflectors, which miss the call of the second of two emitters at a receiver."""
    missed, is_heard = np.zeros((2, 2, 2, 2), np.bool_)
    missed[:, 0, 1], is_heard[:, 1, 1] = True, heard
    radiated = np.ones((2, 2))
    reflectors = SimpleNamespace(n_unexplained=n_unexplained, confirmed=np.array(confirmed), radiated=radiated)
    assert is_proven(1, ExpectedEchoes(is_heard, missed), reflectors) == expected


@pytest.mark.parametrize(
    ("proofs", "comparisons", "best", "compared"),
    [
        ([-1.0, 2.0], [], 2.0, 0),
        ([2.0, None], [], 2.0, 0),
        ([None, None], [3.0], 3.0, 1),
        ([None, None], [0.0, 4.0], 4.0, 2),
        ([None, -2.0, None], [-5.0, -1.0], -1.0, 2),
        ([None, None], [-3.0, 0.0], 0.0, 2),
    ],
)
def test_best_evidence_compares_no_more_than_it_takes_to_show_that_an_emitter_works(
    proofs, comparisons, best, compared
):
    """Proofs of pulses, and the comparisons of those without one, from the last pulse back."""
    results = iter(comparisons)
    pulses = [PulseEvidence({7}, lambda _, proof=proof: proof, lambda _: next(results)) for proof in reversed(proofs)]
    assert best_evidence(pulses) == {7: best}
    assert len([*results]) == len(comparisons) - compared
    assert best_evidence(pulses) == {7: best}  # Comparisons are made once.


def test_best_evidence_is_that_of_the_emitters_of_the_last_pulse():
    first, last = (PulseEvidence(each, {2: 1.0, 3: -1.0}.__getitem__, pytest.fail) for each in ({2, 3}, {3}))
    assert best_evidence([first, last]) == {3: -1.0}


def test_emitters_between_two_walls_are_heard(tmp_path):
    """Sound that walls reflect several times is unexplained, whichever emitter is silent."""
    sensors = [
        f'[[sensors]]\nname = "{name}"\nposition_m = {[*place_m]}\nyaw_deg = {yaw_deg}\n'
        "emitter.diameter_m = 0.012\nemitter.level_db = -24.0\n"
        'processing.directions = "90"\nprocessing.range_m = [0.6, 4.0]\nprocessing.range_decimation = 2\n'
        'recording.encoding = "float32"\nrecording.sample_rate_hz = 200000.0\nrecording.n_samples = 6000\n'
        for (name, (place_m, _)), yaw_deg in zip(mounted(4).items(), (0, 90, 180, -90), strict=True)
    ]
    walls = [
        f"[[walls]]\nposition_m = [0.0, {y}, 0.0]\nfacing_deg = [{-90.0 * y}, 0.0]\nreflection_db = -9.0\n"
        for y in (1.0, -1.0)
    ]
    posts_m = np.array([[1.5, 0.1, HEIGHT_M], [-1.5, 0.3, HEIGHT_M]])
    points = [f"[[points]]\nposition_m = {place_m.tolist()}\nstrength_db = -3.0\n" for place_m in posts_m]
    (tmp_path / "corridor.toml").write_text("\n".join([*sensors, *walls, *points]))
    scene = load_scene(tmp_path / "corridor.toml")
    measurements = [render(scene, sensor=name) for name in mounted(4)]
    with ertis.Pipeline(measurements[0].settings, predict=False) as pipeline:
        fused = ertis.Fuser(mounted(4))([pipeline.process(each) for each in measurements])
    assert fused.unheard == ()
    found_m = fused.points.position_m[fused.points.is_certain]
    assert (np.linalg.norm(found_m[:, None] - posts_m, axis=2).min(axis=0) < 0.03).all()


@pytest.mark.parametrize(
    ("power", "is_unexplained", "expected"),
    [([1.0, 0.1, 9.0], True, False), ([1.0, 0.5, 9.0], True, True), ([1.0, 0.5, 9.0], False, False)],
)
def test_loud_echoes_that_no_other_call_explains_prove_an_emission(power, is_unexplained, expected):
    """The first sensor hears two echoes, of which the second one is attributed to its call."""
    reflectors = object.__new__(Reflectors)
    reflectors._echoes = SimpleNamespace(receiver=np.array([0, 0, 1]), power=np.array(power))
    reflectors.located = (SimpleNamespace(echo=np.array([1, 2]), emitter=np.array([0, 0])),)
    silent = SimpleNamespace(is_unexplained=np.array([True, is_unexplained, False]))
    assert reflectors.proves(0, silent) == expected


@pytest.mark.parametrize("is_every", [False, True])
def test_note_names_other_sources_of_sound_if_no_sensor_is_heard(is_every):
    assert ("may come from another source" in unproven_note("left in 1 of 1 pulse", is_every=is_every)) == is_every

"""Scene files in TOML, and the error messages for invalid ones."""

import math
import time

import numpy as np
import pytest
import scipy.spatial.transform
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.geometry import microphones
from ertis_numba.settings import Air, Array, Call, Settings
from ertis_numba.simulation import (
    Ambient,
    Box,
    Electronics,
    Emitter,
    Noise,
    Point,
    Scene,
    Sensor,
    Sonar,
    Sphere,
    Tone,
    Wall,
    load_scene,
)
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.effects import EFFECTS, INDISPENSABLE
from ertis_numba.simulation.snapshot import snapshot
from ertis_numba.simulation.target_validity import require_clear
from tests.scenes import SENSOR

# ---- round trip ------------------------------------------------------------------------------------

vectors = st.tuples(*(st.floats(-50, 50) for _ in range(3)))
directions = st.tuples(st.floats(-180, 180), st.floats(-90, 90))
steady = st.fixed_dictionaries({"position_m": vectors, "velocity_m_s": vectors})
polar = st.fixed_dictionaries(
    {"azimuth_deg": st.floats(-180, 180), "elevation_deg": st.floats(-90, 90), "range_m": st.floats(1e-3, 1e4)}
)
way_points = st.lists(vectors, min_size=1, max_size=4).map(
    lambda places: {"waypoints": tuple((10.0 * number, *place) for number, place in enumerate(places))}
)
fixed, places = st.one_of(steady, polar), st.one_of(steady, polar, way_points)
bands = st.tuples(st.floats(1e3, 4e4), st.floats(5e4, 1e5))


def objects_of(kind, where=places, **fields):
    """Strategy for a few scene objects of one kind."""
    made = st.builds(lambda place, rest: kind(**place, **rest), where, st.fixed_dictionaries(fields))
    return st.lists(made, max_size=2).map(tuple)


sensors = st.builds(
    lambda base, place, rest: base.replace(**place, **rest),
    st.sampled_from([Sensor(), SENSOR, Sensor(air=Air(temperature_c=-10.0), call=Call(duration_s=1e-3))]),
    st.one_of(steady, way_points),
    st.fixed_dictionaries(
        {
            "yaw_deg": st.floats(-180, 180),
            "pitch_deg": st.floats(-90, 90),
            "roll_deg": st.floats(-180, 180),
            "emitter": st.builds(
                Emitter,
                level_db=st.floats(-300, 120),
                diameter_m=st.floats(0, 0.2),
                direct_sound_db=st.none() | st.floats(-300, 120),
                silent=st.booleans(),
            ),
            "electronics": st.builds(
                Electronics,
                noise_dbfs=st.none() | st.floats(-300, 0),
                modulator_order=st.integers(1, 4),
                dither=st.floats(0, 2),
                dead_channels=st.lists(st.integers(0, 1023), max_size=3).map(tuple),
                stuck_high=st.lists(st.integers(0, 1023), max_size=3).map(tuple),
            ),
        }
    ),
)
scenes = st.builds(
    Scene,
    seed=st.integers(0, 2**63 - 1),
    rate_hz=st.floats(0.01, 1000),
    count=st.integers(1, 10**9),
    tolerance_db=st.floats(0, 60),
    max_reflections=st.integers(0, 4),
    effects=st.dictionaries(st.sampled_from([name for name in EFFECTS if name not in INDISPENSABLE]), st.booleans()),
    sensors=st.lists(sensors, min_size=1, max_size=3).map(
        lambda found: tuple(sensor.replace(name=f"s{number}") for number, sensor in enumerate(found))
    ),
    points=objects_of(Point, strength_db=st.floats(-300, 120))
    | objects_of(Point, diameter_m=st.floats(1e-3, 10), facing_deg=st.none() | directions),
    spheres=objects_of(Sphere, radius_m=st.floats(1e-3, 10)),
    walls=objects_of(Wall, facing_deg=directions, size_m=st.none() | st.tuples(st.floats(0.1, 9), st.floats(0.1, 9))),
    boxes=objects_of(Box, fixed, size_m=st.tuples(*(st.floats(0.1, 9) for _ in range(3)))),
    tones=objects_of(Tone, frequency_hz=st.floats(1, 1e6)),
    noises=objects_of(Noise, band_hz=bands),
    sonars=objects_of(Sonar, period_s=st.floats(0.01, 10)),
    ambient=st.none() | st.builds(Ambient, level_dbfs=st.floats(-300, 0), band_hz=bands),
)


@settings(max_examples=50, deadline=None)
@given(scenes)
def test_scenes_survive_toml(scene):
    assert Scene.from_toml(scene.to_toml()) == scene


def test_empty_scene_file_is_one_sensor_in_silence():
    assert Scene.from_toml("") == Scene()
    assert Scene().sensor().settings() == Settings(array=Array(emitter_diameter_m=0.0))  # an omnidirectional emitter


def test_positions_are_computed_from_direction_and_range():
    by_angles = Point(azimuth_deg=90, elevation_deg=30, range_m=2.0)
    assert_allclose(by_angles.position_at(0.0), (0.0, math.sqrt(3), 1.0), atol=1e-12)
    assert_allclose(Point(range_m=2.0).position_at(0.0), (2.0, 0.0, 0.0))


# ---- files -----------------------------------------------------------------------------------------


def test_scene_stores_the_layout_beside_its_file(tmp_path):
    """A relative layout path starts at the folder of the scene file."""
    (tmp_path / "line.csv").write_text("y_mm, z_mm\n0, 0\n10, 0\n20, 0\n")
    (tmp_path / "scene.toml").write_text('[[sensors]]\narray.layout = "line.csv"\n[[points]]\nrange_m = 1\n')
    scene = load_scene(tmp_path / "scene.toml")
    assert scene.points == (Point(range_m=1.0),)
    assert scene.sensor().array.positions_m is not None
    assert len(microphones(scene.sensor().array).enabled) == 3
    (tmp_path / "line.csv").unlink()
    assert len(microphones(Scene.from_toml(scene.to_toml()).sensor().array).enabled) == 3


def test_named_layouts_stay_names(tmp_path):
    (tmp_path / "scene.toml").write_text('[[sensors]]\narray.layout = "uRTIS_v1"\n')
    assert load_scene(tmp_path / "scene.toml").sensor().array == Array(layout="uRTIS_v1")


def test_missing_scene_file_is_refused(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.toml: .*; choose a scene file \(TOML\)"):
        load_scene(tmp_path / "none.toml")


@pytest.mark.parametrize("channel", [32, 200])
def test_faults_of_missing_channels_are_refused(tmp_path, channel):
    path = tmp_path / "scene.toml"
    path.write_text(f"[[sensors]]\n[sensors.electronics]\ndead_channels = [{channel}]\n")
    with pytest.raises(
        ArgumentError, match=rf"sensor 'sensor' has no microphone on channel {channel}, .*; choose one of"
    ):
        load_scene(path)


# ---- invalid scenes --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed = ", "scene.*; correct it or remove it"),
        ("sede = 1", "scene.*unknown key `sede`; correct it"),
        ("[[points]]\nrange_m = 1\nradius_m = 1", "unknown key `radius_m`; correct it"),
        ("[[walls]]\nrange_m = 1", "`facing_deg` is missing; add it"),
        ("[[spheres]]\nrange_m = 1", "`radius_m` is missing; add it"),
        ("[[spheres]]\nrange_m = 1\nradius_m = 'a'", "Expected `float`, got `str`; correct it"),
        ("[[points]]\nrange_m = 0", r"point\.range_m is 0; use a number from 0\.001 to 10000"),
        ("[[points]]\nrange_m = nan", r"point\.range_m is nan; use a finite number"),
        ("[[points]]\nazimuth_deg = 1", "point has a direction but no range_m; add range_m"),
        ("[[points]]\nstrength_db = 1", "point does not have exactly one position; choose one of position_m, range_m"),
        ("[[points]]\nrange_m = 1\nposition_m = [1, 0, 0]", "point does not have exactly one position; choose"),
        ("[[points]]\nrange_m = 1\nazimuth_deg = 181", r"point\.azimuth_deg is 181; use a number from -180 to 180"),
        ("[[points]]\nrange_m = 1\nelevation_deg = 91", r"point\.elevation_deg is 91; use a number from -90 to 90"),
        ("[[points]]\nposition_m = [1, 0, 1e5]", r"point\.position_m is 100000; use a number from -10000 to 10000"),
        ("[[points]]\nrange_m = 1\nvelocity_m_s = [0, 101, 0]", r"point\.velocity_m_s is 101; use a number from -100"),
        ("[[points]]\nrange_m = 1\nstrength_db = 121", r"point\.strength_db is 121; use a number from -300 to 120"),
        ("[[points]]\nrange_m = 1\ndiameter_m = 11", r"point\.diameter_m is 11; use a number from 0 to 10"),
        (
            "[[points]]\nrange_m = 1\nfacing_deg = [0, 10]",
            r"point\.facing_deg is given, but a point without a diameter .*add point\.diameter_m",
        ),
        (
            "[[sensors]]\nemitter.quality_factor = 6.0",
            r"emitter\.quality_factor is 6, but the emitter has no resonance; add emitter\.resonance_hz",
        ),
        ("[[points]]\nrange_m = 1\nfacing_deg = [0, 99]", r"point\.facing_deg elevation is 99; use a number from -90"),
        (
            "[[points]]\nrange_m = 1\nfacing_deg = [999, 0]",
            r"point\.facing_deg azimuth is 999; use a number from -180",
        ),
        (
            "[[points]]\nwaypoints = [[0, 0, 0, 0], [0, 1, 0, 0]]",
            r"point\.waypoints go from 0 s to 0 s; pass strictly increasing",
        ),
        ("[[points]]\nwaypoints = [[nan, 0, 0, 0]]", r"point\.waypoints\[0\] time is nan; use a finite number"),
        (
            "[[points]]\nwaypoints = [[0, 0, 0, 0], [1, 999, 0, 0]]",
            r"point\.waypoints speed is 999; use a number from 0",
        ),
        (
            "[[points]]\nwaypoints = [[0, 0, 0, 0]]\nvelocity_m_s = [1, 0, 0]",
            "both waypoints and velocity_m_s; use only one",
        ),
        ("[[spheres]]\nrange_m = 1\nradius_m = 0", r"sphere\.radius_m is 0; use a number from 0\.001 to 1000"),
        (
            "[[spheres]]\nrange_m = 1\nradius_m = 1\nreflection_db = 1",
            r"sphere\.reflection_db is 1; use a number from",
        ),
        ("[[walls]]\nrange_m = 1\nfacing_deg = [0, 91]", r"wall\.facing_deg elevation is 91; use a number from -90"),
        ("[[walls]]\nrange_m = 1\nfacing_deg = [-181, 0]", r"wall\.facing_deg azimuth is -181; use a number from"),
        (
            "[[walls]]\nrange_m = 1\nfacing_deg = [0, 0]\nsize_m = [0, 1]",
            r"wall\.size_m is 0; use a number from 0\.001",
        ),
        (
            "[[walls]]\nrange_m = 1\nfacing_deg = [0, 0]\nreflection_db = 3",
            r"wall\.reflection_db is 3; use a number from",
        ),
        ("[[boxes]]\nrange_m = 1\nsize_m = [1, 1, 0]", r"box\.size_m is 0; use a number from 0\.001 to 10000"),
        ("[[boxes]]\nrange_m = 1\nsize_m = [1, 1, 1]\nyaw_deg = 200", r"box\.yaw_deg is 200; use a number from -180"),
        ("[[boxes]]\nrange_m = 1\nsize_m = [1, 1, 1]\nreflection_db = 1", r"box\.reflection_db is 1; use a number"),
        (
            "[[boxes]]\nwaypoints = [[0, 0, 0, 0]]\nsize_m = [1, 1, 1]",
            "box has waypoints, but boxes support only position_m and velocity_m_s",
        ),
        ("[[tones]]\nrange_m = 1\nfrequency_hz = 0", r"tone\.frequency_hz is 0; use a number from 1 to 1e\+06"),
        (
            "[[tones]]\nrange_m = 1\nfrequency_hz = 1\nlevel_db = 61",
            r"tone\.level_db is 61; use a number from -300 to 60",
        ),
        ("[[noises]]\nrange_m = 1\nlevel_db = 61", r"noise\.level_db is 61; use a number from -300 to 60"),
        ("[[noises]]\nrange_m = 1\nband_hz = [5e4, 4e4]", r"noise\.band_hz runs from 50000 to 40000; use the smaller"),
        ("[[noises]]\nrange_m = 1\nband_hz = [4e4, 4e4]", r"noise\.band_hz .*; choose two different frequencies"),
        ("[[sonars]]\nrange_m = 1\nperiod_s = 1e-3", r"sonar\.period_s is 0\.001; use a number from 0\.0025 to 1000"),
        ("[[sonars]]\nrange_m = 1\nlevel_db = 61", r"sonar\.level_db is 61; use a number from -300 to 60"),
        ("[[sonars]]\nrange_m = 1\noffset_s = -1", r"sonar\.offset_s is -1; use a number from 0 to 1000"),
        ("[ambient]\nlevel_dbfs = 1", r"ambient\.level_dbfs is 1; use a number from -300 to 0"),
        ("[ambient]\nband_hz = [0, 1]", r"ambient\.band_hz is 0; use a number from 1 to 1e\+06"),
        ("seed = -1", "seed is -1; use a whole number from 0 to 9223372036854775807"),
        ("rate_hz = 0", "rate_hz is 0; use a number from 1e-06 to 1e\\+06"),
        ("count = 0", "count is 0; use a whole number from 1 to 1000000000"),
        ("tolerance_db = -1", "tolerance_db is -1; use a number from 0 to 60"),
        ("max_reflections = 5", "max_reflections is 5; use a whole number from 0 to 4"),
        ("[effects]\nabsorbtion = true", r"effect 'absorbtion' is unknown \(did you mean 'absorption'\?\); known are"),
        ("[effects]\nmodulation = false", r"effect 'modulation' cannot be left out \(.*\); remove it from effects"),
        ("sensors = []", "scene has no sensors; add at least one"),
        ("[[sensors]]\n[[sensors]]", "scene has 2 sensors named 'sensor'; name each differently"),
        (
            "[[sensors]]\nname = ''",
            r"sensor\.name is ''; use letters, digits and _, and from the second character also \. @ \+ -",
        ),
        ("[[sensors]]\nyaw_deg = 181", r"sensor\.yaw_deg is 181; use a number from -180 to 180"),
        ("[[sensors]]\npitch_deg = 91", r"sensor\.pitch_deg is 91; use a number from -90 to 90"),
        ("[[sensors]]\nroll_deg = 181", r"sensor\.roll_deg is 181; use a number from -180 to 180"),
        ("[[sensors]]\nposition_m = [0, 0, 1e5]", r"sensor\.position_m is 100000; use a number from -10000 to 10000"),
        ("[[sensors]]\nvelocity_m_s = [0, 0, 101]", r"sensor\.velocity_m_s is 101; use a number from -100 to 100"),
        ("[[sensors]]\nemitter.level_db = 121", r"emitter\.level_db is 121; use a number from -300 to 120"),
        ("[[sensors]]\nemitter.diameter_m = 1", r"emitter\.diameter_m is 1; use a number from 0 to 0\.2"),
        ("[[sensors]]\nemitter.direct_sound_db = 121", r"emitter\.direct_sound_db is 121; use a number from -300"),
        ("[[sensors]]\nelectronics.noise_dbfs = 1", r"electronics\.noise_dbfs is 1; use a number from -300 to 0"),
        (
            "[[sensors]]\nelectronics.modulator_order = 5",
            r"electronics\.modulator_order is 5; use a whole number from 1",
        ),
        ("[[sensors]]\nelectronics.dither = 3", r"electronics\.dither is 3; use a number from 0 to 2"),
        (
            "[[sensors]]\nelectronics.microphone_diameter_m = 1",
            r"electronics\.microphone_diameter_m is 1; use a number",
        ),
        (
            "[[sensors]]\nelectronics.gain_spread_db = 21",
            r"electronics\.gain_spread_db is 21; use a number from 0 to 20",
        ),
        ("[[sensors]]\nelectronics.delay_spread_s = 1", r"electronics\.delay_spread_s is 1; use a number from 0 to"),
        (
            "[[sensors]]\nelectronics.dead_channels = [-1]",
            r"electronics\.dead_channels\[0\] is -1; use a whole number from 0",
        ),
        ("[[sensors]]\nrecording.n_samples = 0", r"recording\.n_samples is 0; use a whole number from 1 to 268435456"),
    ],
)
def test_bad_scenes_are_refused(text, message):
    with pytest.raises(SettingsError, match=message) as caught:
        Scene.from_toml(text)
    assert "\n" not in str(caught.value)


def test_errors_name_the_line():
    with pytest.raises(SettingsError, match=r"scene, line 5.*unknown key `rnage_m`"):
        Scene.from_toml("seed = 1\n[[points]]\nrange_m = 1\n[[points]]\nrnage_m = 2\n")


def test_unknown_sensors_and_fields_are_refused():
    with pytest.raises(ArgumentError, match=r"sensor 'x' is unknown; known are sensor"):
        Scene().sensor("x")
    with pytest.raises(ArgumentError, match=r"point key 'range' is unknown .did you mean 'range_m'"):
        Point(range_m=1.0).replace(range=1.0)


# ---- orientation of sensors ------------------------------------------------------------------------


@given(st.floats(-180, 180), st.floats(-90, 90), st.floats(-180, 180))
def test_rotation_and_quaternion_are_equivalent(yaw_deg, pitch_deg, roll_deg):
    sensor = Sensor(yaw_deg=yaw_deg, pitch_deg=pitch_deg, roll_deg=roll_deg)
    rotation = sensor.rotation()
    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert_allclose(scipy.spatial.transform.Rotation.from_quat(sensor.quaternion()).as_matrix(), rotation, atol=1e-9)
    wanted_m = (math.cos(math.radians(pitch_deg)) * math.cos(math.radians(yaw_deg)), math.sin(math.radians(pitch_deg)))
    assert_allclose(rotation[[0, 2], 0], wanted_m, atol=1e-12)  # Yaw to the left, then pitch up.


def test_error_in_a_long_scene_is_found_quickly():
    lines = ["[[points]]\nrange_m = 1"] * 1000 + ["[[points]]\nrnage_m = 1"] + ["[[points]]\nrange_m = 1"] * 1000
    started_s = time.process_time()
    with pytest.raises(SettingsError, match=r"scene, line 2002, points\[1000\]: unknown key `rnage_m`"):
        Scene.from_toml("\n".join(lines))
    assert time.process_time() - started_s < 5


@pytest.mark.parametrize(
    ("text", "refused"),
    [
        (
            "[[spheres]]\nposition_m = [0, 0, 0]\nradius_m = 1.0",
            r"spheres\[0\] is 0 m from emitter of sensor and has a radius of 1 m; leave at least 1 mm",
        ),
        (
            "[[sensors]]\nemitter.position_m = [1, 0, 0]\n[[spheres]]\nrange_m = 1.0\nradius_m = 0.1",
            r"spheres\[0\] is 0 m from emitter of sensor and",
        ),
        (
            "[[sensors]]\nemitter.silent = true\n[[spheres]]\nposition_m = [0.1, 0, 0]\nradius_m = 0.1",
            r"spheres\[0\] is 0\.1\d* m from microphone \d+ of sensor and has",
        ),
        (
            "count = 3\nrate_hz = 1\n[[spheres]]\nposition_m = [2, 0, 0]\nvelocity_m_s = [-1, 0, 0]\nradius_m = 0.5",
            r"spheres\[0\] is 0 m from emitter of sensor at 2 s and",
        ),
    ],
)
def test_targets_around_emitters_or_microphones_are_refused(text, refused):
    with pytest.raises(ArgumentError, match=refused):
        make_plan(Scene.from_toml(text))


def test_silent_emitters_inside_spheres_are_accepted():
    text = (
        "[[sensors]]\nemitter.silent = true\nemitter.position_m = [1, 0, 0]\n[[spheres]]\nrange_m = 1\nradius_m = 0.1"
    )
    require_clear(snapshot(scene := Scene.from_toml(text), scene.sensor(), 0.0))

"""Calibration of arrays: faults, errors and intervals, refusals, and the models behind them."""

import dataclasses
import functools
import importlib.metadata

import numpy as np
import pytest
from ertis_bench.error_trials.faulty_arrays import FaultyArray, calibration_errors, faulty_array, image_losses, record

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.calibration import calibrate
from ertis_numba.calibration.channel_order import find_swaps
from ertis_numba.calibration.observations import Observations, Tolerances
from ertis_numba.calibration.separable_problem import SeparableProblem
from ertis_numba.calibration.wavefronts import TARGETS, travel_times
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import load_layout, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Call, Processing, Recording, Settings
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor, Wall
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.render import Simulator
from tests.scenes import line_array, only

LAYOUT = load_layout("eRTIS_v3D1")
SENSOR = Sensor(emitter=Emitter(level_db=-6.0), electronics=Electronics(noise_dbfs=-55.0))


def rendered(sensor=SENSOR, **scene):
    """Render a measurement with every effect on, because plans take longer than renderings."""
    return Simulator(Scene(sensors=(sensor,), **scene), plan=only(*EFFECTS)).render(0)


def echo(azimuth_deg=20.0, range_m=1.0, **more):
    return rendered(points=(Point(azimuth_deg=azimuth_deg, range_m=range_m, strength_db=-10.0, **more),))


# ---- figures ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [3000, 3001])
def test_faults_are_found_and_errors_are_small(seed):
    """`ertis bench calibration` measures the intervals, which need many arrays."""
    array = faulty_array(seed)
    made = calibrate(record(array, seed, 20), ideal=True)
    assert {channel for cycle in made.swaps for channel in cycle} == set(array.displaced)
    assert made.silent == array.dead
    assert made.inverted == array.inverted
    assert not made.rejected
    errors = calibration_errors(array, made)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert rms[0] <= 0.01
    assert rms[1] <= 0.2
    assert np.all(rms[2:] <= 0.1)
    assert np.all(np.sqrt(np.mean((errors / made.sd) ** 2, axis=0)) < 3)
    assert made.residuals.before_s > 2e-6
    assert made.residuals.after_s < 20e-9
    assert made.residuals.before_db > 1.0
    assert made.residuals.after_db < 0.05
    loss_db, side_lobes_db = image_losses(array, made)
    assert loss_db <= 0.05
    assert side_lobes_db <= 0.5
    assert image_losses(array, made, calibrated=False)[0] > 1.0
    assert made.contrast_db[1] > made.contrast_db[0] + 1
    settings = made.layout.to_array()
    assert isinstance(settings, Array)
    assert {channel for channel, gain in enumerate(settings.gain) if gain < 0} == set(made.inverted)


@pytest.mark.parametrize("seed", range(3100, 3102))
def test_healthy_arrays_have_no_findings(seed):
    assert not calibrate(record(faulty_array(seed, healthy=True), seed, 6)).findings


# ---- faults -----------------------------------------------------------------------------------------


@functools.cache
def plain():
    """Recordings of an array without any error."""
    none = np.zeros(32)
    return record(FaultyArray(none, none, LAYOUT.positions_m, np.arange(32), (), ()), 7, 6)


def reordered(measurements, order):
    """Measurements whose channel i holds the bits of channel ``order[i]``."""
    made = []
    for item in measurements:
        bits = (item.data[:, None] >> np.arange(32, dtype=np.uint32)) & np.uint32(1)
        words = np.sum(bits[:, order] << np.arange(32, dtype=np.uint32), axis=1, dtype=np.uint32)
        made.append(dataclasses.replace(item, data=words))
    return made


@pytest.mark.parametrize(
    ("order", "name"),
    [
        (np.arange(32)[::-1], "the reversed order"),
        (np.arange(32) ^ 7, "the order of reversed bits in each byte"),
        (np.arange(32).reshape(4, 8)[::-1].ravel(), "the order of reversed bytes"),
    ],
)
def test_other_orders_are_named(order, name):
    made = calibrate(reordered(plain(), order))
    assert made.findings == (f"channels are in {name}",)
    assert np.allclose(made.layout.positions_m, LAYOUT.positions_m[order], atol=4e-4)


def test_longer_cycles_are_named():
    order = np.arange(32)
    order[[3, 9, 20]] = order[[9, 20, 3]]
    (finding,) = calibrate(reordered(plain(), order)).findings
    assert finding == "channels 3, 9 and 20 are at each other's positions, in a cycle"


def test_duplicate_channels_are_named_and_disabled():
    order = np.arange(32)
    order[9] = 8
    made = calibrate(reordered(plain(), order))
    assert made.findings == ("channel 9 repeats channel 8",)
    assert not made.layout.enabled[9]
    assert made.layout.enabled[8]


@pytest.mark.parametrize(
    ("flip", "name"),
    [
        ((1, -1, 1), "mirrored left to right"),
        ((1, 1, -1), "mirrored upside down"),
        ((1, -1, -1), "turned by 180° about its axis"),
    ],
)
def test_mirrored_layout_is_named_by_the_place_of_a_reflector(flip, name):
    first = rendered(points=(Point(azimuth_deg=25.0, elevation_deg=-15.0, range_m=0.9, strength_db=-10.0),))
    mirrored = dataclasses.replace(LAYOUT, positions_m=LAYOUT.positions_m * np.array(flip))
    made = calibrate([first, *plain()], mirrored, first_place=(30.0, -20.0, 0.9))
    assert made.findings == (f"the layout is {name}",)
    assert np.allclose(made.layout.positions_m, LAYOUT.positions_m, atol=4e-4)
    assert abs(made.sound_speed.speed_m_s - 343.8) < 0.5


def test_inverted_channel_gets_a_negative_gain_that_mends_the_image():
    item = echo()
    flipped = dataclasses.replace(item, data=item.data ^ np.uint32(1 << 4))
    gain = np.ones(32)
    gain[4] = -1.0
    array = dataclasses.replace(LAYOUT, gain=gain).to_array()
    right = Pipeline(item.settings).process(item)
    settings = item.settings.replace(array=array)
    mended = Pipeline(settings).process(dataclasses.replace(flipped, settings=settings))
    scale = float(right.amplitude.max())
    assert np.allclose(mended.amplitude, right.amplitude, atol=2e-3 * scale)


# ---- recordings -------------------------------------------------------------------------------------


def test_bad_recordings_are_left_out():
    silence = rendered(SENSOR.replace(emitter=Emitter(silent=True)))
    strange = reordered([plain()[0]], np.random.default_rng(0).permutation(32))[0]
    made = calibrate([*plain(), silence, strange])
    assert set(made.rejected) == {6, 7}
    assert not made.findings


def test_pcm_is_calibrated_too():
    sensor = SENSOR.replace(recording=Recording(encoding="int16", sample_rate_hz=450_000.0, n_samples=16_384))
    places = [(30, 20, 0.9), (-30, 10, 1.0), (10, -30, 0.8), (-20, -20, 1.2), (40, 0, 1.1), (0, 30, 0.9)]
    gain = np.ones(32)
    gain[3] = 1.2
    real = sensor.replace(array=dataclasses.replace(LAYOUT, gain=gain).to_array())
    heard = [
        rendered(real, points=(Point(azimuth_deg=az, elevation_deg=el, range_m=r, strength_db=-10.0),))
        for az, el, r in places
    ]
    made = calibrate(heard, LAYOUT)
    assert abs(made.gain_db[3] - made.gain_db.mean() - 20 * np.log10(1.2)) < 0.1
    assert not made.findings


def test_direct_sound_calibrates_gains_and_delays():
    rng = np.random.default_rng(5)
    gain, delay_s = 10 ** (rng.uniform(-2, 2, 32) / 20), rng.uniform(-4e-6, 4e-6, 32)
    emitter = Emitter(level_db=-30.0, direct_sound_db=-50.0, position_m=(0.0, 0.0, -0.06))
    sensor = SENSOR.replace(array=dataclasses.replace(LAYOUT, gain=gain, delay_s=delay_s).to_array(), emitter=emitter)
    made = calibrate([rendered(sensor)], LAYOUT, target="direct")
    wanted = 20 * np.log10(gain)
    assert np.sqrt(np.mean((made.gain_db - wanted + wanted.mean()) ** 2)) < 0.3
    assert made.residuals.after_s < 0.2 * made.residuals.before_s
    assert "positions" in made.not_observable[-1]
    assert abs(made.sound_speed.speed_m_s - 343.8) < 3 * made.sound_speed.sd_m_s


def test_walls_calibrate_delays():
    delay_s = np.zeros(32)
    delay_s[6] = 4e-6
    sensor = SENSOR.replace(array=dataclasses.replace(LAYOUT, delay_s=delay_s).to_array())
    angles = [(20, 0), (-20, 10), (0, -25), (10, 25), (-30, -10), (30, 15)]
    heard = [
        rendered(
            sensor,
            walls=(
                Wall(azimuth_deg=az, elevation_deg=el, range_m=0.9, facing_deg=(az - 180 if az > 0 else az + 180, -el)),
            ),
        )
        for az, el in angles
    ]
    made = calibrate(heard, LAYOUT, target="wall")
    assert abs(made.delay_s[6] - 4e-6) < 1e-6
    assert not made.findings


def test_real_recording_is_reported_and_says_that_it_does_not_suffice():
    path = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    real = Measurement(np.fromfile(path, dtype="<u4"), Settings.from_preset("default_25_50"))
    made = calibrate([real], target="direct")
    assert not made.findings
    assert made.residuals.before_s > made.residuals.after_s
    assert made.contrast_db[1] < made.contrast_db[0]  # therefore `ertis sensors calibrate` writes no layout
    with pytest.raises(DataError, match="not a single echo"):
        calibrate([real])


# ---- refusals ---------------------------------------------------------------------------------------


def test_unusable_recordings_are_refused_with_advice():
    silence = rendered(SENSOR.replace(emitter=Emitter(silent=True)))
    loud = rendered(SENSOR.replace(emitter=Emitter(level_db=30.0)), points=(Point(range_m=0.6, strength_db=0.0),))
    cases = {
        "no sound stands out.*place one small": [silence],
        "saturated.*lower the emission level": [loud],
        "cannot tell positions from delays.*at least 4": plain()[:3],
        "from one direction.*move the reflector": [echo(range_m=r) for r in (0.7, 0.8, 0.9, 1.0)],
    }
    for text, measurements in cases.items():
        with pytest.raises(DataError, match=text):
            calibrate(measurements)


def test_fixed_positions_need_no_other_direction():
    made = calibrate([echo(range_m=r) for r in (0.7, 0.9)], position_tolerance_m=0.0)
    assert np.all(made.moved_m == 0)
    assert not made.findings


def test_wrong_layout_is_refused_and_the_right_one_is_named():
    with pytest.raises(DataError, match="eRTIS_v3D1 does; use layout='eRTIS_v3D1'"):
        calibrate(plain(), "eRTIS_v2")
    strange = reordered(plain(), np.random.default_rng(1).permutation(32))
    with pytest.raises(DataError, match=r"does not fit the recordings.*choose the layout of this sensor"):
        calibrate(strange)
    with pytest.raises(ArgumentError, match="32 channels, but layout"):
        calibrate(plain(), dataclasses.replace(LAYOUT, enabled=np.ones(8, bool)))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"target": "moon"}, "reflector, wall, direct, beacon"),
        ({"delay_tolerance_s": 5.0}, "delay_tolerance_s"),
        ({"position_tolerance_m": -1.0}, "position_tolerance_m"),
        ({"first_place": (0.0, 100.0, 1.0)}, "elevation of the place"),
    ],
)
def test_foolish_arguments_are_refused(options, text):
    with pytest.raises(ArgumentError, match=text):
        calibrate(plain(), **options)
    with pytest.raises(ArgumentError, match="at least one recording"):
        calibrate([])


def test_wrong_target_is_refused_and_the_right_one_is_named():
    with pytest.raises(DataError, match=r"fit a reflector better than a wall.*use target=.reflector."):
        calibrate(plain(), target="wall")


def test_place_at_another_distance_is_refused():
    first = rendered(points=(Point(azimuth_deg=25.0, elevation_deg=-15.0, range_m=0.9, strength_db=-10.0),))
    with pytest.raises(DataError, match=r"range 3 m of the first place does not agree with the echo at 0\.90 m"):
        calibrate([first, *plain()], first_place=(25.0, -15.0, 3.0))
    made = calibrate([first, *plain()], first_place=(25.0, -5.0, 0.9))
    assert "mirrored layout, because the azimuth or elevation" in made.not_observable[-1]


def test_line_of_microphones_keeps_its_positions():
    places = [(30, 20, 0.9), (-30, 10, 1.0), (10, -30, 0.8), (-20, -20, 1.2)]
    sensor = SENSOR.replace(array=line_array(12, 0.005))
    made = calibrate(
        rendered(sensor, points=(Point(azimuth_deg=az, elevation_deg=el, range_m=r, strength_db=-10.0),))
        for az, el, r in places
    )
    assert not made.findings
    assert np.all(made.moved_m == 0)
    assert np.all(np.abs(made.delay_s) < 0.5e-6)


def test_wrong_place_is_refused():
    with pytest.raises(DataError, match="no mirrored layout explains"):
        calibrate(plain(), first_place=(-80.0, -60.0, 1.0))


# ---- models -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", TARGETS)
def test_derivatives_of_travel_times(target):
    rng = np.random.default_rng(2)
    source_m, places_m = rng.uniform(0.3, 1.0, (3, 3)), rng.uniform(-0.05, 0.05, (4, 3))
    model = travel_times(source_m, places_m, 343.0, target)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        by_source = travel_times(source_m + step, places_m, 343.0, target).time_s - model.time_s
        by_place = travel_times(source_m, places_m + step, 343.0, target).time_s - model.time_s
        assert np.allclose(by_source / 1e-6, model.by_source[..., axis], atol=1e-7)
        assert np.allclose(by_place / 1e-6, model.by_microphone[..., axis], atol=1e-7)


@pytest.mark.parametrize("position_m", [0.0, 1e-3])
def test_jacobian_of_the_fit(position_m):
    """The Jacobian omits a term that is proportional to the residuals, which are small here."""
    rng = np.random.default_rng(3)
    places_m, source_m = rng.uniform(-0.05, 0.05, (9, 3)), rng.uniform(0.5, 1.0, (6, 3))
    speed_m_s = np.linspace(343.0, 344.0, 6)
    sd_s = np.full((6, 9), 1e-8)
    sd_s[1, 3] = np.inf
    time_s = travel_times(source_m, places_m, speed_m_s, "reflector").time_s
    seen = Observations(time_s, sd_s, np.full(6, 1e-8), np.ones((6, 9)), sd_s)
    problem = SeparableProblem(
        seen, np.zeros(9), places_m, source_m, speed_m_s, "reflector", Tolerances(3.0, 5e-6, position_m)
    )
    at_mm = problem.start_mm + 1e-4 * rng.normal(size=18)
    slopes = problem.jacobian(at_mm)
    assert np.linalg.matrix_rank(slopes) == 18
    for index in range(18):
        step_mm = np.zeros(18)
        step_mm[index] = 1e-4
        numeric = (problem.residuals(at_mm + step_mm) - problem.residuals(at_mm - step_mm)) / 2e-4
        assert np.allclose(numeric, slopes[:, index], rtol=1e-4, atol=1e-3 * np.abs(slopes).max())


def test_covariance_is_the_inverse_of_the_whole_information():
    """The block elimination equals the dense inverse of all unknowns."""
    rng = np.random.default_rng(4)
    places_m, source_m = rng.uniform(-0.05, 0.05, (5, 3)), rng.uniform(0.5, 1.0, (7, 3))
    speed_m_s, sd_s = np.full(7, 343.0), rng.uniform(1e-8, 3e-8, (7, 5))
    model = travel_times(source_m, places_m, 343.0, "wall")
    seen = Observations(model.time_s, sd_s, np.full(7, 1e-8), np.ones((7, 5)), sd_s)
    problem = SeparableProblem(seen, np.zeros(5), places_m, source_m, speed_m_s, "wall", Tolerances(3.0, 5e-6, 1e-3))
    found, n_determined = problem.covariance(problem.start_mm, 1.0)
    rows = np.zeros((7, 5, 41))
    for mic in range(5):
        rows[:, mic, 4 * mic] = 1.0
        rows[:, mic, 4 * mic + 1 : 4 * mic + 4] = model.by_microphone[:, mic] * 1e3
    for number in range(7):
        rows[number, :, 20 + 3 * number : 23 + 3 * number] = model.by_source[number] * 1e3
    rows = (rows / (1e6 * sd_s)[..., None]).reshape(35, 41)
    prior = np.concatenate([np.tile([1 / 25, 1.0, 1.0, 1.0], 5), np.repeat(1e-6 / np.sum(source_m**2, axis=1), 3)])
    whole = np.linalg.inv(rows.T @ rows + np.diag(prior))
    assert np.allclose(found.reshape(20, 20), whole[:20, :20], rtol=1e-5, atol=1e-8)
    assert n_determined == pytest.approx(np.sum(whole * (rows.T @ rows)), rel=1e-4)


def test_swaps_of_one_or_two_recordings_are_not_judged():
    source_m = np.array([[1.0, 0.1, 0.0]])
    time_s = travel_times(source_m, LAYOUT.positions_m[::-1], 343.0, "reflector").time_s
    found = find_swaps(time_s, LAYOUT.positions_m, source_m, np.array([343.0]), "reflector")
    assert not found.cycles()


def echoes_of_points(positions_m, places_m, *, seed, n_samples=1600):
    """Return measurements of a point at some places, rendered from travel times without the simulation."""
    call = Call(start_frequency_hz=50e3, stop_frequency_hz=25e3, duration_s=2.5e-3, modulation="linear")
    settings = Settings(
        array=LAYOUT.to_array(),
        call=call,
        recording=Recording(encoding="float32", sample_rate_hz=192e3, n_samples=n_samples),
        processing=Processing(range_decimation=4),
    )
    draws, made = np.random.default_rng(seed), []
    for number, place_m in enumerate(places_m):
        path_m = np.linalg.norm(place_m) + np.linalg.norm(positions_m - place_m, axis=1)
        t_s = np.arange(n_samples)[:, None] / 192e3 - path_m / sound_speed_m_s(settings.air)
        shape = np.clip(np.minimum(t_s, 2.5e-3 - t_s) / 2.5e-4, 0, 1)
        sound = 0.3 * np.sin(2 * np.pi * (50e3 * t_s - 25e3 / 2.5e-3 * t_s**2 / 2)) * np.sin(np.pi / 2 * shape) ** 2
        data = (sound + 1e-3 * draws.standard_normal(sound.shape)).astype(np.float32)
        made.append(Measurement(data, settings, Stamp(sensor="a", sequence=number)))
    return made


@pytest.mark.parametrize(("scale", "is_found"), [(1.0, False), (1.05, False), (1.3, True)])
def test_scale_of_the_array_is_not_observable_but_compared_with_the_first_place(scale, is_found):
    draws = np.random.default_rng(5)
    true_m = scale * (LAYOUT.positions_m + np.array([0, 3e-4, 3e-4]) * draws.standard_normal((32, 3)))
    angles = np.radians(np.column_stack([draws.uniform(-45, 45, 12), draws.uniform(-35, 35, 12)]))
    angles[0] = np.radians([24.0, -20.0])
    places_m = draws.uniform(0.6, 1.1, (12, 1)) * unit_vectors(*angles.T)
    first = (24.0, -20.0, float(np.linalg.norm(places_m[0])))
    made = calibrate(echoes_of_points(true_m, places_m, seed=6), LAYOUT, first_place=first)
    assert any("the scale of the array: it remains that of the layout" in line for line in made.not_observable)
    assert abs(made.scale.ratio - scale) < 0.02
    assert [line for line in made.findings if "times as large as the layout" in line] == list(made.findings)
    assert bool(made.findings) == is_found
    # Intervals hold for the shape, without a shift and a scale.
    found_m = made.layout.positions_m - made.layout.positions_m.mean(axis=0)
    shape_m = true_m - true_m.mean(axis=0)
    error_m = found_m - shape_m * np.sum(found_m * shape_m) / np.sum(shape_m**2)
    if not is_found:
        assert np.all(np.abs(error_m) < 2 * made.position_sd_m)

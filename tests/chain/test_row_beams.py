"""Beams of rows: images and predicted errors of plans that sum the rows of an array first."""

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.planner import Planner, complete
from ertis_numba.chain.rows import aligned_axes, rows_of
from ertis_numba.chain.signal_model import signal_model_of
from ertis_numba.geometry import unit_vectors
from ertis_numba.settings import Accuracy, Array, Processing, Recording
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator
from tests import reference
from tests.error_cases import BEST
from tests.scenes import only

pytestmark = pytest.mark.usefixtures("sound_unchecked")

CPU = kernels.load("cpu")


def lattice(n_along, n_across, pitch_m=(3.9e-3, 3.9e-3), *, turned_deg=0.0, shift_m=0.0):
    """Positions in a plane, (mic, 2): every other row is shifted along itself."""
    along, across = np.meshgrid(np.arange(n_along) - (n_along - 1) / 2, np.arange(n_across) - (n_across - 1) / 2)
    x = along * pitch_m[0] + np.arange(n_across)[:, None] % 2 * shift_m
    places = np.stack([x.ravel(), across.ravel() * pitch_m[1]], axis=1)
    c, s = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))
    return places @ np.array([[c, s], [-s, c]])


def array_of(places):
    """Return an array in the plane x = 0."""
    return Array(layout="rows", positions_m=tuple((0.0, *place) for place in places.tolist()), word_bits=32)


def random_places(random):
    """Return a random lattice: turned, with shifted rows, and with missing microphones."""
    n_along, n_across = random.integers(6, 12, 2)
    pitch_m = random.uniform(2.5e-3, 6e-3, 2)
    shift_m = random.choice([0.0, 0.4]) * pitch_m[0]
    places = lattice(n_along, n_across, pitch_m, turned_deg=random.uniform(0, 180), shift_m=shift_m)
    return places[random.random(len(places)) > random.choice([0.0, 0.15])]


def scene(seed, *, wavefront):
    """Return a measurement of random echoes, with the settings of a random array."""
    random = np.random.default_rng(seed)
    range_m = random.uniform(0.3, 0.6) + np.array([0.0, 0.4])
    points = tuple(
        Point(
            azimuth_deg=float(random.uniform(-90, 90)),
            elevation_deg=float(random.uniform(-60, 60)),
            range_m=(far_m := float(random.uniform(range_m[0] - 0.05, range_m[1] + 0.05))),
            strength_db=float(random.uniform(-40, -6) + 40 * np.log10(far_m)),
        )
        for _ in range(random.integers(1, 12))
    )
    sensor = Sensor(
        array=array_of(random_places(random)),
        recording=Recording(n_samples=36_000),
        processing=Processing(
            directions=f"3d:{random.integers(150, 300)}", range_m=tuple(range_m.tolist()), wavefront=wavefront
        ),
        emitter=Emitter(level_db=-15.0),
        electronics=Electronics(noise_dbfs=float(random.uniform(-70, -25)) if random.random() < 0.5 else None),
    )
    simulator = Simulator(
        Scene(seed=seed, sensors=(sensor,), points=points), plan=only("spreading", "microphone_noise")
    )
    return simulator.render(), sensor.settings()


def image_of(measurement, settings, device="cpu", threads=1):
    chain = FastChain(settings, kernels.load(device), threads=threads)
    image = np.full((len(chain.grid), len(chain.range_m)), np.nan, dtype=np.float32)
    chain.process(measurement.data.reshape(len(measurement.data), -1), image)
    return image, chain


def measured_db(measurement, settings, n_directions=16):
    """Return the error of an image relative to a float64 reference, in some directions."""
    image, chain = image_of(measurement, settings)
    some = np.linspace(0, len(image) - 1, n_directions).astype(int)
    directions = unit_vectors(chain.grid.azimuth_rad[some], chain.grid.elevation_rad[some])
    exact = reference.exact(measurement.data, settings, directions, chain.range_m)
    return reference.error_db(image[some], exact)


def nearly_exact(measurement, settings):
    """Return the image of a plan whose error `tests.chain.test_accuracy` and `test_zones` compare with float64."""
    return image_of(measurement, settings.replace(accuracy=BEST.replace(focal_zones=40)))[0]


@pytest.mark.parametrize("wavefront", ["plane", "spherical"])
@pytest.mark.parametrize("seed", range(3))
def test_predicted_error_of_row_beams_matches_random_scenes(seed, wavefront):
    measurement, settings = scene(seed, wavefront=wavefront)
    budget_db = (-25.0, -35.0, -45.0)[seed % 3]
    plan = complete(settings.replace(accuracy=Accuracy(max_error_db=budget_db, row_beams=True)), CPU, threads=1)
    model = signal_model_of(measurement, plan, CPU)
    predicted_db = Planner(plan, CPU, threads=1, signal_model=model).error_db(plan.accuracy)
    found_db = reference.error_db(image_of(measurement, plan)[0], nearly_exact(measurement, plan))
    assert found_db < budget_db
    # Errors of both steps are added, although the beam grid averages some of them.
    assert -1.0 < predicted_db - found_db < 6.0


def test_error_of_row_beams_matches_a_float64_reference():
    measurement, settings = scene(1, wavefront="plane")
    plan = complete(settings.replace(accuracy=Accuracy(max_error_db=-45.0, row_beams=True)), CPU, threads=1)
    assert measured_db(measurement, plan) < -45.0


def test_planner_chooses_row_beams_for_a_grid_of_many_microphones():
    settings = array_settings(lattice(32, 32))
    chosen = Planner(settings, CPU, threads=2).choose()
    assert chosen.settings.accuracy.row_beams is True
    without = settings.replace(accuracy=settings.accuracy.replace(row_beams=False))
    assert chosen.time_ms < 0.4 * Planner(without, CPU, threads=2).choose().time_ms
    assert complete(chosen.settings, CPU, threads=2) == chosen.settings


def array_settings(places, **processing):
    given = {"directions": "3d:3000", "range_m": (0.5, 2.0), "wavefront": "plane", **processing}
    settings = scene(0, wavefront="plane")[1]
    return settings.replace(
        array=array_of(places), recording=Recording(n_samples=80_000), processing=Processing(**given)
    )


@pytest.mark.parametrize("device", ["numpy", "cpu"])
def test_row_beams_are_alike_on_all_devices_and_numbers_of_threads(device):
    measurement, settings = scene(4, wavefront="spherical")
    plan = complete(settings.replace(accuracy=Accuracy(row_beams=True)), CPU, threads=1)
    one, _ = image_of(measurement, plan)
    other, _ = image_of(measurement, plan, device, threads=min(2, CPU.max_threads) if device == "cpu" else 1)
    if device == "cpu":
        assert one.tobytes() == other.tobytes()
    else:
        assert reference.error_db(other, one) < -60


@pytest.mark.parametrize("turned_deg", [0.0, 30.0, 117.3])
def test_rows_of_a_turned_grid_with_missing_microphones_are_found(turned_deg):
    places = lattice(12, 9, (4e-3, 5e-3), turned_deg=turned_deg)
    places = places[np.random.default_rng(1).random(len(places)) > 0.2]
    axes = aligned_axes(places)
    assert axes @ axes.T == pytest.approx(np.eye(2), abs=1e-12)
    rows = rows_of(places @ axes.T)
    assert rows is not None
    assert len(rows) == 9
    assert rows.deviation_m < 1e-9
    assert np.ptp(places @ axes.T, axis=0) == pytest.approx([0.044, 0.04], abs=1e-9)


def test_random_positions_have_no_rows_and_keep_their_axes():
    places = np.random.default_rng(1).normal(size=(256, 2))
    assert (aligned_axes(places) == np.eye(2)).all()
    assert rows_of(places) is None
    assert not Planner(array_settings(places * 0.02), CPU, threads=1).choose().settings.accuracy.row_beams


@pytest.mark.parametrize(
    "changes",
    [
        {"level_directions": True},
        {"weighting": "coherence_factor"},
        {"beamformer": "dmas"},
    ],
)
def test_row_beams_are_refused_without_fixed_directions_or_delay_and_sum(changes):
    settings = array_settings(lattice(12, 12), **changes)
    with pytest.raises(ArgumentError, match=r"accuracy\.row_beams is true, which needs delay_and_sum"):
        Planner(settings.replace(accuracy=Accuracy(row_beams=True)), CPU, threads=1)
    assert Planner(settings, CPU, threads=1).choose().settings.accuracy.row_beams is None


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ({"precision": "float32"}, "needs accuracy.precision 'int16'"),
        ({"beam_taps": 0}, "needs accuracy.precision 'int16'"),
        ({"delay_taps": 0}, "accuracy.row_beams is True, but accuracy.delay_taps 0"),
    ],
)
def test_accuracy_refuses_row_beams_with_other_kernels(given, found):
    with pytest.raises(ArgumentError, match=found):
        Accuracy(row_beams=True, **given)


@pytest.mark.parametrize("directions", ["2d:1", "2d:3", "3d:90"])
@pytest.mark.parametrize("encoding", ["pdm", "int16"])
def test_row_beams_of_few_directions_are_exact(directions, encoding):
    """One direction straight ahead, and directions at ±90°."""
    random = np.random.default_rng(1)
    settings = array_settings(lattice(9, 8), directions=directions, range_m=(0.5, 1.0))
    recording = (
        Recording(n_samples=40_000)
        if encoding == "pdm"
        else Recording(sample_rate_hz=450_000.0, n_samples=4_000, encoding=encoding)
    )
    rates = {} if encoding == "pdm" else {"decimation": 1, "range_decimation": 10}
    data = random.integers(0, 2**32, (40_000, 3), dtype=np.uint32)
    if encoding == "int16":
        data = random.integers(-9000, 9000, (4_000, 72)).astype(np.int16)
    settings = settings.replace(
        recording=recording,
        accuracy=Accuracy(row_beams=True),
        processing=settings.processing.replace(**rates),
    )
    plan = complete(settings, CPU, threads=1)

    class Noise:
        pass

    noise = Noise()
    noise.data = data
    assert measured_db(noise, plan) < -35

"""Point clouds of images with known reflectors, and comparison with a straightforward reference."""

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.analysis import point_finder
from ertis_numba.analysis.detect import find_peaks, neighbours_of
from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.analysis.points import EchoPointExtractor, PointExtractor
from ertis_numba.analysis.range_cleaning import clean
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain import planner
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air, Array, Call, Processing, Recording, Settings
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from ertis_numba.simulation import Point, Scene, Sensor
from tests.analysis.test_detect import image_of
from tests.cases import noise as words_of_noise
from tests.parabolas import edge_floor, interpolated
from tests.scenes import heard

PLAIN = [("fast", "delay_and_sum", "none"), ("paper", "delay_and_sum", "none")]
OTHERS = [("fast", *combination) for combination in ADAPTIVE_COMBINATIONS]


def noise(directions, range_m=(0.9, 1.2), seed=1, method="fast"):
    image = of_method(image_of([], directions=directions, range_m=range_m), method)
    values = np.abs(np.random.default_rng(seed).standard_normal(image.amplitude.shape)) + 0.01
    return image.replace(amplitude=values.astype(np.float32))


def of_method(image, method):
    """Image with the same amplitudes; those of the method of the paper are interpolated by parabolas only."""
    settings = image.settings
    return image.replace(settings=settings.replace(processing=settings.processing.replace(method=method)))


def position_m(azimuth_deg, elevation_deg, range_m):
    return range_m * unit_vectors(np.radians(azimuth_deg), np.radians(elevation_deg))


def reference(image, *, top, min_level_db):
    """Extract the points of an image bin by bin."""
    energy, spacing_m = image.amplitude, image.range_m[1] - image.range_m[0]
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    neighbours = neighbours_of(directions)
    reach, found, floor = round(0.04 / spacing_m), [], edge_floor(image, directions)
    for direction, range_index in np.ndindex(energy.shape):
        here = energy[direction, range_index]
        if not 0 < range_index < energy.shape[1] - 1 or here < energy.max() * np.float32(10 ** (min_level_db / 20)):
            continue
        if here < floor[range_index]:
            continue
        row = energy[direction, range_index - 1 : range_index + 2]
        if not row[0] <= here > row[2]:
            continue
        side_lobes = energy[:, max(0, range_index - reach) : range_index + reach + 1].max() * np.float32(10**-0.5)
        around = [(energy[other, range_index], -other) for other in neighbours[direction] if other != direction]
        if here >= side_lobes and all((here, -direction) > other for other in around):
            found.append((here, direction, range_index))
    found.sort(key=lambda entry: -entry[0])
    points = []
    for _, direction, range_index in found[:top]:
        unit, at_m, amplitude = interpolated(image, directions, neighbours[direction], direction, range_index)
        points.append((*(at_m * unit), amplitude))
    points = np.array(points, dtype=np.float32).reshape(-1, 4)
    return points[np.argsort(-points[:, 3], kind="stable")]


@pytest.mark.parametrize("directions", ["2d:181", "3d:400", "3d:2", "2d:1"])
@pytest.mark.parametrize("min_level_db", [-3.0, -20.0])
def test_point_extractor_equals_the_reference(directions, min_level_db):
    image = noise(directions, method="paper")
    expected = reference(image, top=80, min_level_db=min_level_db)
    cloud = PointExtractor(image.settings, top=80, min_level_db=min_level_db, false_alarm=None)(image)
    assert len(expected) > 2
    np.testing.assert_allclose(cloud.position_m, expected[:, :3], atol=1e-5)
    np.testing.assert_allclose(cloud.amplitude, expected[:, 3], rtol=1e-5)
    assert cloud.position_m.dtype == cloud.amplitude.dtype == np.float32
    assert cloud.settings is image.settings
    assert cloud.stamp is image.stamp
    assert cloud.uncertainty_m.shape == (len(cloud), 2)
    assert cloud.uncertainty_m.dtype == np.float32


def test_strongest_peaks_of_noise_are_found():
    image = noise("3d:800", method="paper")
    cloud = PointExtractor(image.settings, top=10, false_alarm=None)(image)
    assert np.count_nonzero(image.amplitude > image.amplitude.max() / 10) > 640  # Only some are examined.
    expected = reference(image, top=10, min_level_db=-20.0)
    np.testing.assert_allclose(cloud.position_m, expected[:, :3], atol=1e-5)
    np.testing.assert_allclose(cloud.amplitude, expected[:, 3], rtol=1e-5)


def test_first_of_two_equal_bins_is_the_peak():
    image = noise("2d:31").replace(amplitude=np.zeros(noise("2d:31").amplitude.shape, np.float32))
    image.amplitude[10:12, 40] = 1.0
    (point,) = PointExtractor(image.settings)(image).position_m
    assert np.arctan2(point[1], point[0]) == pytest.approx(image.azimuth_rad[10:12].mean(), abs=1e-3)


@pytest.mark.parametrize(("directions", "within_m"), [("2d:181", 1e-3), ("3000", 0.01)])
def test_points_lie_at_the_reflectors(directions, within_m):
    reflectors = [(12.3, 0.0, 1.0, 1.0), (-33.3, 0.0, 1.1, 0.5), (50.1, 0.0, 1.25, 0.4)]
    image = image_of(reflectors, directions=directions, range_m=(0.9, 1.4), noise=0.001)
    cloud = PointExtractor(image.settings)(image)
    assert len(cloud) == len(reflectors)
    for point, energy, (azimuth_deg, elevation_deg, range_m, amplitude) in zip(
        cloud.position_m, cloud.amplitude, reflectors, strict=True
    ):
        assert np.linalg.norm(point - position_m(azimuth_deg, elevation_deg, range_m)) < within_m
        assert energy == pytest.approx(amplitude, rel=0.05)


def test_point_extractor_agrees_with_find_peaks():
    image = image_of([(12.3, 5, 1.0, 1.0), (-33.3, -20, 1.2, 0.5)], directions="3000", range_m=(0.9, 1.3))
    peaks = find_peaks(image, min_level_db=-20)
    cloud = PointExtractor(image.settings)(image)
    expected = [position_m(peak.azimuth_deg, peak.elevation_deg, peak.range_m) for peak in peaks]
    np.testing.assert_allclose(cloud.position_m, expected, atol=1e-5)


def test_point_cloud_is_limited_by_top_and_level():
    image = image_of([(-40, 0, 0.95, 0.5), (3, 0, 1.3, 1.0), (50, 0, 1.1, 0.2)])
    assert len(PointExtractor(image.settings, top=2)(image)) == 2
    assert len(PointExtractor(image.settings, min_level_db=-10.0)(image)) == 2
    assert len(PointExtractor(image.settings)(image)) == 3


@pytest.mark.parametrize("n_ranges", [1, 2, 3, 30])
def test_silence_and_short_images_have_no_points(n_ranges):
    image = noise("2d:5")
    short = image.replace(amplitude=np.zeros((5, n_ranges), np.float32), range_m=image.range_m[:n_ranges])
    extractor = PointExtractor(image.settings)
    cloud = extractor(short)
    assert cloud.position_m.shape == (0, 3)
    assert cloud.uncertainty_m.shape == (0, 2)
    assert len(cloud) == 0
    ramp = np.broadcast_to(np.arange(1, n_ranges + 1, dtype=np.float32), (5, n_ranges)).copy()
    assert len(extractor(short.replace(amplitude=ramp))) == 0  # A maximum at the end of the range axis is not a peak.


def test_point_extractor_leaves_its_input_unchanged():
    image = noise("3d:100")
    before = image.amplitude.copy()
    image.amplitude.flags.writeable = False
    PointExtractor(image.settings)(image)
    np.testing.assert_array_equal(image.amplitude, before)


def test_platform_frame_rotates_then_translates():
    half = np.sqrt(0.5)
    cloud = PointCloud(
        np.array([[2, 0, 0], [0, 1, 3]], np.float32),
        np.ones(2, np.float32),
        Settings(),
        translation_m=(10.0, 20.0, 30.0),
        rotation_xyzw=(0.0, 0.0, half, half),  # A quarter turn to the left.
    )
    np.testing.assert_allclose(cloud.on_platform_m(), [[10, 22, 30], [9, 20, 33]], atol=1e-5)
    assert cloud.uncertainty_m is None  # Images received over the network have none.
    np.testing.assert_array_equal(cloud.replace(rotation_xyzw=(0, 0, 0, 1)).on_platform_m()[0], [12, 20, 30])


@pytest.mark.parametrize(
    ("arguments", "match"),
    [({"top": 0}, "top is 0; use a whole number of at least 1"), ({"min_level_db": 3.0}, "min_level_db is 3")],
)
def test_point_extractor_refuses_invalid_arguments(arguments, match):
    with pytest.raises(ArgumentError, match=match):
        PointExtractor(Settings(), **arguments)


def test_point_extractor_refuses_an_image_of_another_grid():
    other = Settings(processing=Processing(directions="2d:7"))
    assert len(direction_grid(other.processing)) == 7
    with pytest.raises(ArgumentError, match="amplitude has shape"):
        PointExtractor(other)(noise("2d:9"))


@pytest.mark.parametrize("directions", ["2d:61", "3d:500"])
def test_uncertainty_is_the_spread_of_noisy_measurements(directions):
    """40 measurements of one echo with noise 30 dB below it agree within a factor of 1.5; chance explains 1.25."""
    sensor = Sensor(
        recording=Recording(sample_rate_hz=450e3, n_samples=4_096, encoding="float32"),
        processing=Processing(
            directions=directions,
            range_decimation=10,
            azimuth_limits_deg=(-10.0, 40.0),
            elevation_limits_deg=(-20.0, 25.0),
            range_m=(0.6, 1.1),
        ),
    )
    scene = Scene(seed=1, sensors=(sensor,), points=(Point(azimuth_deg=14.3, elevation_deg=0.0, range_m=0.903),))
    quiet = heard(scene, "spreading", "absorption")
    settings = planner.complete(sensor.settings(), kernels.load("cpu"), threads=2)
    chain, extractor = FastChain(settings, kernels.load("cpu"), threads=2), PointExtractor(settings)
    grid, rng = direction_grid(settings.processing), np.random.default_rng(2)
    loudness = 2.5 * np.abs(quiet).max()
    positions, predicted = [], []
    for _ in range(40):
        energy = chain.new_image()
        chain.process_signals(quiet + loudness * rng.standard_normal(quiet.shape, dtype=np.float32), energy)
        cloud = extractor(Energyscape(energy, grid.azimuth_rad, grid.elevation_rad, chain.range_m, settings))
        positions.append(cloud.position_m[0].astype(float))
        predicted.append(cloud.uncertainty_m[0])
    positions, (along_m, across_m) = np.array(positions), np.mean(predicted, axis=0)
    middle = positions.mean(axis=0)
    assert middle == pytest.approx(position_m(14.3, 0.0, 0.903), abs=0.01)
    forward = middle / np.linalg.norm(middle)
    found_along_m = np.std(positions @ forward, ddof=1)
    sideways = positions - np.outer(positions @ forward, forward)
    found_across_m = np.sqrt(np.linalg.eigvalsh(np.cov(sideways.T))[-1])  # Along the axis with the largest spread.
    assert 1 / 1.5 < found_along_m / along_m < 1.5
    assert 1 / 1.5 < found_across_m / across_m < 1.5
    assert 2e-5 < along_m < 5e-4 < across_m < 1e-2


def test_uncertainty_depends_on_range_level_and_noise():
    image = image_of([(12.3, 0.0, 1.0, 1.0), (-33.3, 0.0, 1.2, 0.5)], range_m=(0.9, 1.4), noise=0.01)
    extractor = EchoPointExtractor(image.settings, min_level_db=-8.0)
    first, second, *_ = extractor(image).uncertainty_m
    assert second[0] == pytest.approx(2 * first[0], rel=0.05)  # The second reflector has half the amplitude.
    # The uncertainty also grows with range and with the foreshortening of the aperture.
    ratio = 2 * 1.2 * np.cos(np.radians(12.3)) / np.cos(np.radians(33.3))
    assert second[1] == pytest.approx(ratio * first[1], rel=0.05)
    louder = image.replace(amplitude=np.where(image.amplitude < 0.1, 2 * image.amplitude, image.amplitude))
    assert np.median(image.amplitude) < 0.1
    assert extractor(louder).uncertainty_m[0] == pytest.approx(2 * first, rel=1e-3)


@pytest.mark.parametrize(("method", "beamformer", "weighting"), [*PLAIN, *OTHERS])
def test_noise_is_estimated_by_the_median_for_delay_and_sum_only(method, beamformer, weighting):
    """The median of Rayleigh-distributed amplitudes is √ln 2 times their root mean square."""
    settings = Settings(
        recording=Recording(n_samples=65_536),
        processing=Processing(
            directions="2d:9", range_m=(0.3, 2.0), method=method, beamformer=beamformer, weighting=weighting
        ),
    )
    with Pipeline(settings, device="numpy", predict=False) as pipeline:  # noise may exceed the budget of DMAS
        image = pipeline.process(words_of_noise(settings, 1))
    ratio = np.median(image.amplitude) / np.sqrt(np.mean(np.square(image.amplitude, dtype=float)))
    is_rayleigh = not settings.processing.is_adaptive
    assert (ratio == pytest.approx(np.sqrt(np.log(2)), rel=0.02)) == is_rayleigh
    uncertainty_m = PointExtractor(settings, false_alarm=None)(image).uncertainty_m
    assert len(uncertainty_m) > 3
    assert (np.isnan(uncertainty_m) != (is_rayleigh and method == "fast")).all()


def test_uncertainty_is_nan_without_noise():
    """A cleaned image has no noise, and an uncertainty of 0 would claim exact positions."""
    image = image_of([(12.3, 0.0, 1.0, 1.0), (-33.3, 0.0, 1.2, 0.5)], range_m=(0.9, 1.4), noise=0.01)
    cloud = PointExtractor(image.settings)(clean(image))
    assert len(cloud) > 1
    assert np.isnan(cloud.uncertainty_m).all()


@pytest.mark.parametrize(
    ("positions_m", "directions", "is_finite"),
    [
        (((0.0, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.02, 0.0)), "2d:31", False),
        (((0.0, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.02)), "2d:31", True),
        (((0.0, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.02, 0.0)), "3d:99", False),
        (((0.0, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.02)), "3d:99", True),
    ],
)
def test_uncertainty_is_infinite_along_unresolved_angles(positions_m, directions, is_finite):
    image = noise(directions)
    settings = image.settings.replace(array=Array(layout="few", positions_m=positions_m, word_bits=8))
    cloud = PointExtractor(settings, false_alarm=None)(image.replace(settings=settings))
    uncertainty_m = cloud.uncertainty_m[cloud.position_m[:, 0] > 0.1]  # An array seen from the side has no aperture.
    assert len(uncertainty_m) > 2
    assert np.isfinite(uncertainty_m[:, 0]).all()
    assert np.isfinite(uncertainty_m[:, 1]).all() == is_finite


def few_points():
    return image_of([(12.3, 0.0, 1.0, 1.0), (-33.3, 0.0, 1.2, 0.5)], range_m=(0.9, 1.4), noise=0.01)


@pytest.mark.parametrize(
    "changes",
    [
        {"call": Call(start_frequency_hz=90e3, stop_frequency_hz=20e3)},
        {"array": Array(layout="uRTIS_v1")},
        {"air": Air(temperature_c=35.0)},
        {"processing": Processing(directions="2d:181", beamformer="dmas")},
    ],
    ids=["call", "array", "air", "beamformer"],
)
def test_point_finder_follows_changed_settings(changes):
    image = few_points()
    changed = image.replace(settings=image.settings.replace(**changes))
    find = PointFinder(top=2)
    for each in (image, changed, image):
        wanted, found = PointExtractor(each.settings, top=2)(each), find(each)
        np.testing.assert_array_equal(found.position_m, wanted.position_m)
        np.testing.assert_array_equal(found.uncertainty_m, wanted.uncertainty_m)
    assert find(changed).settings is changed.settings


def test_point_finder_uses_the_directions_of_each_sensor():
    image, other = few_points(), noise("3d:60")
    find = PointFinder()
    for each in (image, other, other.replace(stamp=Stamp(sensor="other")), image):
        np.testing.assert_array_equal(find(each).position_m, PointExtractor(each.settings)(each).position_m)


def test_point_finder_computes_tables_once_per_sensor(monkeypatch):
    made = []
    monkeypatch.setattr(point_finder, "PointExtractor", lambda *given: made.append(given) or PointExtractor(*given))
    find, image = PointFinder(), few_points()
    warmer = image.settings.replace(air=Air(temperature_c=35.0))
    for sensor in ("front", "left", "front", "left"):
        find(image.replace(stamp=Stamp(sensor=sensor)))
        find(image.replace(stamp=Stamp(sensor=sensor), settings=warmer, azimuth_rad=image.azimuth_rad.copy()))
    assert len(made) == 2


def test_point_positions_follow_the_axes_of_rep_103():
    """REP 103: x points forward, y left and z up; positive azimuth is to the left."""
    reflectors = [(0.0, 0.0, 1.0, 1.0), (60.0, 0.0, 1.1, 1.0), (0.0, 45.0, 1.2, 1.0)]
    image = image_of(reflectors, directions="3000", range_m=(0.9, 1.3))
    found = PointExtractor(image.settings)(image).position_m
    for wanted in ([1, 0, 0], [0.55, 0.953, 0], [0.849, 0, 0.849]):
        assert np.min(np.linalg.norm(found - wanted, axis=1)) < 0.02

"""Sources and reflectors beyond the limits of a grid: none is listed inside with a small error."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.analysis.detect import peaks_of_grid
from ertis_numba.analysis.outside_grid import OutsidePatterns
from ertis_numba.analysis.peak_notes import list_notes
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.frames import AcousticMap, Energyscape
from ertis_numba.geometry import Grid, direction_grid, unit_vectors
from ertis_numba.passive.sound_sources import sources_of_grid
from ertis_numba.settings import Call, Processing
from ertis_numba.simulation import Point, Scene, Sensor
from tests.random_sounds import C_M_S, map_power, settings_of

METHODS = ("delay_and_sum", "functional", "capon", "music")
LIMITS = {"azimuth_limits_deg": (-40.0, 30.0), "elevation_limits_deg": (-25.0, 25.0)}
INSIDE = [(10.0, 5.0), (-30.0, -12.0), (22.0, 17.0)]
OUTSIDE = [(45.0, 5.0), (60.0, -10.0), (-58.0, 15.0), (5.0, 48.0), (-20.0, -60.0), (34.0, 0.0)]


def places(count=24, size_m=0.12):
    turn, radius_m = 2.4 * np.arange(count), size_m / 2 * np.sqrt((np.arange(count) + 0.5) / count)
    return np.round(np.stack([0.01 * np.cos(5 * turn), radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1), 6)


def towards_of(azimuth_deg, elevation_deg):
    return unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))[0]


def tone_map(method, azimuth_deg, elevation_deg, directions="3d:400", frequency_hz=12e3):
    """Map of a plane wave in white noise, in closed form."""
    settings = settings_of(places(), {"directions": directions, **LIMITS})
    settings = settings.replace(passive=settings.passive.replace(method=method))
    grid = direction_grid(settings.processing)
    places_m = places() - places().mean(axis=0)
    wave_1_m = 2 * np.pi * frequency_hz / C_M_S
    heard = np.exp(1j * wave_1_m * places_m @ towards_of(azimuth_deg, elevation_deg))
    matrix = np.outer(heard, heard.conj()) + 0.03 * np.eye(len(places_m))
    waves = np.exp(1j * wave_1_m * unit_vectors(grid.azimuth_rad, grid.elevation_rad) @ places_m.T)
    power = map_power(waves, matrix, method, settings.passive.functional_order, removed=False)
    band_hz = np.array([[frequency_hz - 1, frequency_hz + 1]])
    return AcousticMap(power[:, None].astype(np.float32), grid.azimuth_rad, grid.elevation_rad, band_hz, settings)


def echo_image(azimuth_deg, elevation_deg, range_m=0.8):
    """Image of an echo as a plane wave: the sum over the band in closed form.

    The power of a hyperbolic call is inversely proportional to the square of the frequency; its ends are faded.
    """
    settings = settings_of(places(), {"directions": "3d:400", "range_m": (0.4, 1.2), **LIMITS})
    settings = settings.replace(call=Call(start_frequency_hz=16e3, stop_frequency_hz=8e3))
    grid = direction_grid(settings.processing)
    places_m = places() - places().mean(axis=0)
    ranges_m = np.arange(0.4, 1.2, 0.005)
    away = unit_vectors(grid.azimuth_rad, grid.elevation_rad) - towards_of(azimuth_deg, elevation_deg)
    wave_1_m = 2 * np.pi * np.linspace(8e3, 16e3, 81) / C_M_S
    shares = np.hanning(83)[1:-1] ** 0.5 / wave_1_m**2
    shares /= shares.sum()
    beams = np.exp(1j * (away @ places_m.T)[..., None] * wave_1_m).mean(axis=1)
    amplitude = np.abs((beams * shares) @ np.exp(-2j * wave_1_m[:, None] * (ranges_m - range_m)))
    return Energyscape(amplitude.astype(np.float32), grid.azimuth_rad, grid.elevation_rad, ranges_m, settings)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", OUTSIDE)
def test_sources_beyond_the_limits_have_an_unknown_direction(method, place):
    sources = sources_of_grid(tone_map(method, *place))
    assert sources
    assert all(math.isinf(each.grid_error_rad) for each in sources)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", INSIDE)
def test_sources_inside_have_a_known_direction(method, place):
    loudest = sources_of_grid(tone_map(method, *place))[0]
    found = unit_vectors(np.array([loudest.azimuth_rad]), np.array([loudest.elevation_rad]))[0]
    assert math.isfinite(loudest.grid_error_rad)
    assert np.degrees(np.arccos(min(1.0, found @ towards_of(*place)))) < 1.5


@pytest.mark.parametrize(("azimuth_deg", "is_known"), [(10.0, True), (45.0, False), (-60.0, False)])
def test_planar_grids_are_examined_along_their_circle(azimuth_deg, is_known):
    sources = sources_of_grid(tone_map("delay_and_sum", azimuth_deg, 0.0, "2d:60"))
    assert sources
    assert all(math.isfinite(each.grid_error_rad) == is_known for each in sources)


@pytest.mark.parametrize("place", [*INSIDE, *OUTSIDE])
def test_reflectors_beyond_the_limits_have_an_unknown_direction(place):
    image = echo_image(*place)
    peaks = peaks_of_grid(image)
    cloud = PointExtractor(image.settings, Grid(image.azimuth_rad, image.elevation_rad))(image)
    across_rad = cloud.uncertainty_m[:, 1] / np.linalg.norm(cloud.position_m, axis=1)
    if place in INSIDE:
        found = towards_of(peaks[0].azimuth_deg, peaks[0].elevation_deg)
        assert np.degrees(np.arccos(min(1.0, found @ towards_of(*place)))) < 1.5
        assert math.isfinite(peaks[0].grid_error_deg)
        assert across_rad[0] < 0.1
    else:
        assert peaks
        assert all(math.isinf(peak.grid_error_deg) for peak in peaks)
        assert len(across_rad)
        assert (across_rad > 0.5).all()
        (note,) = (each for each in list_notes([(image, peaks)], false_alarm=None) if "beyond the edges" in each)
        assert note.startswith(f"{len(peaks)} listed direction")


def test_grids_of_all_distinguishable_directions_have_no_outside():
    """Sound from behind a plane array equals that from ahead."""
    half = unit_vectors(*(angles.ravel() for angles in np.radians(np.mgrid[-90:91:10, -80:81:10])))
    plane_m = places() * (0, 1, 1)

    def delays(towards):
        return -towards @ plane_m.T / C_M_S

    assert OutsidePatterns.of(half, delays, np.array([12e3])) is None
    assert OutsidePatterns.of(half[:5], delays, np.array([12e3])) is None
    found = OutsidePatterns.of(half[half[:, 1] < 0], delays, np.array([12e3]))
    assert (found.places[:, 1] > -0.2).all()  # Between the last elevation and the pole, azimuths meet.
    assert found.source_of(np.ones(len(found.samples))) is None


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "directions"),
    [(50.0, 0.0, "2d:61"), (70.0, 0.0, "2d:61"), (14.2, -27.5, "3d:600")],
)
def test_side_lobes_of_simulated_reflectors_beyond_the_limits_have_an_unknown_direction(
    azimuth_deg, elevation_deg, directions
):
    """Beams of eRTIS are narrow, and its call has most power at low frequencies."""
    processing = Processing(
        directions=directions,
        azimuth_limits_deg=(-30.0, 30.0),
        elevation_limits_deg=(-15.0, 15.0),
        range_m=(0.5, 2.0),
    )
    point = Point(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, range_m=1.5, strength_db=-10.0)
    measurement = ertis.render(Scene(seed=3, sensors=(Sensor(processing=processing),), points=(point,)), 0)
    with ertis.Pipeline(measurement.settings) as pipeline:
        peaks = peaks_of_grid(pipeline.process(measurement))
    assert peaks
    assert all(math.isinf(peak.grid_error_deg) for peak in peaks)

"""Small measurements and images, shared by the tests of storage, figures and command line."""

import numpy as np

from ertis_numba.frames import Energyscape, Measurement, Stamp
from ertis_numba.settings import Array, Processing, Recording, Settings
from ertis_numba.simulation import Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator

SMALL = Settings(
    recording=Recording(n_samples=40_960),
    processing=Processing(directions="2d:7", range_m=(0.4, 0.9), wavefront="plane"),
)


def line(n_channels, word_bits):
    """Settings with a line array."""
    positions_m = tuple((0.0, 0.004 * channel, 0.0) for channel in range(n_channels))
    return SMALL.replace(array=Array(layout="line", positions_m=positions_m, word_bits=word_bits))


def echoes(settings=SMALL, count=3, places=((0.0, 0.55), (30.0, 0.65), (-30.0, 0.8))):
    """Measurements of reflectors at azimuths in degrees and ranges in metres."""
    sensor = Sensor(array=settings.array, recording=settings.recording, processing=settings.processing)
    points = tuple(Point(position_m=point_m(*place)) for place in places)
    simulator = Simulator(Scene(sensors=(sensor,), points=points))
    return [
        Measurement(simulator.render(index).data, settings, each.stamp)
        for index, each in enumerate(noise(settings, count))
    ]


def point_m(azimuth_deg, range_m):
    angle = np.radians(azimuth_deg)
    return range_m * np.cos(angle), range_m * np.sin(angle), 0.0


def noise(settings=SMALL, count=3, seed=1):
    """Measurements of noise with different stamps."""
    array = settings.array
    n_words = -(-len(array.positions_m or range(32)) // array.word_bits)
    shape = (settings.recording.n_samples, n_words)[: 1 + (n_words > 1)]
    rng = np.random.default_rng(seed)
    return [
        Measurement(
            rng.integers(0, 2**array.word_bits, shape, dtype=f"u{array.word_bits // 8}"),
            settings,
            Stamp(
                sensor="eRTIS-7",
                sequence=10 + index,
                sync_count=200 + index,
                timestamp_ns=1_700_000_000_123_456_789 + 50_000_000 * index,
                timestamp_uncertainty_ns=400 + index,
            ),
        )
        for index in range(count)
    ]


def image(azimuth_deg=None, elevation_deg=None, *, range_m=None, seed=1, settings=SMALL):
    """An energyscape of speckle with one bright point."""
    azimuth_deg = np.linspace(-90, 90, 37) if azimuth_deg is None else np.asarray(azimuth_deg, dtype=float)
    elevation_deg = np.zeros_like(azimuth_deg) if elevation_deg is None else np.asarray(elevation_deg, dtype=float)
    range_m = np.linspace(0.5, 5.0, 400) if range_m is None else np.asarray(range_m, dtype=float)
    rng = np.random.default_rng(seed)
    amplitude = (0.002 * rng.rayleigh(size=(len(azimuth_deg), len(range_m)))).astype(np.float32)
    amplitude[len(azimuth_deg) // 2, len(range_m) // 2] = 0.5
    return Energyscape(amplitude, np.radians(azimuth_deg), np.radians(elevation_deg), range_m, settings)


def with_echoes(made):
    """An image with one more bright point per direction."""
    amplitude = made.amplitude.copy()
    n_directions, n_ranges = amplitude.shape
    places = np.random.default_rng(7).integers(2, n_ranges - 2, n_directions)
    amplitude[np.arange(n_directions), places] = np.linspace(0.1, 0.4, n_directions)
    return made.replace(amplitude=amplitude)


def open_dataset(path, **options):
    """Open a file by `xarray.open_dataset`."""
    import xarray  # noqa: PLC0415 - it imports pandas, which few tests need

    return xarray.open_dataset(path, **options)

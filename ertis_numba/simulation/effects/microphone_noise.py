"""White noise of each microphone."""

from collections.abc import Set as AbstractSet

from ertis_numba.simulation.estimates import Estimate, noise
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.sensors import Sensor
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "loudness", "noise_rms"]


def noise_rms(sensor: Sensor) -> float:
    """Return the RMS of the noise over the whole band, full scale 1; modulators hash it from microphone and sample."""
    dbfs = sensor.electronics.noise_dbfs
    return 0.0 if dbfs is None else float(10 ** (dbfs / 20))


def loudness(shot: Snapshot, active: AbstractSet[str]) -> tuple[float, float]:
    """Return no peak, and the power of the noise."""
    dbfs = shot.sensor.electronics.noise_dbfs
    return 0.0, 0.0 if dbfs is None else 10 ** (dbfs / 10)


def estimate(sight: Sight) -> Estimate | None:
    """Compare white noise with the weakest reflector."""
    dbfs = sight.shot.sensor.electronics.noise_dbfs
    if dbfs is None:
        return None
    return noise(sight, sight.of_white_noise(dbfs), f"{dbfs:g} dBFS in each microphone")

"""White noise of each microphone."""

from typing import Final

from ertis_numba.simulation.effects._effect import Effect
from ertis_numba.simulation.estimates import Estimate, noise
from ertis_numba.simulation.sight import Sight

__all__ = ["EFFECT", "microphone_noise"]


def microphone_noise(noise_dbfs: float) -> float:
    """Return the RMS of the noise over the whole band, full scale 1.

    The modulators generate the noise themselves, from a hash of microphone and sample.
    """
    return float(10 ** (noise_dbfs / 20))


def _estimate(sight: Sight) -> Estimate | None:
    """Compare white noise with the weakest reflector."""
    dbfs = sight.shot.sensor.electronics.noise_dbfs
    if dbfs is None:
        return None
    return noise(sight, sight.of_white_noise(dbfs), f"{dbfs:g} dBFS in each microphone")


EFFECT: Final = Effect(
    name="microphone_noise",
    about="white noise of each microphone",
    equation="white, approximately Gaussian",
    needed_if="it exceeds the noise floor of the image",
    requested=True,
    estimate=_estimate,
)

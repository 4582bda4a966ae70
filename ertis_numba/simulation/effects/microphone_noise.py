"""White noise of each microphone."""

__all__ = ["microphone_noise"]


def microphone_noise(noise_dbfs: float) -> float:
    """Return the RMS of the noise over the whole band, full scale 1.

    The modulators generate the noise themselves, from a hash of microphone and sample.
    """
    return float(10 ** (noise_dbfs / 20))

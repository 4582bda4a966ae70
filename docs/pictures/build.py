"""Draw the pictures of the README: `make pictures`.

The real measurement comes with the package rtisdev; its code is not imported.
"""

import importlib.metadata
from pathlib import Path

import ertis_numba as ertis

HERE = Path(__file__).parent


def real() -> None:
    """Draw the real measurement in 181 directions with its five strongest reflectors."""
    raw = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    settings = ertis.Settings.from_preset("default_25_50")
    settings = settings.replace(processing=settings.processing.replace(directions="2d:181", range_m=(0.8, 5.0)))
    (measurement,) = ertis.open_raw(str(raw), settings, sensor="eRTIS")
    image = ertis.Pipeline(settings).process(measurement)
    ertis.plot(image, peaks=ertis.find_peaks(image, top=5)).savefig(HERE / "real.png")


if __name__ == "__main__":
    real()

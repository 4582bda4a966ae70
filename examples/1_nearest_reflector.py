"""Measure with a sensor and print the position of the nearest strong reflector.

Run it with the port of a sensor, real or emulated::

    ertis sensors emulate data/synthetic/reflectors.h5 &
    python examples/1_nearest_reflector.py sensor
"""

import sys

import ertis_numba as ertis


def main(port: str) -> None:
    """Take five measurements and print the nearest reflector of each."""
    settings = ertis.Settings.from_preset("default_25_50")
    with ertis.SonarDriver.open(port) as sonar, ertis.Pipeline(settings) as pipeline:
        stream = pipeline.stream()  # It demodulates words while others still arrive.
        sonar.configure(ertis.Setup.of(settings), on_words=stream.add)
        for _ in range(5):
            block = sonar.measure()
            image = pipeline.process(ertis.Measurement(block.data, settings), stream=stream)
            peaks = ertis.find_peaks(image, top=10, min_level_db=-15.0)
            nearest = min(peaks, key=lambda peak: peak.range_m)
            print(f"#{block.counter}: {nearest.range_m:.2f} m at {nearest.azimuth_deg:+.0f}°")


if __name__ == "__main__":
    main(*sys.argv[1:])

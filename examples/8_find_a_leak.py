"""Find a leak of compressed air in a recording, and print its direction and its level.

Give a recording of a sensor that emits no call, real or emulated, and the distance of the leak in metres if you know
it. The level is then that at 1 m from the leak, if the layout of the sensor states the sensitivity of its microphones::

    ertis example leak
    ertis simulate leak.toml
    python examples/8_find_a_leak.py leak.h5 2.5
"""

import sys

import ertis_numba as ertis

BAND_HZ = (40e3, 80e3)  # Machines are quieter here than leaks.


def main(path: str, distance_m: str | None = None) -> None:
    """Print the loudest source of all measurements together."""
    with ertis.open_recording(path) as recording:
        settings = recording.settings.replace(
            **{"passive.bands_hz": [BAND_HZ], "passive.focus_m": None if distance_m is None else float(distance_m)}
        )
        with ertis.AcousticCamera(settings) as camera:
            for measurement in recording:
                camera.add(ertis.Measurement(measurement.data, settings, measurement.stamp))
            bearings = ertis.find_bearings(camera, top=1)
    if not bearings:
        print("no leak found")
        return
    (leak,) = bearings
    level, unit = leak.level
    print(f"azimuth {leak.azimuth_deg:+.3f}° ± {leak.sideways_deg:.3f}°")
    print(f"elevation {leak.elevation_deg:+.3f}° ± {leak.upwards_deg:.3f}°")
    print(f"{level:.1f} {unit} from {BAND_HZ[0] / 1e3:g} to {BAND_HZ[1] / 1e3:g} kHz")


if __name__ == "__main__":
    if len(sys.argv) not in {2, 3}:
        sys.exit("give a recording and, optionally, the distance of the leak in metres")
    main(*sys.argv[1:])

"""Find a leak of compressed air in a recording, and print its direction and its level.

Pass a recording of a sensor that emits no call, real or emulated, and the distance of the leak in metres if you know
it. The level is then that at 1 m from the leak, if the layout of the sensor states the sensitivity of its microphones::

    ertis example leak
    ertis simulate leak.toml
    python examples/8_find_a_leak.py leak.h5 2.5
"""

import math
import sys

import ertis_numba as ertis
from ertis_numba.storage import RecordingReader

BAND_HZ = (40e3, 80e3)  # Machines are quieter here than leaks.
USAGE = "pass a recording and, optionally, the distance of the leak in metres"


def require_sound(recording: RecordingReader) -> None:
    """End the program if the recording contains echoes, or no sound because all microphones are faulty."""
    if any(stamp.behaviour == "active" for stamp in recording.stamps()):
        sys.exit(f"{recording.path} has measurements with a call; choose a recording of 'ertis capture --passive'")
    health = ertis.health(recording[0])
    if all(channel.faults for channel in health.channels):
        sys.exit(f"{recording.path}: {health.verdict()}; find the cause with 'ertis sensors check' and record again")


def main(path: str, distance_m: str | None = None) -> None:
    """Print the loudest source of all measurements together."""
    with ertis.open_recording(path) as recording:
        require_sound(recording)
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
    if math.isfinite(leak.upwards_deg):
        print(f"elevation {leak.elevation_deg:+.3f}° ± {leak.upwards_deg:.3f}°")
    else:
        print("elevation unknown: the recording has directions of one elevation only")
    print(f"{level:.1f} {unit} from {BAND_HZ[0] / 1e3:g} to {BAND_HZ[1] / 1e3:g} kHz")


if __name__ == "__main__":
    if len(sys.argv) not in {2, 3} or sys.argv[1].startswith("-"):
        sys.exit(USAGE)
    try:
        main(*sys.argv[1:])
    except (ertis.ErtisError, OSError, ValueError) as error:
        sys.exit(f"{error}")

"""Print the speed of approaching objects from two successive images: acoustic flow.

If an object moves by some millimetres between two images, its echo moves along the range axis. For each direction with
an echo, the radial speed is the lag of the highest correlation divided by the time between the images. Negative speeds
approach::

    ertis serve &
    ertis capture --port front --to tcp://127.0.0.1:5601 &
    python examples/3_acoustic_flow.py tcp://127.0.0.1:5602 front
"""

import sys

import numpy as np
from numpy.typing import NDArray

import ertis_numba as ertis

FASTEST_M_S = 3.0
HALF_WINDOW_M = 0.06  # around the strongest echo of a direction
MIN_LEVEL = 0.1  # of the strongest echo of the image
MIN_LIKENESS = 0.9


def flow(before: ertis.Energyscape, now: ertis.Energyscape) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the directions with a reliable correlation, and their radial speeds in m/s."""
    spacing_m = float(now.range_m[1] - now.range_m[0])
    time_s = (now.stamp.timestamp_ns - before.stamp.timestamp_ns) / 1e9
    half, reach = round(HALF_WINDOW_M / spacing_m), round(FASTEST_M_S * time_s / spacing_m) + 1
    strongest = before.amplitude.argmax(axis=1)
    has_room = (strongest >= half + reach) & (strongest < len(now.range_m) - half - reach)
    has_echo = before.amplitude.max(axis=1) > MIN_LEVEL * before.amplitude.max()
    directions = np.flatnonzero(has_room & has_echo)
    # Windows of the earlier image, and of the current image at every lag.
    around = np.arange(-half, half + 1)
    lags = np.arange(-reach, reach + 1)
    centre = strongest[directions, None]
    was = before.amplitude[directions[:, None], centre + around]
    here = now.amplitude[directions[:, None, None], centre[:, :, None] + lags[:, None] + around]
    alike = np.einsum("dla,da->dl", here, was) / (
        np.linalg.norm(here, axis=2) * np.linalg.norm(was, axis=1)[:, None] + np.finfo(np.float32).tiny
    )
    best = alike.argmax(axis=1)
    sure = (best > 0) & (best < 2 * reach) & (alike.max(axis=1) > MIN_LIKENESS)
    directions, alike, best = directions[sure], alike[sure], best[sure]
    # The maximum of the parabola through the best lag and its neighbours.
    row = np.arange(len(best))
    left, middle, right = alike[row, best - 1], alike[row, best], alike[row, best + 1]
    curvature = np.minimum(left - 2 * middle + right, -np.finfo(np.float32).tiny)
    shift = lags[best] + 0.5 * (left - right) / curvature
    return directions, shift * spacing_m / time_s


def main(address: str, sensor: str) -> None:
    """Print the fastest approach in each pair of successive images."""
    before: ertis.Energyscape | None = None
    with ertis.Subscriber(address, sensors=[sensor], products=["energyscape"]) as subscriber:
        for image in subscriber:
            follows = (
                before is not None
                and before.stamp.session_id == image.stamp.session_id
                and before.stamp.timestamp_ns < image.stamp.timestamp_ns
                and before.amplitude.shape == image.amplitude.shape
            )
            if follows and before is not None:
                directions, speeds_m_s = flow(before, image)
                if len(directions):
                    k = speeds_m_s.argmin()
                    azimuth_deg = np.degrees(image.azimuth_rad[directions[k]])
                    print(f"#{image.stamp.sequence}: {speeds_m_s[k]:+.2f} m/s at {azimuth_deg:+.0f}°", flush=True)
            before = image


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("pass the address of a central node and the name of a sensor")
    try:
        main(*sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit(130)

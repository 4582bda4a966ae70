"""Laser scans of images, and of the reflectors that a fusion has located."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ertis_numba.analysis.nearest_echo import nearest_echo
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.geometry import microphones, unrolled_rad
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.interop._mountings import Mounting
from ertis_numba.interop.ros_messages import header
from ertis_numba.settings import Settings

__all__ = ["reflectors_ahead", "scan_message"]

_HALF_POWER: Final = 0.44  # Half of the main lobe of an array of length 1, at half power, in wavelengths.


def scan_message(
    image: Energyscape, *, min_level_db: float = -20.0, floor_dbfs: float = -math.inf
) -> dict[str, Any] | None:
    """Return the nearest echo of each azimuth, as LaserScan, intensities in dBFS; None if not planar."""
    # A reflector fills the beam nearest to it, and all within one standard deviation of its direction. In other beams
    # within half of the main lobe, the range is infinite: farther echoes may be those of sound that it reflected.
    if not image.is_planar or len(image.azimuth_rad) < 2 or len(image.range_m) < 3:
        return None
    azimuth_rad = unrolled_rad(image.azimuth_rad)
    order = np.argsort(azimuth_rad, kind="stable")
    ascending = azimuth_rad[order]
    angle_rad = np.linspace(ascending[0], ascending[-1], len(ascending))
    nearest = order[np.searchsorted((ascending[:-1] + ascending[1:]) / 2, angle_rad)]
    if image.points is not None:
        ranges_m, levels_dbfs = _beams_of_points(image, image.points, angle_rad, min_level_db, floor_dbfs)
    else:
        range_m, level_dbfs = nearest_echo(image, min_level_db=min_level_db, floor_dbfs=floor_dbfs)
        ranges_m, levels_dbfs = range_m[nearest], level_dbfs[nearest]
    # Nearer than the first range of the settings, not all directions are observed. Receivers discard readings up to
    # `range_min`, which therefore stays below all of them.
    nearest_m = np.nextafter(ranges_m.min(), 0.0, dtype=np.float32)
    return {
        "header": header(image.stamp),
        "angle_min": float(angle_rad[0]),
        "angle_max": float(angle_rad[-1]),
        "angle_increment": float(angle_rad[1] - angle_rad[0]),
        "time_increment": 0.0,  # One call serves all angles.
        "scan_time": 0.0,
        "range_min": min(max(float(image.range_m[0]), image.settings.processing.range_m[0]), float(nearest_m)),
        "range_max": float(image.range_m[-1]),
        "ranges": ranges_m.tolist(),
        "intensities": levels_dbfs.tolist(),
    }


def _beams_of_points(
    image: Energyscape, cloud: PointCloud, angle_rad: NDArray[np.float64], min_level_db: float, floor_dbfs: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the range and level of the nearest reflector in each beam of a scan; infinite without one."""
    cloud = cloud.strongest(None, min_level_db)
    range_m = np.hypot(cloud.position_m[:, 0], cloud.position_m[:, 1], dtype=np.float64)
    kept = (range_m >= image.range_m[0]) & (range_m <= image.range_m[-1])
    kept &= cloud.amplitude >= 10 ** (floor_dbfs / 20)
    cloud, range_m = cloud.only(kept), range_m[kept]
    ranges_m, levels_dbfs = np.full(len(angle_rad), np.inf), np.full(len(angle_rad), -np.inf, np.float32)
    across_m = np.zeros(len(cloud)) if cloud.uncertainty_m is None else np.nan_to_num(cloud.uncertainty_m[:, 1])
    turn, spacing_rad, hidden_rad = 2 * math.pi, angle_rad[1] - angle_rad[0], _half_lobe_rad(image.settings)
    for point in np.argsort(-range_m, kind="stable"):  # Nearer points replace farther ones.
        away_rad = np.abs((angle_rad - cloud.azimuth_rad[point] + math.pi) % turn - math.pi)
        if away_rad.min() > spacing_rad:  # Outside the angles of the scan.
            continue
        hidden = away_rad <= hidden_rad
        ranges_m[hidden], levels_dbfs[hidden] = np.inf, -np.inf
        beams = away_rad <= max(float(away_rad.min()), across_m[point] / range_m[point])
        ranges_m[beams], levels_dbfs[beams] = range_m[point], 20 * math.log10(cloud.amplitude[point])
    return ranges_m, levels_dbfs


def _half_lobe_rad(settings: Settings) -> float:
    """Return half of the width of the main lobe ahead, at half power and at the middle frequency of the call."""
    call, mics_m = settings.call, microphones(settings.array).enabled_positions_m
    wave_m = 2 * sound_speed_m_s(settings.air) / (call.low_frequency_hz + call.high_frequency_hz)
    return math.asin(min(1.0, _HALF_POWER * wave_m / max(float(np.ptp(mics_m[:, 1])), wave_m / 2)))


def reflectors_ahead(cloud: PointCloud, image: Energyscape, mounting: Mounting) -> PointCloud:
    """Return certain reflectors of a cloud in the platform frame that are ahead of a sensor, in its frame."""
    translation_m, rotation_xyzw = mounting
    rotation = Rotation.from_quat(rotation_xyzw)
    position_m = rotation.inv().apply(cloud.position_m - np.array(translation_m)).astype(np.float32)
    chosen = cloud.is_certain & (position_m[:, 0] > 0)
    return cloud.replace(position_m=position_m, stamp=image.stamp, confirmed=None).only(chosen)

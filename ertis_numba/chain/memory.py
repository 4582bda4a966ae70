"""Memory of a pipeline, predicted before any of it is allocated."""

from pathlib import Path
from typing import Final

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.time_window import time_window
from ertis_numba.geometry import direction_grid, grid_count, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["MAX_BYTES", "available_bytes", "predicted_bytes", "require_image_size", "require_images", "require_memory"]

MAX_BYTES: Final = 1_000_000_000
"""Limit on the memory of one pipeline of a central node; a sensor's settings determine its size."""

_MAX_IMAGE_BYTES: Final = 256_000_000  # Limit on an image of a central node as float32.

_CGROUP: Final = Path("/sys/fs/cgroup")
_CGROUP_FILES: Final = (
    ("memory.max", "memory.current"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
)
"""Files with the limit and the usage of a control group, for versions 2 and 1."""

# Bytes: upper bounds of measurements with 90 to 1,000,000 directions, 1 to 32 microphones and records of 2 ms to 9 s.
_OF_DIRECTION: Final = 2500  # Per direction: tables of the beam grids that the planner compares.
_OF_DELAY: Final = 75  # Per direction and microphone: delays, offsets and weights, with temporary copies.
_OF_SAMPLE: Final = 32  # Per microphone and sample of its transform: signal, spectrum and filter.
_OF_POINT: Final = 4  # Per image point.


def available_bytes(meminfo: Path = Path("/proc/meminfo"), cgroup: Path = _CGROUP) -> int:
    """Return the memory that this process can still allocate within its container (``cgroup``); 0 if unknown."""
    lines = _read(meminfo).splitlines()
    found = [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    for limit, used in _CGROUP_FILES:
        numbers = [_read(cgroup / name).strip() for name in (limit, used)]
        if all(number.isdigit() for number in numbers):  # The text "max" stands for no limit.
            found.append(max(0, int(numbers[0]) - int(numbers[1])))
    return min(found, default=0)


def _read(path: Path) -> str:
    try:
        return path.read_text("ascii")
    except (OSError, UnicodeDecodeError):
        return ""


def predicted_bytes(settings: Settings) -> int:
    """Return the memory of planning and processing, without libraries and the tables of unusually accurate plans."""
    count = grid_count(settings.processing.directions)
    n_directions = len(direction_grid(settings.processing)) if count is None else count
    n_mics = int(microphones(settings.array).enabled.sum())
    window = time_window(settings, largest_delay_s=0.0, n_taps=1)
    of_direction = _OF_DIRECTION + _OF_DELAY * n_mics + _OF_POINT * len(window.range_m)
    return n_directions * of_direction + _OF_SAMPLE * n_mics * window.n_fft


def require_memory(settings: Settings, max_bytes: int) -> int:
    """Require at most ``max_bytes`` for a pipeline, and return the bytes that remain for the tables of a plan."""
    n_bytes = predicted_bytes(settings)
    if n_bytes > max_bytes:
        raise ArgumentError(
            f"a pipeline for these settings needs about {n_bytes / 1e6:.0f} MB; the limit is {max_bytes / 1e6:.0f} MB. "
            "Use fewer directions, a shorter processing.range_m, a shorter call or a lower sample rate"
        )
    return max_bytes - n_bytes


def require_image_size(settings: Settings) -> None:
    """Refuse images above 256 MB, too large for a central node, before anything is allocated."""
    processing = settings.processing
    count = grid_count(processing.directions)
    if count is None:  # A list of directions is only as long as its text.
        return
    step_m = sound_speed_m_s(settings.air) / (2 * settings.output_rate_hz)
    grid = processing.directions if isinstance(processing.directions, str) else f"{count} directions"
    n_bytes = 4 * count * (processing.range_m[1] - processing.range_m[0]) / step_m
    if n_bytes > _MAX_IMAGE_BYTES:
        raise ArgumentError(
            f"images of {grid} over {processing.range_m[0]:g} to {processing.range_m[1]:g} m have "
            f"{n_bytes / 1e6:.0f} MB, but the limit is {_MAX_IMAGE_BYTES // 1_000_000} MB; use fewer directions or "
            "ranges"
        )


def require_images(settings: Settings) -> None:
    """Refuse settings from which a central node computes no image; this takes milliseconds and little memory."""
    settings.processing.require_image()
    settings.processing.require_sensor_frame("a central node does not know the poses of measurements in time")
    require_image_size(settings)
    require_memory(settings, MAX_BYTES)

"""Registry of the export formats, which the command line reads at its start: nothing else is imported here."""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal

__all__ = ["EXPORT_FORMATS", "FORMATS", "TOPICS", "ExportFormat"]

TOPICS: Final = ("points", "scan", "image", "sonar_image")
"""Products of a sensor in MCAP."""
_POINTS = (
    *("x", "y", "z", "intensity", "uncertainty_range", "uncertainty_across"),
    *("sensor", "sequence", "sec", "nanosec"),
)
_POINT_OPTIONS = ("mounting", "top", "min_level_db", "places")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportFormat:
    """Export format."""

    suffix: str
    content: Literal["points", "topics", "results", "signals", "drive", "poses", "sound"]
    writer: str  # module and function, imported when they are needed: some need an extra
    fields: tuple[str, ...] = ()
    options: tuple[str, ...] = ("places",)  # that do not apply to all formats
    about: str = ""  # after the suffix in the help

    def load(self) -> Callable[..., Any]:
        """Return the function that writes the format."""
        module, _, name = self.writer.partition(":")
        function: Callable[..., Any] = getattr(importlib.import_module(module), name)
        return function


_FILES: Final = "ertis_numba.interop._point_files"

EXPORT_FORMATS: Final[Mapping[str, ExportFormat]] = MappingProxyType(
    {
        "mcap": ExportFormat(
            suffix=".mcap",
            content="topics",
            writer="ertis_numba.interop._mcap:write_mcap",
            fields=(*TOPICS, "tf_static"),
            options=(*_POINT_OPTIONS, "topics"),
        ),
        "ply": ExportFormat(
            suffix=".ply",
            content="points",
            writer=f"{_FILES}:write_ply",
            fields=_POINTS,
            options=(*_POINT_OPTIONS, "text"),
        ),
        "pcd": ExportFormat(
            suffix=".pcd",
            content="points",
            writer=f"{_FILES}:write_pcd",
            fields=_POINTS,
            options=(*_POINT_OPTIONS, "text"),
        ),
        "csv": ExportFormat(
            suffix=".csv",
            content="points",
            writer=f"{_FILES}:write_csv",
            fields=(
                *("sensor", "session_id", "sequence", "sync_count", "timestamp_ns"),
                *("x_m", "y_m", "z_m", "amplitude", "uncertainty_range_m", "uncertainty_across_m"),
            ),
            options=_POINT_OPTIONS,
        ),
        "npz": ExportFormat(
            suffix=".npz",
            content="results",
            writer="ertis_numba.interop._npz:write_npz",
            fields=(
                *("amplitude", "azimuth_rad", "elevation_rad", "range_m"),
                *("session_id", "sequence", "sync_count", "timestamp_ns", "timestamp_uncertainty_ns"),
                *("behaviour", "sensor", "settings"),
            ),
        ),
        "acoular": ExportFormat(
            suffix=".h5",
            content="signals",
            writer="ertis_numba.interop._acoular:write_acoular",
            fields=("time_data", "metadata"),
            about="and .xml for Acoular",
        ),
        "batslam": ExportFormat(
            suffix=".mat",
            content="drive",
            writer="ertis_numba.interop._batslam:write_batslam",
            fields=(
                *("gt_pose", "gt_delta", "odom_delta", "t", "lap"),
                *("echo_left", "echo_right", "echo_scale", "meta", "reflectors"),
            ),
            options=("mounting", "places", "drive", "poses", "odometry", "scene", "beam_azimuth_deg"),
            about="for BatSLAM",
        ),
        "tum": ExportFormat(
            suffix=".tum",
            content="poses",
            writer="ertis_numba.interop.trajectory_files:write_tum",
            options=(),
            about="for poses",
        ),
        "wav": ExportFormat(
            suffix=".wav",
            content="sound",
            writer="ertis_numba.base.wav:wav_bytes",
            options=("places", "direction", "heterodyne_hz", "expansion", "with_silence"),
            about="for sound",
        ),
    }
)
"""Formats by name; the how-to guide on exports states the content of each."""

FORMATS: Final = {name: each for name, each in EXPORT_FORMATS.items() if each.content not in {"poses", "sound"}}
"""Formats of `export`."""

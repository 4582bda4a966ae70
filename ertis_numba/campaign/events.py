"""Events of a campaign."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

__all__ = ["Event", "Outcome", "RecordingEnded", "RecordingProgress", "RecordingStarted"]

Outcome = Literal["made", "kept", "skipped", "failed"]


@dataclass(frozen=True, slots=True)
class RecordingStarted:
    """Processing of a recording has begun."""

    recording: Path
    measurements: int


@dataclass(frozen=True, slots=True)
class RecordingProgress:
    """Number of processed measurements of a recording."""

    recording: Path
    done: int


@dataclass(frozen=True, slots=True)
class RecordingEnded:
    """Result of a recording.

    Attributes
    ----------
    recording, output : Path
        Recording, and its energyscape file or file of acoustic maps.
    outcome : {"made", "kept", "skipped", "failed"}
        ``kept`` means that the output exists, made with the same settings and versions. ``skipped`` means a
        result of processing, or a recording without images, that was not given by name.
    error : str
        Reason of a failure in one line; empty otherwise.
    made : dict
        Measurements, times and other results of a processed recording; results of the checks for an existing output.
    """

    recording: Path
    output: Path
    outcome: Outcome
    error: str = ""
    made: dict[str, Any] = field(default_factory=dict)


Event = RecordingStarted | RecordingProgress | RecordingEnded

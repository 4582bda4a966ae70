"""Events of a campaign."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

__all__ = ["Advanced", "Begun", "Event", "Outcome", "RecordingEnded"]

Outcome = Literal["made", "there", "passed over", "failed"]


@dataclass(frozen=True, slots=True)
class Begun:
    """Processing of a recording has begun."""

    recording: Path
    measurements: int


@dataclass(frozen=True, slots=True)
class Advanced:
    """Number of processed measurements of a recording."""

    recording: Path
    done: int


@dataclass(frozen=True, slots=True)
class RecordingEnded:
    """Result of a recording.

    Attributes
    ----------
    recording, output : Path
    outcome : {"made", "there", "passed over", "failed"}
        ``there`` is what had been made before, by the same settings and versions.
    error : str
        Why it failed, in a line.
    made : dict
        Measurements, times and more of what was made; of what was there what it was checked for.
    """

    recording: Path
    output: Path
    outcome: Outcome
    error: str = ""
    made: dict[str, Any] = field(default_factory=dict)


Event = Begun | Advanced | RecordingEnded

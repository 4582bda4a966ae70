"""What a worker says of the plan of a sensor: asked for by name, as it runs in another process."""

import io
import threading
from contextlib import redirect_stderr
from typing import TYPE_CHECKING, Any

from ertis_cli import plans

if TYPE_CHECKING:
    from ertis_numba.frames import Measurement
    from ertis_numba.pipeline import Pipeline

__all__ = ["NAME", "examine"]

NAME = f"{__name__}:examine"

_one_at_a_time = threading.Lock()  # as there is one stderr


def examine(
    pipeline: "Pipeline", first: "Measurement", *, threads: int | None, explain: bool, verify: bool, silent: bool
) -> dict[str, Any]:
    """Return what `plans.tell` does, and what it has to say as ``lines``."""
    said = io.StringIO()
    with _one_at_a_time, redirect_stderr(said):
        told = plans.tell(pipeline, first, threads=threads, explain=explain, verify=verify, silent=silent)
    return {**told, "lines": said.getvalue().splitlines()}

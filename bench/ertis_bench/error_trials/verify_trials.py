"""Comparison of `ertis process --verify` with a slow reference, over random settings of every kind."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ertis_bench import machine
from ertis_bench.error_trials import reference_image
from ertis_bench.error_trials.random_settings import random_measurement
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import Settings
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS

__all__ = ["FORMS", "MAX_DIFFERENCE_DB", "compared", "form", "run"]

MAX_DIFFERENCE_DB = 1.0
"""Largest difference between verified and true errors that is not reported as wrong."""

_FLOOR_DB = -100.0  # Below this level, rounding in single precision dominates the error.
_SHORT_CALL_S = 5e-4

_GROUPS: dict[str, Callable[[Settings], bool]] = {
    "all": lambda _: True,
    "calls without a ramp": lambda settings: settings.call.ramp_fraction == 0,
    "calls of less than 0.5 ms": lambda settings: settings.call.duration_s < _SHORT_CALL_S,
    "PDM": lambda settings: settings.recording.is_pdm,
    "PCM": lambda settings: not settings.recording.is_pdm,
    "spherical wavefronts": lambda settings: settings.processing.wavefront == "spherical",
    "other edges of the band": lambda settings: settings.processing.band_edges_hz is not None,
    **{
        f"`{name}`": lambda settings, name=name: settings.processing.beamformer == name  # type: ignore[misc]
        for name in BEAMFORMERS
    },
    **{
        f"`{name}`": lambda settings, name=name: settings.processing.weighting == name  # type: ignore[misc]
        for name in WEIGHTINGS
        if name != "none"
    },
}


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Compare verified and true errors of ``count`` random settings, and return the report."""
    rows = []
    for each in range(seed, seed + count):
        rows.append(compared(each))
        if rows[-1]["wrong"]:
            say(f"seed {each}: verified {rows[-1]['verified_db']:.2f} dB, true {rows[-1]['true_db']:.2f} dB")
    return {"machine": machine.describe(), "count": count, "seed": seed, "rows": rows}


def compared(seed: int) -> dict[str, Any]:
    """Return the verified and the true error of the image of one random measurement."""
    measurement = random_measurement(seed)
    image = _image(measurement)
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    exact = reference_image.exact(measurement.data, image.settings, directions, image.range_m)
    true_db = verification.error_db(image.amplitude, exact)
    verified_db = verification.measure(image, measurement).error_db
    return {
        "seed": seed,
        "true_db": true_db,
        "verified_db": verified_db,
        "audible": true_db > _FLOOR_DB,
        "wrong": true_db > _FLOOR_DB and not abs(verified_db - true_db) <= MAX_DIFFERENCE_DB,
        "groups": [name for name, belongs in _GROUPS.items() if belongs(image.settings)],
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    header = ["settings", "tried", "errors above -100 dB", "more than 1 dB apart", "largest difference"]
    lines = list(_lines(report["rows"]))
    return (
        f"{table(header, lines)}\n\n{report['count']} random settings from seed {report['seed']}. Verified errors "
        "come from `--verify`. True errors come from a separate float64 reference, in all directions and ranges. "
        f"{sentence(report['machine'])}"
    )


def _image(measurement: Measurement) -> Energyscape:
    """Return the image with the plan for the drawn budget, or with the most accurate plan if none keeps the budget."""
    try:
        pipeline = Pipeline(measurement.settings, "cpu", 1)
    except ArgumentError:
        pipeline = Pipeline(measurement.settings, "cpu", 1, max_error_db=0.0)
    with pipeline:
        image = pipeline.process(measurement)
    if not np.any(image.amplitude):
        raise DataError(f"the image of {measurement.settings} is silent; draw louder words")
    return image


def _lines(rows: Sequence[dict[str, Any]]) -> Iterator[list[str]]:
    for name in _GROUPS:
        mine = [row for row in rows if name in row["groups"]]
        audible = [row for row in mine if row["audible"]]
        largest_db = max((abs(row["verified_db"] - row["true_db"]) for row in audible), default=0.0)
        wrong = sum(row["wrong"] for row in mine)
        yield [name, str(len(mine)), str(len(audible)), str(wrong), f"{largest_db:.3f} dB"]


FORMS = {"verification": form}
"""Forms of the table, by the name in its markers."""

"""Compared plans, and their names."""

from ertis_numba.settings import Accuracy

__all__ = ["BEAMFORMING_KERNELS", "PLANS", "in_words", "plans"]

BEAMFORMING_KERNELS = (
    "quantise_tiles",
    "delay_and_sum_envelope",
    "interpolated_beams_envelope",
    "delay_and_sum_envelope_int16",
    "interpolated_beams_envelope_int16",
)
"""Kernels from analytic signals to an image, of all plans for delay-and-sum."""

PLANS: tuple[tuple[str, int, int, float, tuple[int, float] | None], ...] = (
    ("float32", 1, 8, 40.0, None),
    ("float32", 1, 32, 80.0, None),
    ("float32", 2, 2, 40.0, None),
    ("float32", 2, 8, 80.0, None),
    ("float32", 3, 2, 40.0, None),
    ("float32", 3, 6, 100.0, None),
    ("float32", 4, 2, 100.0, None),
    ("float32", 4, 4, 140.0, None),
    ("float32", 5, 2, 100.0, None),
    ("float32", 6, 2, 140.0, None),
    ("int16", 1, 2, 40.0, None),
    ("int16", 1, 8, 40.0, None),
    ("int16", 2, 2, 40.0, None),
    ("int16", 2, 4, 80.0, None),
    ("int16", 3, 2, 80.0, None),
    ("int16", 4, 2, 80.0, None),
    ("int16", 2, 1, 40.0, (2, 1.5)),
    ("int16", 2, 1, 40.0, (2, 3.0)),
    ("int16", 2, 2, 40.0, (4, 1.25)),
    ("float32", 2, 2, 40.0, (4, 1.75)),
    ("int16", 2, 4, 80.0, (4, 2.5)),
    ("int16", 2, 8, 100.0, (6, 2.5)),
    ("float32", 3, 6, 100.0, (6, 3.0)),
    ("float32", 3, 4, 40.0, None),
    ("float32", 3, 4, 60.0, None),
    ("float32", 3, 4, 80.0, None),
    ("float32", 3, 4, 120.0, None),
)
"""Compared plans, the simplest first.

Each has a precision; delay taps; samples per range; stopband attenuation in dB; and grid points along each axis with
their density, or None without a beam grid.
"""


def in_words(accuracy: Accuracy) -> str:
    """Return the name of a complete plan, such as ``int16, 2 samples of 2 per range, beam grid 4 × 1.75, 60 dB``."""
    n_phases, n_taps = accuracy.oversampling, accuracy.delay_taps
    delays = f"{n_taps} {'sample' if n_taps == 1 else 'samples'} of {n_phases} per range" if n_taps else "phase shifts"
    parts = [accuracy.precision, delays]
    if accuracy.beam_taps:
        parts.append(f"beam grid {accuracy.beam_taps} × {accuracy.beam_density:g}")
    parts.append(f"{accuracy.stopband_attenuation_db:g} dB")
    if accuracy.row_beams:
        parts.append("rows first")
    if accuracy.focal_zones and accuracy.focal_zones > 1:
        parts.append(f"{accuracy.focal_zones} zones")
    return ", ".join(parts)


def plans() -> list[Accuracy]:
    """Return complete plans for `PLANS`."""
    return [_plan(*row) for row in PLANS]


def _plan(
    precision: str, n_taps: int, n_phases: int, stopband_attenuation_db: float, nodes: tuple[int, float] | None
) -> Accuracy:
    beam_taps, beam_density = nodes or (0, 2.0)
    return Accuracy().replace(
        precision=precision,
        oversampling=n_phases,
        delay_taps=n_taps,
        beam_taps=beam_taps,
        beam_density=beam_density,
        stopband_attenuation_db=stopband_attenuation_db,
        focal_zones=1,
    )

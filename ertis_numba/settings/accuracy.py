"""How exact an image is."""

from typing import Literal

from ertis_numba import checks
from ertis_numba.documents import TomlTable
from ertis_numba.errors import ArgumentError

__all__ = ["ERROR_PRESETS_DB", "INTERPOLATIONS", "MAX_FOCAL_ZONES", "Accuracy"]

INTERPOLATIONS = {"fitted": None, "nearest": 1, "carrier": 1, "linear": 2, "cubic": 4}
"""Ways of making a delayed sample, and how many samples each takes; None where that is a choice."""

ERROR_PRESETS_DB = {"draft": -20.0, "standard": -35.0, "fine": -60.0, "exact": -100.0}
"""Error budgets by name."""

MAX_FOCAL_ZONES = 1_000_000
"""More steps of curvature than an image has ranges, even near the array."""


class Accuracy(TomlTable, frozen=True, kw_only=True):
    """How exact the image is: an error that it may have, and what shall not be left to the planner.

    Whatever is open (``auto`` or None), the planner chooses, such that the image takes the least time on
    this machine and its predicted error stays within the budget. An energyscape carries the plan that it
    was made by, with nothing open. ``docs/accuracy.md`` has the equations.

    Attributes
    ----------
    max_error_db : float
        Budget: the norm of the image less the exact one, by that of the exact one. `ERROR_PRESETS_DB` has
        names for some.
    precision : {"auto", "float32", "int16"}
        Of the samples that beams are summed from. ``int16`` needs a processor with a 16-bit dot product.
    oversampling : int, optional
        Samples that are kept per range of the energyscape, 1 to 64.
    interpolation : {"fitted", "nearest", "carrier", "linear", "cubic"}
        How a delayed sample is made of those kept. ``fitted``: by weights that err least over the call's band.
        The others are there to be compared with: the nearest sample; the nearest one, its carrier turned
        to the right phase; straight or by Lagrange's cubic between carriers turned to the right phase.
    delay_taps : int, optional
        Samples that it is made of, 1 to 8; the simpler ways of interpolation imply theirs.
    beam_taps : int, optional
        Beams are summed for nodes of a grid and those of all directions are interpolated from so many nodes
        along each axis of the array, 2, 4 or 6; 0 sums every direction's own beam.
    beam_density : float, optional
        Nodes by what the aperture resolves at the call's highest frequency, 1.1 to 8.
    stopband_attenuation_db : float, optional
        Damping of what the decimation would alias into the call's band, 40 to 140.
    zones : int, optional
        Steps of their curvature, from 1 on, where wavefronts are spherical: ranges within one share their delays.
    """

    max_error_db: float = -35.0
    precision: Literal["auto", "float32", "int16"] = "auto"
    oversampling: int | None = None
    interpolation: Literal["fitted", "nearest", "carrier", "linear", "cubic"] = "fitted"
    delay_taps: int | None = None
    beam_taps: int | None = None
    beam_density: float | None = None
    stopband_attenuation_db: float | None = None
    focal_zones: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("accuracy.max_error_db", self.max_error_db, -200.0, 0.0)
        checks.choice("accuracy.precision", self.precision, ("auto", "float32", "int16"))
        checks.choice("accuracy.interpolation", self.interpolation, INTERPOLATIONS)
        for name, low, high in (("oversampling", 1, 64), ("delay_taps", 1, 8), ("focal_zones", 1, MAX_FOCAL_ZONES)):
            if getattr(self, name) is not None:
                checks.integer(f"accuracy.{name}", getattr(self, name), low, high)
        if self.beam_taps is not None:
            checks.choice("accuracy.beam_taps", self.beam_taps, (0, 2, 4, 6))
        for name, smallest, largest in (("beam_density", 1.1, 8.0), ("stopband_attenuation_db", 40.0, 140.0)):
            if getattr(self, name) is not None:
                checks.between(f"accuracy.{name}", getattr(self, name), smallest, largest)
        implied = INTERPOLATIONS[self.interpolation]
        if implied is not None and self.delay_taps not in {None, implied}:
            raise ArgumentError(
                f"accuracy.delay_taps is {self.delay_taps}, but interpolation {self.interpolation!r} takes {implied}; "
                "leave it out"
            )

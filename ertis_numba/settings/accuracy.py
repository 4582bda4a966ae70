"""Accuracy of an image: the error budget and the plan."""

from typing import Annotated, Literal

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import Limits

__all__ = ["ERROR_PRESETS_DB", "MAX_FOCAL_ZONES", "Accuracy"]

ERROR_PRESETS_DB = {"draft": -20.0, "standard": -35.0, "fine": -60.0, "exact": -100.0}
"""Named error budgets in dB."""

MAX_FOCAL_ZONES = 1_000_000
"""Limit on the number of focal zones; more than an image has ranges, even near the array."""

_EXACT_DELAYS = (
    ("precision", ("auto", "float32")),
    ("oversampling", (None, 1)),
    ("beam_taps", (None, 0)),
    ("row_beams", (None, False)),
)
"""Values that exact delays support; the last one is what they use."""


class Accuracy(TomlTable, frozen=True, kw_only=True):
    """Error budget of the image, and parts of the plan that the planner shall not choose.

    The planner chooses all values that are open (``auto`` or None): the fastest plan whose predicted error keeps the
    budget. Energyscapes hold the complete plan. ``docs/explanation/accuracy.md`` has the equations.

    Attributes
    ----------
    max_error_db : float, default -35
        Error budget in dB: norm of the difference between the image and the exact image, relative to the
        norm of the exact image. `ERROR_PRESETS_DB` names some budgets.
    precision : {"auto", "float32", "int16"}, default "auto"
        Number format of the samples that are summed to beams. ``auto`` chooses the
        faster one on the instruction set.
    oversampling : int, optional, default None
        Samples kept per range of the energyscape.
    delay_taps : int, optional, default None
        Samples from which a delayed sample is interpolated. The weights minimise the error in the call's band.
        With 0, delays are exact, as phase shifts of spectra. This needs ``precision`` ``float32``, an ``oversampling``
        of 1 and no beam grid, and is for ``delay_and_sum`` without a weighting.
    beam_taps : int, optional, default None
        Beam-grid points along each axis of the array from which a beam is interpolated: 2, 4 or 6. With 0, the beam of
        every direction is summed itself.
        Adaptive beamformers combine all microphones at each point of the image if this is 0, ``delay_taps`` is 1 and
        ``precision`` is ``float32``, and streams otherwise; see ``docs/explanation/beamformers.md``.
    beam_density : float, optional, default None
        Density of the beam grid relative to the resolution of the aperture at the call's highest frequency.
    stopband_attenuation_db : float, optional, default None
        Stopband attenuation of the decimation filter in dB: attenuation of sound that would alias into the
        call's band.
    focal_zones : int, optional, default None
        Number of focal zones for spherical wavefronts. Ranges within a focal zone share their delays.
    row_beams : bool, optional, default None
        Sum the beams of each row of microphones first, and the beams of the array from these. This needs a plane array
        with rows, fixed directions, ``precision`` ``int16`` and a beam grid, and is for ``delay_and_sum`` without a
        weighting.
    """

    max_error_db: Annotated[float, Limits(-200.0, 0.0)] = -35.0
    precision: Literal["auto", "float32", "int16"] = "auto"
    oversampling: Annotated[int, Limits(1, 64)] | None = None
    delay_taps: Annotated[int, Limits(0, 8)] | None = None
    beam_taps: int | None = None
    beam_density: Annotated[float, Limits(1.1, 8.0)] | None = None
    stopband_attenuation_db: Annotated[float, Limits(40.0, 140.0)] | None = None
    focal_zones: Annotated[int, Limits(1, MAX_FOCAL_ZONES)] | None = None
    row_beams: bool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.beam_taps is not None:
            checks.choice("accuracy.beam_taps", self.beam_taps, (0, 2, 4, 6))
        if self.row_beams and (self.precision == "float32" or self.beam_taps == 0):
            raise ArgumentError(
                "accuracy.row_beams is true, which needs accuracy.precision 'int16' and accuracy.beam_taps 2, 4 or 6; "
                "leave these keys out, or use row_beams false"
            )
        if self.delay_taps == 0:
            self._check_phase_shifts()

    def require_exact_delays(self) -> None:
        """Refuse a plan with other delays than those that a delay matrix needs."""
        for name, accepted in (("delay_taps", (None, 0)), *_EXACT_DELAYS):
            value = getattr(self, name)
            if value not in accepted:
                raise ArgumentError(
                    f"accuracy.{name} is {value!r}, but processing.delay_matrix needs exact delays; leave {name} out "
                    f"or use {accepted[1]!r}"
                )

    def _check_phase_shifts(self) -> None:
        """Refuse parts of a plan that phase shifts of spectra do not support."""
        for name, accepted in _EXACT_DELAYS:
            value = getattr(self, name)
            if value not in accepted:
                raise ArgumentError(
                    f"accuracy.{name} is {value!r}, but accuracy.delay_taps 0 (phase shifts of spectra) supports only "
                    f"{accepted[1]!r}; leave {name} out, or use delay_taps 1 to 8"
                )

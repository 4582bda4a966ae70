"""How a measurement becomes an energyscape."""

from typing import Final, Literal

from ertis_numba import checks
from ertis_numba.constants import MAX_MICROPHONES, MAX_NAME_LENGTH
from ertis_numba.documents import TomlTable
from ertis_numba.errors import ArgumentError
from ertis_numba.settings.windows import parse_window

__all__ = ["MAX_LISTED_DIRECTIONS", "Processing"]

MAX_LISTED_DIRECTIONS: Final = 1000
"""Limit on the directions in the settings themselves, which recordings and messages hold as text."""


class Processing(TomlTable, frozen=True, kw_only=True):
    """How a measurement becomes an energyscape.

    Attributes
    ----------
    method : {"fast", "paper"}
        ``fast``: analytic signals, beams at the output ranges only. ``paper``: the algorithm of the
        2019 paper, for comparison.
    directions : str or list of (azimuth, elevation)
        A grid: ``90``, ``1850``, ``3000``, ``2d:N``, ``3d:N``, or the path of a CSV file. Or up to 1000 directions in
        degrees; in Python also as an array of shape (n, 2).
    azimuth_limits_deg, elevation_limits_deg : (low, high)
        Limits of the grids that are named by a count (``2d:N`` and ``3d:N``).
    range_m : (first, last)
        Window of the range axis.
    range_decimation : int
        Samples of the record per range of the energyscape.
    band_edges_hz : (low, high), optional
        Frequencies below and above the call's band at which the matched filter reaches 0. By default, each lies 5 kHz
        outside the band, or half of the band's lowest frequency if that is less; see ``docs/accuracy.md``.
    decimation : int, optional
        Samples of the record per signal sample, a divisor of ``range_decimation``. By default the largest that
        suits the method and the call's band; see `Settings.decimation`.
    wavefront : {"plane", "spherical", "auto"}
        What an echo looks like to the array: ``plane`` as the paper has it, ``spherical`` focuses on each
        range, which matters nearer than some ten apertures. ``auto`` is ``spherical`` if plane wavefronts exceed the
        error budget at the first range, and ``plane`` otherwise and for adaptive beamformers.
    beamformer : {"delay_and_sum", "coherence_factor", "dmas", "capon"}
        How microphones are combined; ``docs/beamformers.md`` tells what each is good for. All but the first need
        the fast method and plane wavefronts.
    dmas_order : int
        How many microphones ``dmas`` multiplies at a time, 2 to 8.
    snapshots : int
        Ranges from which ``capon`` learns what else is heard, 1 to 32.
    array_weights : str or list of float
        Weights of microphones, scaled to a mean of 1: ``uniform``; a window of the distance from the centre of the
        array, ``cosine``, ``hann``, ``hamming``, ``blackman``, ``taylor:DB`` (20 to 80 dB, 30 by default) or
        ``kaiser:BETA`` (0 to 20, 6 by default); or one number per channel, not below 0. For delay_and_sum only; see
        ``docs/beamformers.md``.
    loading : float
        White noise that ``capon`` reckons with, by the mean power of a microphone; the more, the more it is
        like delay-and-sum.
    """

    method: Literal["fast", "paper"] = "fast"
    directions: str | tuple[tuple[float, float], ...] = "90"
    azimuth_limits_deg: tuple[float, float] = (-90.0, 90.0)
    elevation_limits_deg: tuple[float, float] = (-90.0, 90.0)
    range_m: tuple[float, float] = (0.5, 5.0)
    range_decimation: int = 100
    band_edges_hz: tuple[float, float] | None = None
    decimation: int | None = None
    wavefront: Literal["plane", "spherical", "auto"] = "plane"
    beamformer: Literal["delay_and_sum", "coherence_factor", "dmas", "capon"] = "delay_and_sum"
    dmas_order: int = 2
    snapshots: int = 5
    diagonal_loading: float = 1.0
    array_weights: str | tuple[float, ...] = "uniform"

    def __post_init__(self) -> None:
        shape = getattr(self.directions, "shape", None)  # of an array, before its rows become tuples
        if shape is not None and shape[1:] != (2,):
            raise ArgumentError(
                f"processing.directions has shape {shape}; give azimuth and elevation in degrees, of shape (n, 2)"
            )
        super().__post_init__()
        checks.choice("processing.method", self.method, ("fast", "paper"))
        self._check_directions()
        checks.interval("processing.azimuth_limits_deg", self.azimuth_limits_deg, -180.0, 180.0)
        checks.interval("processing.elevation_limits_deg", self.elevation_limits_deg, -90.0, 90.0)
        checks.interval("processing.range_m", self.range_m, 0.0, 10_000.0)
        checks.integer("processing.range_decimation", self.range_decimation, 1, 10_000)
        if self.band_edges_hz is not None:
            checks.interval("processing.band_edges_hz", self.band_edges_hz, 0.0, 1e9)
            if self.method == "paper":
                raise ArgumentError(
                    "processing.band_edges_hz is for the fast method only; leave it out, or give processing.method "
                    "'fast'"
                )
        if self.decimation is not None:
            checks.integer("processing.decimation", self.decimation, 1, 1000)
            if self.range_decimation % self.decimation:
                raise ArgumentError(
                    f"processing.decimation is {self.decimation}; give a divisor of processing.range_decimation "
                    f"({self.range_decimation})"
                )
        checks.choice("processing.wavefront", self.wavefront, ("plane", "spherical", "auto"))
        if self.wavefront != "plane" and self.method == "paper":
            raise ArgumentError(
                f"processing.wavefront is {self.wavefront!r}, which the paper's method knows nothing of; give 'plane'"
            )
        self._check_beamformer()
        self._check_array_weights()

    def _check_directions(self) -> None:
        given = self.directions
        if isinstance(given, str):
            checks.length("processing.directions", given, MAX_NAME_LENGTH)
            return
        if not 1 <= len(given) <= MAX_LISTED_DIRECTIONS:
            raise ArgumentError(
                f"processing.directions lists {len(given)} directions; give 1 to {MAX_LISTED_DIRECTIONS}, or more of "
                "them in a CSV file"
            )
        for row, (azimuth_deg, elevation_deg) in enumerate(given):
            checks.between(f"azimuth of processing.directions[{row}] in degrees", azimuth_deg, -360.0, 360.0)
            checks.between(f"elevation of processing.directions[{row}] in degrees", elevation_deg, -90.0, 90.0)

    def _check_array_weights(self) -> None:
        """Refuse weights that are negative, and any but uniform ones for adaptive beamformers."""
        given = self.array_weights
        if isinstance(given, str):
            parse_window(given)
        elif not 1 <= len(given) <= MAX_MICROPHONES:
            raise ArgumentError(f"processing.array_weights has {len(given)} numbers; give one for each channel")
        else:
            for channel, weight in enumerate(given):
                checks.between(f"processing.array_weights[{channel}]", weight, 0.0, 1e6)
        if given != "uniform" and self.beamformer != "delay_and_sum":
            raise ArgumentError(
                f"processing.array_weights is {_shortened(given)}, but processing.beamformer {self.beamformer!r} "
                "supports only 'uniform'; leave array_weights out, or give processing.beamformer 'delay_and_sum'"
            )

    def _check_beamformer(self) -> None:
        """Refuse what no beamformer can do, and what delay-and-sum alone can."""
        checks.choice("processing.beamformer", self.beamformer, ("delay_and_sum", "coherence_factor", "dmas", "capon"))
        checks.integer("processing.dmas_order", self.dmas_order, 2, 8)
        checks.integer("processing.snapshots", self.snapshots, 1, 32)
        checks.between("processing.diagonal_loading", self.diagonal_loading, 1e-6, 1e6)
        if self.beamformer == "delay_and_sum":
            return
        for name, value, remedy in (("method", "paper", "'fast'"), ("wavefront", "spherical", "'plane'")):
            if getattr(self, name) == value:
                raise ArgumentError(
                    f"processing.{name} is {value!r}, which can delay_and_sum only; give {remedy} with "
                    f"processing.beamformer {self.beamformer!r}"
                )


def _shortened(weights: str | tuple[float, ...]) -> str:
    return repr(weights) if isinstance(weights, str) else f"a list of {len(weights)} numbers"

"""Processing of a measurement into an energyscape."""

import math
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from ertis_numba.base import checks
from ertis_numba.base.constants import MAX_MICROPHONES, MAX_NAME_LENGTH
from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.settings.array_windows import parse_window
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS, BeamformerName, WeightingName
from ertis_numba.settings.delay_lists import check_delays
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.fir_filters import FILTERS, FirFilters, check_taps
from ertis_numba.settings.limits import CLEANING_DB, Limits
from ertis_numba.settings.preset_files import preset_tables
from ertis_numba.settings.waveform import read_waveform

__all__ = ["MAX_LISTED_DIRECTIONS", "STAGES", "Processing"]

MAX_LISTED_DIRECTIONS: Final = 1000
"""Limit on the directions that settings list; recordings and messages hold settings as text."""

_ListedAzimuth = Annotated[float, Limits(-360.0, 360.0, "azimuth of {} in degrees")]
_ListedElevation = Annotated[float, Limits(-90.0, 90.0, "elevation of {} in degrees")]

STAGES: Final = ("demodulation", "matched_filter", "beams", "envelope")
"""Steps of processing after which it may end."""


class Processing(TomlTable, frozen=True, kw_only=True):
    """Processing of a measurement into an energyscape.

    The properties ``azimuth_limits_rad`` and ``elevation_limits_rad`` are the limits in radians.

    Attributes
    ----------
    mode : {"auto", "active", "passive"}, default "auto"
        ``active`` makes images of echoes, and ``passive`` acoustic maps of other sound. ``auto`` makes acoustic maps of
        measurements without a call only. With ``passive``, the call does not have to fit the record.
    method : {"fast", "paper"}, default "fast"
        ``fast`` uses analytic signals and computes beams at the output ranges only. ``paper`` is the algorithm of the
        2019 paper, for comparison.
    directions : str or list of (azimuth, elevation), default "90"
        Direction grid: ``90``, ``1850``, ``3000``, ``2d:N``, ``3d:N``, or the path of a CSV file. Or up to 1000
        directions in degrees; in Python also as an array of shape (n, 2).
    azimuth_limits_deg, elevation_limits_deg : (low, high), default (-90, 90)
        Limits of grids with a count (``2d:N`` and ``3d:N``) in degrees.
    elevation_deg : float, default 0
        Elevation of all directions of ``2d:N`` in degrees.
    level_directions : bool, default False
        Turn the directions by the roll and pitch of each measurement's pose, so that azimuth and elevation refer to the
        horizontal plane; see ``docs/how-to/motion.md``.
    range_m : (first, last), default (0.5, 5)
        First and last range in metres.
    range_decimation : int, default 100
        Samples of the record per range of the energyscape.
    band_edges_hz : (low, high), optional, default None
        Frequencies in hertz, below and above the call's band, at which the matched filter reaches 0. By default, each
        lies 5 kHz outside the band, or half of the band's lowest frequency if that is less; see
        ``docs/explanation/accuracy.md``.
    decimation : int, optional, default None
        Samples of the record per signal sample, a divisor of ``range_decimation``. By default the largest
        divisor that suits the method and the call's band; see `Settings.decimation`.
    wavefront : {"plane", "spherical", "auto"}, default "auto"
        Shape of an echo's wavefront. ``plane`` is that of the paper. ``spherical`` focuses on each range, which matters
        at ranges below some ten apertures. ``auto`` chooses ``spherical`` if plane wavefronts exceed the error budget
        at the first range, and ``plane`` otherwise. For the paper's method, capon, own delays, and settings or memory
        that exclude a plan for spherical wavefronts, it also chooses ``plane``.
    beamformer : str, default "delay_and_sum"
        Combination of the delayed signals, one of `BEAMFORMERS`; ``docs/explanation/beamformers.md`` compares them. All
        except delay_and_sum need the fast method, and capon also plane wavefronts.
    weighting : {"none", "coherence_factor"}, default "none"
        Factor from 0 to 1 that multiplies each amplitude, one of `WEIGHTINGS`. ``coherence_factor`` is the share of
        the power that agrees between the microphones. It needs the fast method.
    dmas_order : int, default 2
        Number of microphone signals that ``dmas`` multiplies at a time, 2 to 8.
    snapshots : int, default 5
        Ranges from which ``capon`` estimates its covariance matrix, 1 to 32.
    array_weights : str or list of float, default "uniform"
        Weights of the microphones, scaled to a mean of 1: ``uniform``; a window of the distance from the centre of the
        array, ``cosine``, ``hann``, ``hamming``, ``blackman``, ``taylor:DB`` (20 to 80 dB, 30 by default) or
        ``kaiser:BETA`` (0 to 20, 6 by default); or one number per channel, not below 0. For delay_and_sum only; see
        ``docs/explanation/beamformers.md``.
    clean_within_db : float, optional, default None
        Largest level below the strongest direction of the same range in dB; weaker amplitudes become 0. Half of
        the strongest amplitude is 6.02 dB. No such limit by default; see ``docs/how-to/plots.md``.
    clean_above_mean_db : float, optional, default None
        Smallest level above the mean amplitude over the directions of a range in dB; weaker amplitudes become
        0. Twice the mean is 6.02 dB. No such limit by default.
    pre_filter, post_filter : str or list of float, default []
        Taps of own FIR filters, 1 to 1024, or the name of a CSV or NPY file with them. ``pre_filter`` filters the
        signals of the microphones, ``post_filter`` the beams, which only delay_and_sum has. Both are combined with the
        matched filter and cost no time. Their mean group delay (half of their length, if the taps are symmetric) and
        their gain are compensated: the amplitude of an echo stays the same unless they distort phases. They need the
        fast method.
    filter_rate_hz : float, optional, default None
        Sample rate for which the taps of both filters are designed, more than twice the call's highest frequency; by
        default that of the signals, `Settings.signal_rate_hz`.
    delay_matrix : str or list of list of float, default []
        Delays of sound in samples of ``delay_rate_hz``, in place of those of plane waves: a row for each direction with
        a number for each channel, or the name of a CSV or NPY file with them. Only differences between microphones
        matter. Up to 20000 numbers in settings; any number in a file. For delay_and_sum and plane wavefronts only; see
        ``docs/how-to/own-array.md``.
    delay_rate_hz : float, optional, default None
        Sample rate of ``delay_matrix``; by default that of the signals, `Settings.signal_rate_hz`.
    last_stage : {"demodulation", "matched_filter", "beams", "envelope"}, default "envelope"
        Last step of processing. Each stage but ``envelope``, which yields images, yields signals: see
        `Pipeline.result` and ``docs/how-to/numpy.md``. ``beams`` needs the fast method and delay_and_sum.
    diagonal_loading : float, default 1
        Diagonal loading of ``capon`` relative to the mean power of a microphone, 1e-6 to 1e6. Larger values approach
        delay-and-sum.
    """

    mode: Literal["auto", "active", "passive"] = "auto"
    method: Literal["fast", "paper"] = "fast"
    directions: str | tuple[tuple[_ListedAzimuth, _ListedElevation], ...] = "90"
    azimuth_limits_deg: Annotated[tuple[float, float], Limits(-180.0, 180.0)] = (-90.0, 90.0)
    elevation_limits_deg: Annotated[tuple[float, float], Limits(-90.0, 90.0)] = (-90.0, 90.0)
    elevation_deg: Annotated[float, Limits(-90.0, 90.0)] = 0.0
    level_directions: bool = False
    range_m: Annotated[tuple[float, float], Limits(0.0, 10_000.0)] = (0.5, 5.0)
    range_decimation: Annotated[int, Limits(1, 10_000)] = 100
    band_edges_hz: Annotated[tuple[float, float], Limits(0.0, 1e9)] | None = None
    decimation: Annotated[int, Limits(1, 1000)] | None = None
    wavefront: Literal["plane", "spherical", "auto"] = "auto"
    beamformer: BeamformerName = "delay_and_sum"
    weighting: WeightingName = "none"
    dmas_order: int = 2
    snapshots: int = 5
    diagonal_loading: float = 1.0
    array_weights: str | tuple[Annotated[float, Limits(0.0, 1e6)], ...] = "uniform"
    clean_within_db: Annotated[float, CLEANING_DB] | None = None
    clean_above_mean_db: Annotated[float, CLEANING_DB] | None = None
    pre_filter: str | tuple[float, ...] = ()
    post_filter: str | tuple[float, ...] = ()
    filter_rate_hz: Annotated[float, Limits(1.0, 1e9)] | None = None
    delay_matrix: str | tuple[tuple[float, ...], ...] = ()
    delay_rate_hz: Annotated[float, Limits(1.0, 1e9)] | None = None
    last_stage: Literal["demodulation", "matched_filter", "beams", "envelope"] = "envelope"

    @classmethod
    def from_preset(cls, name: str) -> Self:
        """Return the directions and ranges of a processing preset; all else has its default.

        Parameters
        ----------
        name : str
            One of ``ertis.presets("processing")``, such as ``2d_181_5m`` for 181 directions in the horizontal plane and
            ranges from 0.5 to 5 m. Names of RTIS Dev, such as ``2D_5m_181``, are accepted, too.

        Raises
        ------
        ArgumentError
            The preset is unknown, or a recording preset.

        Examples
        --------
        >>> from ertis_numba.settings import Processing
        >>> Processing.from_preset("2d_181_5m").directions
        '2d:181'
        """
        return cls(**preset_tables(name, "processing")["processing"])

    @property
    def is_adaptive(self) -> bool:
        """True if amplitudes depend on the agreement of the microphones: all except unweighted delay-and-sum."""
        return self.beamformer != "delay_and_sum" or self.weighting != "none"

    @property
    def is_cleaned(self) -> bool:
        """True if weak amplitudes of each range become 0."""
        return self.clean_within_db is not None or self.clean_above_mean_db is not None

    @property
    def azimuth_limits_rad(self) -> tuple[float, float]:
        """Limits of the azimuth in radians."""
        return math.radians(self.azimuth_limits_deg[0]), math.radians(self.azimuth_limits_deg[1])

    @property
    def elevation_limits_rad(self) -> tuple[float, float]:
        """Limits of the elevation in radians."""
        return math.radians(self.elevation_limits_deg[0]), math.radians(self.elevation_limits_deg[1])

    def __post_init__(self) -> None:
        shape = getattr(self.directions, "shape", None)  # of an array, before its rows become tuples
        if shape is not None and shape[1:] != (2,):
            raise ArgumentError(
                f"processing.directions has shape {shape}; use azimuth and elevation in degrees, of shape (n, 2)"
            )
        if str(self.beamformer) in WEIGHTINGS:
            raise ArgumentError(
                f"processing.beamformer {self.beamformer!r} is a weighting; set it as processing.weighting, with"
                f" one of the beamformers {', '.join(BEAMFORMERS)}"
            )
        super().__post_init__()
        self._check_directions()
        if self.band_edges_hz is not None and self.method == "paper":
            raise ArgumentError(
                "processing.band_edges_hz is not supported by processing.method 'paper'; leave it out, or use method "
                "'fast'"
            )
        if self.decimation is not None and self.range_decimation % self.decimation:
            raise ArgumentError(
                f"processing.decimation is {self.decimation}; use a divisor of processing.range_decimation "
                f"({self.range_decimation})"
            )
        if self.wavefront == "spherical" and self.method == "paper":
            raise ArgumentError(
                "processing.wavefront is 'spherical', but processing.method 'paper' supports only plane wavefronts; "
                "use 'plane', or method 'fast'"
            )
        self._check_beamformer()
        self._check_array_weights()
        self._check_filters()
        self._check_delays()
        if self.last_stage == "beams":
            self.require_beams("processing.last_stage is 'beams'")

    def _check_directions(self) -> None:
        given = self.directions
        if isinstance(given, str):
            checks.length("processing.directions", given, MAX_NAME_LENGTH)
            return
        if not 1 <= len(given) <= MAX_LISTED_DIRECTIONS:
            raise ArgumentError(
                f"processing.directions lists {len(given)} directions; use 1 to {MAX_LISTED_DIRECTIONS}, or more of "
                "them in a CSV file"
            )

    def _check_array_weights(self) -> None:
        """Refuse weights that are negative, and any but uniform ones for adaptive beamformers."""
        given = self.array_weights
        if isinstance(given, str):
            parse_window(given)
        elif not 1 <= len(given) <= MAX_MICROPHONES:
            raise ArgumentError(f"processing.array_weights has {len(given)} numbers; use one number for each channel")
        if given != "uniform" and self.is_adaptive:
            raise ArgumentError(
                f"processing.array_weights is {_shortened(given)}, but {self._adaptive_part} supports only 'uniform'; "
                "leave array_weights out, or use processing.beamformer 'delay_and_sum' and weighting 'none'"
            )

    def _check_beamformer(self) -> None:
        """Refuse options of beamformers that are out of range, and those that only delay-and-sum supports."""
        for option in (option for each in BEAMFORMERS.values() for option in each.options):
            value = getattr(self, option.name)
            option.limits.checker(type(option.limits.low))(f"processing.{option.name}", value)
        if self.is_adaptive and self.method == "paper":
            raise ArgumentError(
                "processing.method is 'paper', which supports only processing.beamformer 'delay_and_sum' and weighting "
                f"'none'; use 'fast' with {self._adaptive_part}"
            )
        beamformer = BEAMFORMERS[self.beamformer]
        if self.wavefront == "spherical" and not beamformer.streams(*beamformer.values(self)):
            raise ArgumentError(
                f"processing.wavefront is 'spherical', which processing.beamformer {self.beamformer!r} does not "
                "support; use 'plane', or another processing.beamformer"
            )

    def _check_filters(self) -> None:
        """Refuse filters that cannot be used, by themselves or with the method and the beamformer."""
        for name in FILTERS:
            taps = getattr(self, name)
            if isinstance(taps, tuple):
                check_taps(f"processing.{name}", taps)
            if taps and self.method == "paper":
                raise ArgumentError(
                    f"processing.{name} is not supported by processing.method 'paper'; leave it out, or use method "
                    "'fast'"
                )
        if self.post_filter and self.is_adaptive:
            raise ArgumentError(
                f"processing.post_filter filters beams, but {self._adaptive_part} combines signals to amplitudes; "
                "leave it out, or use processing.beamformer 'delay_and_sum' and weighting 'none'"
            )

    def _check_delays(self) -> None:
        """Refuse delays that settings cannot hold, and those that beamformer or wavefront do not support."""
        given = self.delay_matrix
        if not given:
            return
        if self.level_directions:
            raise ArgumentError(
                "processing.level_directions is true, but the delays of processing.delay_matrix cannot be turned; "
                "leave one out"
            )
        if not isinstance(given, str):
            check_delays(given)
        if self.is_adaptive or self.wavefront == "spherical":
            part = self._adaptive_part if self.is_adaptive else "processing.wavefront 'spherical'"
            raise ArgumentError(
                f"processing.delay_matrix is given, which {part} does not support; leave it out, or use beamformer "
                "'delay_and_sum', weighting 'none' and wavefront 'plane'"
            )

    def filters(self, signal_rate_hz: float) -> FirFilters | None:
        """Return the own filters; None without any.

        Parameters
        ----------
        signal_rate_hz : float
            Rate of the taps unless ``filter_rate_hz`` is given.

        Raises
        ------
        ArgumentError
            The file of a filter has not been read.
        """
        rate_hz = self.filter_rate_hz or signal_rate_hz
        return FirFilters.of({name: getattr(self, name) for name in FILTERS}, rate_hz=rate_hz)

    def resolve_paths(self, folder: Path) -> Self:
        """Return processing whose directions and delays are relative to a folder, with the taps of filters there.

        Raises
        ------
        SettingsError
            A file cannot be read, or its taps cannot be used.
        """
        changes: dict[str, Any] = {}
        if isinstance(self.directions, str) and Path(self.directions).suffix.lower() == ".csv":
            changes["directions"] = str(folder / self.directions)
        if self.delay_matrix and isinstance(self.delay_matrix, str):
            changes["delay_matrix"] = str(folder / self.delay_matrix)
        for name in FILTERS:
            if isinstance(given := getattr(self, name), str):
                changes[name], _ = read_waveform(folder / given, key=f"processing.{name}")
        try:
            return self.replace(**changes)
        except ArgumentError as error:
            raise SettingsError(f"{folder}: {error}") from error

    def require_image(self) -> None:
        """Refuse a last stage that yields no image.

        Raises
        ------
        ArgumentError
            The last stage is not ``envelope``.
        """
        if self.last_stage != "envelope":
            raise ArgumentError(
                f"processing.last_stage is {self.last_stage!r}, which yields no image; use 'envelope', or call "
                "Pipeline.result for the result of that stage"
            )

    def require_sensor_frame(self, reason: str) -> None:
        """Refuse directions that refer to the horizontal plane, where those of the sensor are needed.

        Parameters
        ----------
        reason : str
            Reason in the error.

        Raises
        ------
        ArgumentError
            ``level_directions`` is true.
        """
        if self.level_directions:
            raise ArgumentError(
                f"processing.level_directions is true, but {reason}; process again without levelled "
                "directions (level_directions)"
            )

    def require_beams(self, wanted: str) -> None:
        """Refuse a method or beamformer without beams.

        Parameters
        ----------
        wanted : str
            Reason for which beams are needed, as the start of the error.

        Raises
        ------
        ArgumentError
            The method is ``paper``, or amplitudes are adaptive.
        """
        if self.method == "paper":
            raise ArgumentError(f"{wanted}, but processing.method 'paper' returns none; use method 'fast'")
        if self.is_adaptive:
            raise ArgumentError(
                f"{wanted}, but {self._adaptive_part} combines signals to amplitudes without a phase; use "
                "processing.beamformer 'delay_and_sum' and weighting 'none'"
            )

    @property
    def _adaptive_part(self) -> str:
        """Beamformer or weighting that makes amplitudes adaptive, as named in errors."""
        if self.beamformer != "delay_and_sum":
            return f"processing.beamformer {self.beamformer!r}"
        return f"processing.weighting {self.weighting!r}"


def _shortened(weights: str | tuple[float, ...]) -> str:
    return repr(weights) if isinstance(weights, str) else f"a list of {len(weights)} numbers"

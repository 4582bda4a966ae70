"""Everything that can be chosen, as frozen structures with TOML in and out.

A structure checks itself once, when it is made; whoever holds one may rely on it. Unknown keys are
refused. ``Settings()`` is the default eRTIS measurement; ``Settings.from_preset`` knows the RTIS
recording presets.
"""

import math
from typing import Any, Literal, Self

import numpy as np

from ertis_numba import checks
from ertis_numba.constants import (
    ERTIS_PDM_RATE_HZ,
    MAX_MICROPHONES,
    STANDARD_HUMIDITY_PERCENT,
    STANDARD_PRESSURE_PA,
    STANDARD_TEMPERATURE_C,
    WORD_BITS,
)
from ertis_numba.documents import Document, Table
from ertis_numba.errors import ArgumentError

__all__ = [
    "ERROR_PRESETS_DB",
    "INTERPOLATIONS",
    "MOST_ZONES",
    "PRESETS",
    "Accuracy",
    "Air",
    "Array",
    "Call",
    "Processing",
    "Recording",
    "Settings",
]

_WORDS = {"short": 65_536, "default": 163_840, "long": 294_912}
_FARTHEST_M = 10.0  # of a microphone from the origin: millimetres given for metres go beyond it
_MOST_SAMPLES = 2**28  # a minute of ultrasound; positions stay within 32 bits
_SLOWEST_AIR_M_S = 300.0  # a little under sound at -40 °C
_BANDS_HZ = {"20_80": (20_000.0, 80_000.0), "25_50": (25_000.0, 50_000.0)}
_MOST_DECIMATION = 100  # more would need a longer low pass than 16-bit taps can hold
_WASTE = 8  # times the signal rate that is needed: beyond, somebody has made a mistake
_NARROWEST_HZ = 100.0  # a narrower band pass would ring for seconds
_LEAST_RATE = {"fast": 4.4, "paper": 5.5}  # signal rate by the call's highest frequency
INTERPOLATIONS = {"fitted": None, "nearest": 1, "carrier": 1, "linear": 2, "cubic": 4}
"""Ways of making a delayed sample, and how many samples each takes; None where that is a choice."""

ERROR_PRESETS_DB = {"draft": -20.0, "standard": -35.0, "fine": -60.0, "exact": -100.0}
"""Error budgets by name."""

MOST_ZONES = 1_000_000
"""More steps of curvature than an image has ranges, even near the array."""

PRESETS = tuple(f"{length}_{band}" for length in _WORDS for band in _BANDS_HZ)
"""Names of the RTIS recording presets: length of the record and band of the call."""


class Array(Table, frozen=True, kw_only=True):
    """Where the microphones are and how their bits lie in a word.

    Attributes
    ----------
    layout : str
        Name of a shipped layout, or the path of a layout file (.toml, .csv). When
        ``positions_m`` is given it is only a label.
    positions_m : tuple of (x, y, z), optional
        Positions in the sensor frame, one per channel, in the order of the bits.
    enabled : tuple of bool, optional
        Channels that carry a microphone; all of them by default.
    gain : tuple of float, optional
        Calibrated sensitivity of each channel, 1 by default; its signal is divided by it.
    delay_s : tuple of float, optional
        Calibrated lateness of each channel, 0 by default; it is taken out.
    word_bits : {8, 16, 32, 64}
        Size of one PDM word. An array with more channels uses several words per sample.
    """

    layout: str = "eRTIS_v3D1"
    positions_m: tuple[tuple[float, float, float], ...] | None = None
    enabled: tuple[bool, ...] | None = None
    gain: tuple[float, ...] | None = None
    delay_s: tuple[float, ...] | None = None
    word_bits: int = 32

    def __post_init__(self) -> None:
        checks.choice("array.word_bits", checks.whole("array.word_bits", self.word_bits, 1), WORD_BITS)
        if self.positions_m is None:
            for name in ("enabled", "gain", "delay_s"):
                if getattr(self, name) is not None:
                    raise ArgumentError(f"array.{name} is given without array.positions_m; give both or neither")
            return
        n_channels = checks.whole("number of array.positions_m", len(self.positions_m), 1, MAX_MICROPHONES)
        for channel, position_m in enumerate(self.positions_m):
            checks.shape(f"array.positions_m[{channel}]", np.shape(position_m), (3,))
        checks.finite_array("array.positions_m", np.asarray(self.positions_m, dtype=np.float64))
        for channel, position in enumerate(self.positions_m):
            for coordinate_m in position:
                checks.between(f"array.positions_m[{channel}]", coordinate_m, -_FARTHEST_M, _FARTHEST_M)
        if self.enabled is not None:
            checks.shape("array.enabled", (len(self.enabled),), (n_channels,))
            if not any(self.enabled):
                raise ArgumentError("array.enabled is false for every channel; enable at least one")
        self._check_each("gain", 1e-3, 1e3)
        self._check_each("delay_s", -1e-3, 1e-3)

    def _check_each(self, name: str, low: float, high: float) -> None:
        """Refuse a list that has not one number in ``[low, high]`` for each channel."""
        values = getattr(self, name)
        if values is not None:
            checks.shape(f"array.{name}", (len(values),), (len(self.positions_m or ()),))
            for channel, value in enumerate(values):
                checks.between(f"array.{name}[{channel}]", value, low, high)


class Call(Table, frozen=True, kw_only=True):
    """The emitted sweep: hyperbolic frequency modulation with a Hann ramp at both ends.

    Attributes
    ----------
    start_frequency_hz, stop_frequency_hz : float
        First and last instantaneous frequency; eRTIS sweeps downwards.
    duration_s : float
    sample_rate_hz : float
        Rate of the converter that plays the call.
    ramp_fraction : float
        Share of the call under the Hann ramp at each end, 0 to 0.5.
    """

    start_frequency_hz: float = 50_000.0
    stop_frequency_hz: float = 25_000.0
    duration_s: float = 2.5e-3
    sample_rate_hz: float = 450_000.0
    ramp_fraction: float = 0.1

    def __post_init__(self) -> None:
        checks.positive("call.sample_rate_hz", self.sample_rate_hz)
        for name in ("start_frequency_hz", "stop_frequency_hz"):
            frequency_hz = checks.positive(f"call.{name}", getattr(self, name))
            if frequency_hz >= self.sample_rate_hz / 2:
                raise ArgumentError(
                    f"call.{name} is {frequency_hz:g}; give less than half of call.sample_rate_hz "
                    f"({self.sample_rate_hz:g})"
                )
        if self.start_frequency_hz == self.stop_frequency_hz:
            raise ArgumentError(
                f"call sweeps from {self.start_frequency_hz:g} Hz to itself; give two different frequencies"
            )
        checks.between("call.duration_s", self.duration_s, 16 / self.sample_rate_hz, 1.0)
        if self.duration_s * self.low_frequency_hz < 1:
            raise ArgumentError(
                f"call.duration_s is {self.duration_s:g}, less than a period of {self.low_frequency_hz:g} Hz; "
                f"give {1 / self.low_frequency_hz:g} or more"
            )
        checks.between("call.ramp_fraction", self.ramp_fraction, 0.0, 0.5)

    @property
    def low_frequency_hz(self) -> float:
        """Lower edge of the band."""
        return min(self.start_frequency_hz, self.stop_frequency_hz)

    @property
    def high_frequency_hz(self) -> float:
        """Upper edge of the band."""
        return max(self.start_frequency_hz, self.stop_frequency_hz)


class Recording(Table, frozen=True, kw_only=True):
    """How much is recorded: PDM clock and number of samples of one measurement."""

    pdm_rate_hz: float = ERTIS_PDM_RATE_HZ
    n_samples: int = _WORDS["default"]

    def __post_init__(self) -> None:
        checks.between("recording.pdm_rate_hz", self.pdm_rate_hz, 1e3, 1e9)
        checks.whole("recording.n_samples", self.n_samples, 1, _MOST_SAMPLES)

    @property
    def duration_s(self) -> float:
        """Length of one measurement."""
        return self.n_samples / self.pdm_rate_hz


class Air(Table, frozen=True, kw_only=True):
    """The medium, which sets the speed of sound."""

    temperature_c: float = STANDARD_TEMPERATURE_C
    humidity_percent: float = STANDARD_HUMIDITY_PERCENT
    pressure_pa: float = STANDARD_PRESSURE_PA

    def __post_init__(self) -> None:
        checks.between("air.temperature_c", self.temperature_c, -40.0, 60.0)
        checks.between("air.humidity_percent", self.humidity_percent, 0.0, 100.0)
        checks.between("air.pressure_pa", self.pressure_pa, 10_000.0, 200_000.0)


class Processing(Table, frozen=True, kw_only=True):
    """How a measurement becomes an energyscape.

    Attributes
    ----------
    method : {"fast", "paper"}
        ``fast``: analytic signals, beams at the output ranges only. ``paper``: the algorithm of the
        2019 paper, for comparison.
    directions : str
        A grid: ``90``, ``1850``, ``3000``, ``2d:N``, ``3d:N``, or the path of a CSV file.
    azimuth_limits_deg, elevation_limits_deg : (low, high)
        Limits of the grids that are named by a count (``2d:N`` and ``3d:N``).
    range_m : (first, last)
        Window of the range axis.
    range_decimation : int
        PDM samples per range of the energyscape.
    decimation : int, optional
        PDM samples per signal sample, a divisor of ``range_decimation``. By default the largest that
        suits the method and the call's band; see `Settings.decimation`.
    wavefront : {"plane", "spherical"}
        What an echo looks like to the array: ``plane`` as the paper has it, ``spherical`` focuses on each
        range, which matters nearer than some ten apertures.
    beamformer : {"delay_and_sum", "coherence_factor", "dmas", "capon"}
        How microphones are combined; ``docs/beamformers.md`` tells what each is good for. All but the first need
        the fast method and plane wavefronts.
    dmas_order : int
        How many microphones ``dmas`` multiplies at a time, 2 to 8.
    snapshots : int
        Ranges from which ``capon`` learns what else is heard, 1 to 32.
    loading : float
        White noise that ``capon`` reckons with, by the mean power of a microphone; the more, the more it is
        like delay-and-sum.
    """

    method: Literal["fast", "paper"] = "fast"
    directions: str = "90"
    azimuth_limits_deg: tuple[float, float] = (-90.0, 90.0)
    elevation_limits_deg: tuple[float, float] = (-90.0, 90.0)
    range_m: tuple[float, float] = (0.5, 5.0)
    range_decimation: int = 100
    decimation: int | None = None
    wavefront: Literal["plane", "spherical"] = "plane"
    beamformer: Literal["delay_and_sum", "coherence_factor", "dmas", "capon"] = "delay_and_sum"
    dmas_order: int = 2
    snapshots: int = 5
    loading: float = 1.0

    def __post_init__(self) -> None:
        checks.choice("processing.method", self.method, ("fast", "paper"))
        checks.interval("processing.azimuth_limits_deg", self.azimuth_limits_deg, -180.0, 180.0)
        checks.interval("processing.elevation_limits_deg", self.elevation_limits_deg, -90.0, 90.0)
        checks.interval("processing.range_m", self.range_m, 0.0, 10_000.0)
        checks.whole("processing.range_decimation", self.range_decimation, 1, 10_000)
        if self.decimation is not None:
            checks.whole("processing.decimation", self.decimation, 1, 1000)
            if self.range_decimation % self.decimation:
                raise ArgumentError(
                    f"processing.decimation is {self.decimation}; give a divisor of processing.range_decimation "
                    f"({self.range_decimation})"
                )
        checks.choice("processing.wavefront", self.wavefront, ("plane", "spherical"))
        if self.wavefront == "spherical" and self.method == "paper":
            raise ArgumentError(
                "processing.wavefront is 'spherical', which the paper's method knows nothing of; give 'plane'"
            )
        self._check_beamformer()

    def _check_beamformer(self) -> None:
        """Refuse what no beamformer can do, and what delay-and-sum alone can."""
        checks.choice("processing.beamformer", self.beamformer, ("delay_and_sum", "coherence_factor", "dmas", "capon"))
        checks.whole("processing.dmas_order", self.dmas_order, 2, 8)
        checks.whole("processing.snapshots", self.snapshots, 1, 32)
        checks.between("processing.loading", self.loading, 1e-6, 1e6)
        if self.beamformer == "delay_and_sum":
            return
        for name, value, remedy in (("method", "paper", "'fast'"), ("wavefront", "spherical", "'plane'")):
            if getattr(self, name) == value:
                raise ArgumentError(
                    f"processing.{name} is {value!r}, which can delay_and_sum only; give {remedy} with "
                    f"processing.beamformer {self.beamformer!r}"
                )


class Accuracy(Table, frozen=True, kw_only=True):
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
    stop_band_db : float, optional
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
    stop_band_db: float | None = None
    zones: int | None = None

    def __post_init__(self) -> None:
        checks.between("accuracy.max_error_db", self.max_error_db, -200.0, 0.0)
        checks.choice("accuracy.precision", self.precision, ("auto", "float32", "int16"))
        checks.choice("accuracy.interpolation", self.interpolation, INTERPOLATIONS)
        for name, low, high in (("oversampling", 1, 64), ("delay_taps", 1, 8), ("zones", 1, MOST_ZONES)):
            if getattr(self, name) is not None:
                checks.whole(f"accuracy.{name}", getattr(self, name), low, high)
        if self.beam_taps is not None:
            checks.choice("accuracy.beam_taps", self.beam_taps, (0, 2, 4, 6))
        for name, least, most in (("beam_density", 1.1, 8.0), ("stop_band_db", 40.0, 140.0)):
            if getattr(self, name) is not None:
                checks.between(f"accuracy.{name}", getattr(self, name), least, most)
        implied = INTERPOLATIONS[self.interpolation]
        if implied is not None and self.delay_taps not in {None, implied}:
            raise ArgumentError(
                f"accuracy.delay_taps is {self.delay_taps}, but interpolation {self.interpolation!r} takes {implied}; "
                "leave it out"
            )


class Settings(Document, frozen=True, kw_only=True):
    """All settings of one sensor: the whole content of a settings file."""

    array: Array = Array()
    call: Call = Call()
    recording: Recording = Recording()
    air: Air = Air()
    processing: Processing = Processing()
    accuracy: Accuracy = Accuracy()

    def __post_init__(self) -> None:
        if self.signal_rate_hz <= 2 * self.call.high_frequency_hz:
            raise ArgumentError(
                f"processing.decimation {self.decimation} leaves signals at "
                f"{self.signal_rate_hz:g} Hz; give one that leaves more than twice the call's "
                f"{self.call.high_frequency_hz:g} Hz"
            )
        swept_hz = self.call.high_frequency_hz - self.call.low_frequency_hz
        if self.processing.method == "paper" and swept_hz < _NARROWEST_HZ:
            raise ArgumentError(
                f"call sweeps over {swept_hz:g} Hz, too little for the band pass of processing.method 'paper'; "
                f"give {_NARROWEST_HZ:g} Hz or more, or method 'fast'"
            )
        self._check_adaptive()
        step = self.processing.range_decimation
        if self.processing.decimation is None and self.decimation * _WASTE < min(step, self._largest_decimation):
            raise ArgumentError(
                f"processing.range_decimation {step} has no divisor near "
                f"{self._largest_decimation}, the decimation that suits the call; give one that has, such as a "
                f"multiple of {self._largest_decimation}, or give processing.decimation"
            )

    def _check_adaptive(self) -> None:
        """Refuse plans that only sums have."""
        if self.processing.beamformer == "delay_and_sum":
            return
        accuracy = self.accuracy
        taps = accuracy.delay_taps or INTERPOLATIONS[accuracy.interpolation] or 1
        for name, value, wanted in (
            ("beam_taps", accuracy.beam_taps or 0, 0),
            ("delay_taps", taps, 1),
            ("precision", "float32" if accuracy.precision == "auto" else accuracy.precision, "float32"),
        ):
            if value != wanted:
                raise ArgumentError(
                    f"accuracy.{name} is {value!r}, which processing.beamformer {self.processing.beamformer!r} cannot "
                    f"use; leave it out or give {wanted!r}"
                )

    @classmethod
    def from_preset(cls, name: str, **sections: Any) -> Self:
        """Return the settings of a recording preset, such as ``default_25_50``.

        ``sections`` replace whole sections. If ``processing`` is not among them, its range window ends
        where the whole echo still fits into the record, at most at 5 m, and its range spacing suits the
        bandwidth: with the paper's 3.8 mm, a pulse of 60 kHz can lie between two ranges and lose 2 dB.

        Raises
        ------
        ArgumentError
            The preset is unknown.
        """
        checks.choice("preset", name, PRESETS)
        length, _, band = name.partition("_")
        low_hz, high_hz = _BANDS_HZ[band]
        call = Call(start_frequency_hz=high_hz, stop_frequency_hz=low_hz)
        recording = Recording(n_samples=_WORDS[length])
        echo_m = (recording.duration_s - call.duration_s) * _SLOWEST_AIR_M_S / 2
        processing = Processing(range_m=(0.5, min(5.0, math.floor(10 * echo_m) / 10)))
        if band == "20_80":
            processing = processing.replace(range_decimation=40)
        return cls(call=call, recording=recording, processing=processing).replace(**sections)

    @property
    def decimation(self) -> int:
        """PDM samples per signal sample.

        Where ``processing.decimation`` leaves it open, the largest divisor of ``range_decimation`` that
        keeps the signal rate at 4.4 times the call's highest frequency or more, so that the low pass needs
        few taps; for the paper's integer delays at 5.5 times, which is its 450 kHz for its calls.
        """
        given = self.processing.decimation
        if given is not None:
            return given
        step = self.processing.range_decimation
        return max(divisor for divisor in range(1, min(self._largest_decimation, step) + 1) if step % divisor == 0)

    @property
    def _largest_decimation(self) -> int:
        least_hz = _LEAST_RATE[self.processing.method] * self.call.high_frequency_hz
        return min(max(1, math.floor(self.recording.pdm_rate_hz / least_hz)), _MOST_DECIMATION)

    @property
    def output_decimation(self) -> int:
        """Signal samples per range of the energyscape."""
        return self.processing.range_decimation // self.decimation

    @property
    def signal_rate_hz(self) -> float:
        """Rate of the demodulated signals."""
        return self.recording.pdm_rate_hz / self.decimation

    @property
    def output_rate_hz(self) -> float:
        """Rate at which the energyscape samples its range axis."""
        return self.recording.pdm_rate_hz / self.processing.range_decimation

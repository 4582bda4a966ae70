"""Emitted call: a frequency sweep or a custom waveform."""

import functools
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import msgspec

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import Limits
from ertis_numba.settings.waveform import band_hz, normalise, read_waveform

__all__ = ["MAX_CALL_SAMPLES", "Call"]

MAX_CALL_SAMPLES = 2**20
"""Limit on the samples of a call, about 1 s at 1 MHz. Files store the samples, and filters need several copies."""
_BAND_TOLERANCE_HZ = 200.0  # Tolerance of band edges, because their computation may differ between processors.


class Call(TomlTable, frozen=True, kw_only=True):
    """Emitted call: a sweep with a Hann ramp at both ends, or a custom waveform.

    Attributes
    ----------
    start_frequency_hz, stop_frequency_hz : float, default 50000 and 25000
        Instantaneous frequency at the start and at the end in hertz; eRTIS sweeps downwards.
    duration_s : float, default 0.0025
        Duration of the call in seconds: at least 16 samples and one period of its lowest frequency, at most 1 s.
    sample_rate_hz : float, default 450000
        Rate of the digital-to-analogue converter in hertz.
    ramp_fraction : float, default 0.1
        Fraction of the call under the Hann ramp at each end.
    modulation : {"hyperbolic", "linear"}, default "hyperbolic"
        ``hyperbolic`` sweeps change their period at a constant rate, ``linear`` ones their frequency. Motion shifts the
        echoes of hyperbolic sweeps without blurring them; eRTIS uses these.
    delay_s : float, default 0
        Silence before the call in seconds, rounded to samples at ``sample_rate_hz``. Sensors with different
        delays emit in sequence. Ranges count from the emission.
    waveform : str or tuple of float, optional, default None
        Custom waveform instead of a sweep: 17 to 4096 samples at ``sample_rate_hz``, or the name of a file with
        samples, relative to the folder of the settings. Zeros at the end of a longer waveform do not count. A WAV file
        has its own rate. Samples are scaled to a peak of 1. The other keys follow from the samples: the frequencies are
        the edges of their band at -20 dB.

    Examples
    --------
    >>> from ertis_numba.settings import Call
    >>> Call(start_frequency_hz=80_000.0, stop_frequency_hz=20_000.0).high_frequency_hz
    80000.0
    """

    start_frequency_hz: float = 50_000.0
    stop_frequency_hz: float = 25_000.0
    duration_s: float = 2.5e-3
    sample_rate_hz: float = 450_000.0
    ramp_fraction: Annotated[float, Limits(0.0, 0.5)] = 0.1
    modulation: Literal["hyperbolic", "linear"] = "hyperbolic"
    delay_s: Annotated[float, Limits(0.0, 1.0)] = 0.0
    waveform: str | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive("call.sample_rate_hz", self.sample_rate_hz)
        if isinstance(self.waveform, str):
            return  # The file is checked when it is read.
        if self.waveform is not None:
            self._derive_from_waveform(self.waveform)
        for name in ("start_frequency_hz", "stop_frequency_hz"):
            frequency_hz = checks.positive(f"call.{name}", getattr(self, name))
            if frequency_hz >= self.sample_rate_hz / 2:
                raise ArgumentError(
                    f"call.{name} is {frequency_hz:g}; use less than half of call.sample_rate_hz "
                    f"({self.sample_rate_hz:g})"
                )
        if self.start_frequency_hz == self.stop_frequency_hz:
            raise ArgumentError(
                f"call.start_frequency_hz and call.stop_frequency_hz are both {self.start_frequency_hz:g}; choose two "
                "different frequencies"
            )
        checks.between("call.duration_s", self.duration_s, 16 / self.sample_rate_hz, 1.0)
        if self.end_s * self.sample_rate_hz > MAX_CALL_SAMPLES:
            raise ArgumentError(
                f"call has {self.end_s * self.sample_rate_hz:.0f} samples ({self.end_s:g} s at "
                f"{self.sample_rate_hz:g} Hz); the limit is {MAX_CALL_SAMPLES}. Shorten call.duration_s or "
                "call.delay_s, or lower call.sample_rate_hz"
            )
        if self.duration_s * self.low_frequency_hz < 1:
            raise ArgumentError(
                f"call.duration_s is {self.duration_s:g}, less than a period of {self.low_frequency_hz:g} Hz; "
                f"use {1 / self.low_frequency_hz:g} or more"
            )

    def _derive_from_waveform(self, waveform: tuple[float, ...]) -> None:
        """Derive the other fields from samples, and refuse values that contradict them."""
        samples = normalise(waveform, self.sample_rate_hz)
        start_hz, stop_hz = band_hz(samples, self.sample_rate_hz)
        derived = {
            "start_frequency_hz": (start_hz, _BAND_TOLERANCE_HZ),
            "stop_frequency_hz": (stop_hz, _BAND_TOLERANCE_HZ),
            "duration_s": ((len(samples) - 1) / self.sample_rate_hz, 1e-9),
            "ramp_fraction": (0.0, 0.0),
        }
        msgspec.structs.force_setattr(self, "waveform", samples)
        for name, (value, miss) in derived.items():
            given = getattr(self, name)
            if abs(given - value) <= miss:
                continue  # stored settings hold the derived values
            if given != _default(name):
                raise ArgumentError(
                    f"call.waveform and call.{name} contradict each other ({value:g} and {given:g}); leave out "
                    f"call.{name}"
                )
            msgspec.structs.force_setattr(self, name, value)
        if self.modulation != _default("modulation"):
            raise ArgumentError("call.waveform and call.modulation are both given; leave out call.modulation")

    @classmethod
    def from_file(cls, path: str | Path, *, sample_rate_hz: float | None = None) -> Self:
        """Read the waveform of a call from a file.

        Parameters
        ----------
        path : str or Path
            WAV of one channel, CSV with one number per line, or NPY with a one-dimensional array.
        sample_rate_hz : float, optional
            Rate of the samples in hertz; by default the rate in a WAV file, and 450 kHz for other files.

        Raises
        ------
        SettingsError
            The file cannot be read, or its samples cannot be used.
        """
        given: dict[str, Any] = {} if sample_rate_hz is None else {"sample_rate_hz": sample_rate_hz}
        return cls(waveform=str(path), **given).resolve_paths(Path())

    def resolve_paths(self, folder: Path) -> Self:
        """Return the call with the samples of its waveform file, whose name is relative to a folder.

        Raises
        ------
        SettingsError
            The file cannot be read, or its samples cannot be used.
        """
        if not isinstance(self.waveform, str):
            return self
        path = folder / self.waveform
        samples, rate_hz = read_waveform(path)
        given_hz = self.sample_rate_hz
        if rate_hz is not None and given_hz not in {rate_hz, _default("sample_rate_hz")}:
            raise SettingsError(
                f"call.sample_rate_hz is {given_hz:g}, but {path} has {rate_hz:g} Hz; leave out call.sample_rate_hz"
            )
        try:
            return self.replace(waveform=samples, sample_rate_hz=given_hz if rate_hz is None else rate_hz)
        except ArgumentError as error:
            raise SettingsError(f"{path}: {error}") from error

    def require_samples(self) -> None:
        """Require a waveform whose file has been read.

        Raises
        ------
        ArgumentError
            The file has not been read.
        """
        if isinstance(self.waveform, str):
            raise ArgumentError(
                f"call.waveform is the file {self.waveform!r}, which has not been read; use Call.from_file("
                f"{self.waveform!r}), or read the settings by Settings.load"
            )

    @property
    def n_silent(self) -> int:
        """Samples of silence before the call, at its sample rate."""
        return round(self.delay_s * self.sample_rate_hz)

    @property
    def start_s(self) -> float:
        """Start of the call after the start of the record, in seconds."""
        return self.n_silent / self.sample_rate_hz

    @property
    def end_s(self) -> float:
        """End of the call after the start of the record, in seconds."""
        return self.start_s + self.duration_s

    def sounds_like(self, other: Self) -> bool:
        """Return True if two calls are the same sound, perhaps with different delays."""
        return self == other or self.replace(delay_s=0.0) == other.replace(delay_s=0.0)

    @property
    def low_frequency_hz(self) -> float:
        """Lower edge of the band in hertz."""
        self.require_samples()
        return min(self.start_frequency_hz, self.stop_frequency_hz)

    @property
    def high_frequency_hz(self) -> float:
        """Upper edge of the band in hertz."""
        self.require_samples()
        return max(self.start_frequency_hz, self.stop_frequency_hz)


@functools.cache  # msgspec evaluates all annotations of a type at each call
def _default(name: str) -> Any:
    """Return the default of a field; a field with this value counts as not given."""
    return next(field.default for field in msgspec.structs.fields(Call) if field.name == name)

"""Settings of one sensor: the content of a settings file."""

import math
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.base.notebook_html import shown_in_notebooks
from ertis_numba.settings.accuracy import Accuracy
from ertis_numba.settings.array import Array
from ertis_numba.settings.beamformers import BEAMFORMERS
from ertis_numba.settings.call import Call
from ertis_numba.settings.documents import TomlDocument
from ertis_numba.settings.passive import Passive
from ertis_numba.settings.preset_files import preset_tables
from ertis_numba.settings.processing import Processing
from ertis_numba.settings.ranges import fit_ranges, max_decimation
from ertis_numba.settings.recording import Air, Recording

__all__ = ["Settings"]

_MAX_OVERSAMPLING = 8  # A signal rate of more than 8 times the necessary one is probably a mistake.
_MAX_BAND_EDGE_RATIO = 4  # relative to the highest frequency of the call
_MIN_FILTER_GAIN = 1e-4  # Largest gain in the band, relative to the largest possible one: -80 dB.
_BAND_STEPS = 256
_MIN_BANDWIDTH_HZ = 100.0  # A narrower band-pass filter would ring for seconds.


class Settings(TomlDocument, frozen=True, kw_only=True):
    """Settings of one sensor: the content of a settings file.

    Attributes
    ----------
    array : Array
        Microphone array; the eRTIS array v3D1 by default.
    call : Call
        Emitted call; a sweep from 50 to 25 kHz in 2.5 ms by default.
    recording : Recording
        Record of a measurement; 163840 one-bit samples at 4.5 MHz by default.
    air : Air
        Air, which determines the speed of sound; 20 °C, 50 % relative humidity and 101325 Pa by default.
    processing : Processing
        Processing of a measurement into an image; 90 azimuths and ranges from 0.5 to 5 m by default.
    accuracy : Accuracy
        Error budget of the image, -35 dB by default, and parts of the plan that the planner shall not choose.
    passive : Passive
        Maps of sound that the sensor did not emit; third octaves that follow the record by default.

    Raises
    ------
    ArgumentError
        A value cannot be used, by itself or with the others.

    Examples
    --------
    >>> from ertis_numba import Settings
    >>> settings = Settings().replace("processing.range_m", (0.5, 3))
    >>> settings.processing.range_m, settings.signal_rate_hz
    ((0.5, 3.0), 225000.0)
    >>> Settings.from_toml(settings.to_toml()) == settings
    True
    """

    array: Array = Array()
    call: Call = Call()
    recording: Recording = Recording()
    air: Air = Air()
    processing: Processing = Processing()
    accuracy: Accuracy = Accuracy()
    passive: Passive = Passive()

    _repr_html_ = shown_in_notebooks

    max_bytes: ClassVar[int] = 262_144  # An array of 1024 microphones needs 170,000 bytes …
    max_items: ClassVar[int] = 30_000  # … and 16,500 items.

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.processing.mode == "passive":
            return  # No image will be made, so the call does not have to fit the record.
        if isinstance(self.call.waveform, str):
            return  # The file is checked when it is read.
        if self.signal_rate_hz <= 2 * self.call.high_frequency_hz:
            raise ArgumentError(
                f"processing.decimation {self.decimation} leaves signals at "
                f"{self.signal_rate_hz:g} Hz; use a decimation that leaves more than twice the call's "
                f"{self.call.high_frequency_hz:g} Hz, or without a call, processing.mode 'passive'"
            )
        swept_hz = self.call.high_frequency_hz - self.call.low_frequency_hz
        if self.processing.method == "paper" and swept_hz < _MIN_BANDWIDTH_HZ:
            raise ArgumentError(
                f"call sweeps over {swept_hz:g} Hz, too little for the band-pass filter of processing.method 'paper'; "
                f"use {_MIN_BANDWIDTH_HZ:g} Hz or more, or method 'fast'"
            )
        self._check_band()
        self._check_plan()
        self._check_filters()
        step = self.processing.range_decimation
        if self.processing.decimation is None and self.decimation * _MAX_OVERSAMPLING < min(step, self._max_decimation):
            raise ArgumentError(
                f"processing.range_decimation {step} has no divisor near "
                f"{self._max_decimation}, the decimation that suits the call; use a multiple of "
                f"{self._max_decimation}, or set processing.decimation"
            )

    def _check_band(self) -> None:
        """Refuse edges of the matched filter inside the call's band or above the Nyquist frequency of the signals."""
        given = self.processing.band_edges_hz
        if given is None:
            return
        max_hz = _MAX_BAND_EDGE_RATIO * self.call.high_frequency_hz
        if given[1] > max_hz:
            raise ArgumentError(
                f"processing.band_edges_hz ends at {given[1]:g} Hz; the limit is {max_hz:g} Hz, four times the call's "
                "highest frequency, because the error model does not predict noise above it"
            )
        highest_hz = self.call.low_frequency_hz - _MIN_BANDWIDTH_HZ
        lowest_hz, nyquist_hz = self.call.high_frequency_hz + _MIN_BANDWIDTH_HZ, self.signal_rate_hz / 2
        if given[0] > highest_hz or given[1] < lowest_hz:
            raise ArgumentError(
                f"processing.band_edges_hz is {given[0]:g} to {given[1]:g} Hz, but the call sweeps over "
                f"{self.call.low_frequency_hz:g} to {self.call.high_frequency_hz:g} Hz; use a lower edge of at most "
                f"{highest_hz:g} and an upper edge of at least {lowest_hz:g}"
            )
        if given[1] > nyquist_hz:
            raise ArgumentError(
                f"processing.band_edges_hz ends at {given[1]:g} Hz, but signals at {self.signal_rate_hz:g} Hz reach "
                f"only {nyquist_hz:g} Hz; use a lower edge or a smaller processing.decimation"
            )

    def _check_filters(self) -> None:
        """Refuse own filters whose rate is too low for the call, or that remove it."""
        processing, high_hz = self.processing, self.call.high_frequency_hz
        if isinstance(processing.pre_filter, str) or isinstance(processing.post_filter, str):
            return  # Files are checked when they are read.
        filters = processing.filters(self.signal_rate_hz)
        if filters is None:
            return
        if filters.rate_hz <= 2 * high_hz:
            raise ArgumentError(
                f"processing.filter_rate_hz is {filters.rate_hz:g}; use more than twice the call's {high_hz:g} Hz"
            )
        gain = np.abs(filters.response(np.linspace(self.call.low_frequency_hz, high_hz, _BAND_STEPS)))
        largest = math.prod(sum(map(abs, taps)) for taps in filters.taps)
        if gain.max() < _MIN_FILTER_GAIN * largest:
            raise ArgumentError(
                "processing.pre_filter and post_filter remove the band of the call, "
                f"{self.call.low_frequency_hz:g} to {high_hz:g} Hz; use filters that pass it, or another "
                "processing.filter_rate_hz"
            )

    def _check_plan(self) -> None:
        """Refuse plans that a delay matrix or an adaptive beamformer does not support."""
        processing, accuracy = self.processing, self.accuracy
        if processing.delay_matrix and processing.method == "fast":
            accuracy.require_exact_delays()
        if processing.is_adaptive and accuracy.delay_taps == 0:
            raise ArgumentError(
                f"accuracy.delay_taps is 0 (phase shifts of spectra), which processing.beamformer "
                f"{processing.beamformer!r} with weighting {processing.weighting!r} does not support; leave it out or "
                "use 1"
            )
        beamformer = BEAMFORMERS[processing.beamformer]
        if beamformer.streams(*beamformer.values(processing)):
            return
        for name, value, wanted in (
            ("beam_taps", accuracy.beam_taps or 0, 0),
            ("delay_taps", accuracy.delay_taps or 1, 1),
            ("precision", "float32" if accuracy.precision == "auto" else accuracy.precision, "float32"),
        ):
            if value != wanted:
                raise ArgumentError(
                    f"accuracy.{name} is {value!r}, which processing.beamformer {processing.beamformer!r} does not "
                    f"support; leave it out or use {wanted!r}"
                )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a settings file.

        Parameters
        ----------
        path : str or Path
            TOML file. Names of files in it, of layouts, waveforms, filters and directions, are relative to its
            folder.

        Raises
        ------
        SettingsError
            The file cannot be read or used.

        Examples
        --------
        >>> from pathlib import Path
        >>> from ertis_numba import Settings
        >>> size = Path("mine.toml").write_text("processing.directions = '2d:181'")
        >>> Settings.load("mine.toml").processing.directions
        '2d:181'
        """
        return super().load(path).resolve_paths(Path(path).parent)

    def updated_from_file(self, path: str | Path) -> Self:
        """Return these settings, changed by the keys of a file.

        The array is replaced as a whole if the file has a layout or positions, and the call if either call has a custom
        waveform.

        Parameters
        ----------
        path : str or Path
            TOML file. Names of files in it are relative to its folder.

        Raises
        ------
        SettingsError
            The file cannot be read or used, by itself or with the rest of these settings.

        Examples
        --------
        >>> from pathlib import Path
        >>> from ertis_numba import Settings
        >>> size = Path("near.toml").write_text("processing.range_m = [0.3, 1.0]")
        >>> Settings().updated_from_file("near.toml").processing.range_m
        (0.3, 1.0)
        """
        held, tables = self._load(Path(path))
        held = held.resolve_paths(Path(path).parent)
        try:
            changes: dict[str, Any] = {}
            if not tables.get("array", {}).keys().isdisjoint({"layout", "positions_m"}):
                del tables["array"]
                changes["array"] = held.array
            if "call" in tables and (held.call.waveform or self.call.waveform):
                del tables["call"]
                changes["call"] = held.call
            for name, table in tables.items():
                given = {key: getattr(getattr(held, name), key) for key in table}
                changes[name] = getattr(self, name).replace(**given)
            return self.replace(**changes)
        except ArgumentError as error:
            raise SettingsError(f"{path}: {error}") from error

    @classmethod
    def _load(cls, path: Path) -> tuple[Self, dict[str, Any]]:
        """Read a file, whose name becomes that of an array given by positions."""
        held, tables = super()._load(path)
        if "positions_m" in (array := tables.get("array", {})) and "layout" not in array:
            held = held.replace("array.layout", path.name)
        return held, tables

    def resolve_paths(self, folder: Path) -> Self:
        """Return settings whose files, of layout, directions, delays, waveform and filters, are relative to a folder.

        Waveform and filters are read, because other settings depend on them.
        """
        array, processing = self.array, self.processing
        if array.is_file:
            array = array.replace(layout=str(folder / array.layout))
        return self.replace(
            array=array, processing=processing.resolve_paths(folder), call=self.call.resolve_paths(folder)
        )

    @classmethod
    def from_preset(cls, name: str, **sections: Any) -> Self:
        """Return the settings of an RTIS recording preset.

        Parameters
        ----------
        name : {"short_20_80", "short_25_50", "default_20_80", "default_25_50", "long_20_80", "long_25_50"}
            Length of the record, and band of the call in kHz.
        **sections
            Sections to replace as a whole, such as ``air=Air(temperature_c=25)`` or
            ``processing=Processing.from_preset("2d_181_5m")``. Unless ``processing`` is among them, its ranges suit
            record and call; see `fit_ranges`.

        Raises
        ------
        ArgumentError
            The preset is unknown, or a processing preset.

        Examples
        --------
        >>> from ertis_numba import Settings
        >>> Settings.from_preset("short_20_80").recording.n_samples
        65536
        """
        tables = preset_tables(name, "recording")
        call, recording = Call(**tables["call"]), Recording(**tables["recording"])
        processing = fit_ranges(Processing(), recording, call)
        return cls(call=call, recording=recording, processing=processing).replace(**sections)

    @property
    def decimation(self) -> int:
        """Samples of the record per signal sample.

        If ``processing.decimation`` is open, the largest divisor of ``range_decimation`` that keeps the signal rate at
        4.4 times the call's highest frequency or more, so that the low-pass filter needs few taps. The integer delays
        of the paper need 5.5 times, which is 450 kHz for its calls.
        """
        given = self.processing.decimation
        if given is not None:
            return given
        step = self.processing.range_decimation
        return max(divisor for divisor in range(1, min(self._max_decimation, step) + 1) if step % divisor == 0)

    @property
    def _max_decimation(self) -> int:
        return max_decimation(self.recording.sample_rate_hz, self.call, self.processing)

    @property
    def output_decimation(self) -> int:
        """Signal samples per range of the energyscape."""
        return self.processing.range_decimation // self.decimation

    @property
    def signal_rate_hz(self) -> float:
        """Rate of the demodulated signals in hertz."""
        return self.recording.sample_rate_hz / self.decimation

    @property
    def output_rate_hz(self) -> float:
        """Ranges of the energyscape per second of echo time, in hertz."""
        return self.recording.sample_rate_hz / self.processing.range_decimation

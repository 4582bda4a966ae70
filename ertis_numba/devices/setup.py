"""Configuration of a sensor."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.blocks import CHANNELS
from ertis_numba.devices.commands import (
    DAC_CODE_MAX,
    DAC_RATES_HZ,
    DAC_SAMPLES,
    LENGTH_STEP,
    MAX_NUMBER,
    MAX_WORDS,
    PDM_RATES_HZ,
    PINS,
    Command,
)
from ertis_numba.geometry import microphones
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Array, Call, Settings
from ertis_numba.settings.waveform import MAX_WAVEFORM_SAMPLES

__all__ = ["Setup", "call_codes", "call_from_codes", "call_hash"]


def call_codes(call: Call) -> NDArray[np.uint16]:
    """Return a call as the codes of the 12-bit converter, ``floor(2047 s + 2048)``: (sample,) uint16."""
    return np.floor(2047 * call_samples(call) + 2048).astype(np.uint16)


def call_from_codes(codes: NDArray[np.uint16], rate_hz: float) -> Call:
    """Return the call of converter codes, with a peak of 1, without silence at the end."""
    loud = np.flatnonzero(np.abs(codes - 2047.5) > 0.5)  # Silence is 2048, or 2047 if its samples are negative.
    samples = (codes[: loud.max(initial=-1) + 2] + 0.5 - 2048) / 2047  # Codes were rounded down.
    n_silent = max(0, int(loud[0]) - 1) if len(samples) > MAX_WAVEFORM_SAMPLES else 0
    return Call(waveform=tuple(samples[n_silent:].tolist()), sample_rate_hz=rate_hz, delay_s=n_silent / rate_hz)


def call_hash(codes: NDArray[np.uint16]) -> int:
    """Return the XOR of all codes, which is a sensor's answer to `L`."""
    return int(np.bitwise_xor.reduce(codes, initial=0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setup:
    """Complete configuration of a sensor; `Setup.of` derives it from settings.

    Attributes
    ----------
    n_samples : int
        Words of one measurement.
    pdm_rate_hz : float
        One of `PDM_RATES_HZ`.
    codes : (sample,) uint16
        Samples of the call.
    dac_rate_hz : int
        Sample rate of the call.
    emissions : int
        Calls per measurement.
    active : bool
        True if measurements emit the call by default.
    pin : {1, 2}
        SYNC input.
    amplifier : bool
        True if the high-voltage amplifier is on; without it, nothing is emitted.

    Raises
    ------
    ArgumentError
        A sensor does not support it.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> ertis.Setup.of(ertis.Settings.from_preset("default_25_50")).n_samples
    163840
    """

    n_samples: int
    pdm_rate_hz: float
    codes: NDArray[np.uint16]
    dac_rate_hz: int
    emissions: int = 1
    active: bool = True
    pin: int = 1
    amplifier: bool = True

    def __post_init__(self) -> None:
        _check_length(self.n_samples)
        if self.pdm_rate_hz not in PDM_RATES_HZ:
            raise ArgumentError(
                f"recording.sample_rate_hz is {self.pdm_rate_hz:.10g}, but a sensor's clocks are "
                f"{PDM_RATES_HZ[0]:.0f} and {PDM_RATES_HZ[1]:.0f}; choose one of them"
            )
        object.__setattr__(self, "dac_rate_hz", _dac_rate_hz(self.dac_rate_hz))
        _check_codes(self.codes, self.dac_rate_hz)
        checks.integer("emissions", self.emissions, 1, MAX_NUMBER)
        checks.integer("pin", self.pin, *PINS)
        if self.active and not self.amplifier:
            raise ArgumentError(
                "active is True with the amplifier off, which emits nothing; switch it on, or use active=False"
            )

    @classmethod
    def of(
        cls,
        settings: Settings,
        *,
        active: bool = True,
        pin: int = 1,
        emissions: int = 1,
        emission_period_s: float | None = None,
    ) -> Self:
        """Return the configuration for ``settings``.

        Several emissions follow each other without a pause, or at an interval of ``emission_period_s``. The call then
        ends with silence.

        For passive measurements the amplifier is off, too, although a call is loaded: ``dataclasses.replace(setup,
        amplifier=True)`` allows single measurements to be active.

        Raises
        ------
        ArgumentError
            A sensor cannot do it.
        """
        recording, call = settings.recording, settings.call
        _check_array(settings.array)
        if not recording.is_pdm:
            raise ArgumentError(f"recording.encoding is {recording.encoding!r}, but a sensor sends bits; use 'pdm'")
        return cls(
            n_samples=recording.n_samples,
            pdm_rate_hz=recording.sample_rate_hz,
            codes=_with_silence(call_codes(call), call.sample_rate_hz, emission_period_s),
            dac_rate_hz=_dac_rate_hz(call.sample_rate_hz),
            emissions=emissions,
            active=active,
            pin=pin,
            amplifier=active,
        )

    @property
    def n_bytes(self) -> int:
        """Bytes of one measurement; a block has `FRAME_BYTES` more."""
        return 4 * self.n_samples

    def before_call(self) -> list[Command]:
        """Return the first commands: trigger off, then lengths and rates."""
        return [
            Command("J", 0, self.pin),
            Command("G", self.n_bytes),
            Command("F", PDM_RATES_HZ.index(self.pdm_rate_hz)),
            Command("D", self.dac_rate_hz),
            Command("E", len(self.codes)),
        ]

    def call(self) -> list[Command]:
        """Return the samples of the call, one command each."""
        return [Command("C", index, code) for index, code in enumerate(self.codes.tolist())]

    def after_call(self) -> list[Command]:
        """Return the last commands; afterwards the counter may be set and the trigger switched on."""
        return [Command("I", self.emissions), Command("K", int(self.amplifier)), Command("H", int(self.active))]


def _with_silence(codes: NDArray[np.uint16], rate_hz: float, period_s: float | None) -> NDArray[np.uint16]:
    """Return codes with silence up to a period."""
    if period_s is None:
        return codes
    n_samples = round(checks.positive("emission_period_s", period_s) * rate_hz)
    if n_samples < len(codes):
        raise ArgumentError(
            f"emission_period_s is {period_s:g} s, but the call lasts {len(codes) / rate_hz:.3g} s; use a "
            "period of at least this length"
        )
    if n_samples > DAC_SAMPLES[1]:
        raise ArgumentError(
            f"emission_period_s is {period_s:g} s, but a sensor plays at most {DAC_SAMPLES[1]} samples; use at most "
            f"{DAC_SAMPLES[1] / rate_hz:.3g} s"
        )
    return np.pad(codes, (0, n_samples - len(codes)), constant_values=2048)


def _check_length(n_samples: int) -> None:
    checks.integer("recording.n_samples", n_samples, 1)
    if n_samples % LENGTH_STEP or n_samples > MAX_WORDS:
        near = min(max(round(n_samples / LENGTH_STEP), 1) * LENGTH_STEP, MAX_WORDS)
        raise ArgumentError(
            f"recording.n_samples is {n_samples}, but a sensor measures multiples of {LENGTH_STEP} up to "
            f"{MAX_WORDS}; use {near}"
        )


def _check_array(array: Array) -> None:
    layout = microphones(array)
    if layout.word_bits != CHANNELS:
        raise ArgumentError(
            f"array.word_bits is {layout.word_bits}, but a sensor's words have {CHANNELS} bits; use {CHANNELS}"
        )
    if len(layout.enabled) > CHANNELS:
        raise ArgumentError(
            f"array has {len(layout.enabled)} channels, but a sensor has {CHANNELS}; use at most {CHANNELS} positions"
        )


def _dac_rate_hz(rate_hz: float) -> int:
    """Return a sample rate that the converter supports."""
    slowest_hz, fastest_hz = DAC_RATES_HZ
    if not (float(rate_hz).is_integer() and slowest_hz <= rate_hz <= fastest_hz):
        raise ArgumentError(
            f"call.sample_rate_hz is {rate_hz:.10g}; use a whole number from {slowest_hz} to {fastest_hz}"
        )
    return int(rate_hz)


def _check_codes(codes: NDArray[np.uint16], rate_hz: int) -> None:
    if codes.dtype != np.uint16 or codes.ndim != 1:
        raise ArgumentError(f"codes are {codes.dtype} of shape {codes.shape}; use (sample,) uint16")
    fewest, largest = DAC_SAMPLES
    if not fewest <= len(codes) <= largest:
        raise ArgumentError(
            f"call has {len(codes)} samples, but a sensor plays {fewest} to {largest}; use call.delay_s and "
            f"call.duration_s that add up to {(fewest - 1) / rate_hz:.3g} to {(largest - 1) / rate_hz:.3g}"
        )
    if codes.max() > DAC_CODE_MAX:
        raise ArgumentError(
            f"codes reach {codes.max()}, but a sensor's converter accepts 0 to {DAC_CODE_MAX}; use smaller codes"
        )

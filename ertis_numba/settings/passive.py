"""Passive listening: maps of sound that the sensor did not emit."""

import itertools
from typing import Annotated, Final

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import AVERAGES, FOCUS_M, Limits
from ertis_numba.settings.map_methods import MAP_METHODS, MapMethod, MapMethodName
from ertis_numba.settings.recording import Recording

__all__ = ["HIGHEST_SHARE", "MAX_BANDS", "Passive"]

MAX_BANDS: Final = 100

HIGHEST_SHARE: Final = 0.8
"""Highest frequency of bands relative to half of the sample rate; filters attenuate beyond."""

_BAND_HZ: Final = Limits(1.0, 1e9)
_PDM_LIMITS_HZ: Final = (8_900.0, 89_500.0)
_BLOCK: Final = 1024  # Samples of a block, whose spacing is a third of the lowest band …
_BLOCKS: Final = 4.0  # … and least number of blocks in a record.
_SPACINGS: Final = 13.0  # A third octave at 13 spacings of bins is three of them wide.


class Passive(TomlTable, frozen=True, kw_only=True):
    """Passive listening: maps of the level from each direction, in bands of frequencies.

    Attributes
    ----------
    bands_hz : "third_octaves", "octaves" or list of (low, high), default "third_octaves"
        Bands in hertz, up to 100, which must not overlap: those of IEC 61260-1 within ``limits_hz``, or your own.
    limits_hz : (low, high), optional, default None
        Limits of third octaves and octaves, in hertz. By default, they follow the record: for PCM, up to 0.8 of half of
        the sample rate, from the frequency that blocks of 1024 samples resolve, or shorter ones of short records. The
        bands at both ends reach to the limits. For PDM, whose noise dominates beyond, 8.9 to 89.5 kHz.
    method : str, default "delay_and_sum"
        Estimate of the power from each direction, one of `MAP_METHODS`. ``docs/how-to/passive.md`` compares them.
    diagonal_removal : bool, default false
        Leave out the power of each microphone itself, which contains its noise. Not all methods support this.
    functional_order : float, default 8
        Order of ``functional``; 1 is delay-and-sum, and higher ones have narrower lobes.
    n_sources : int, default 1
        Number of sources that ``music`` expects in a band, at most the number of microphones − 1.
    diagonal_loading : float, default 0.01
        Diagonal loading of ``capon`` relative to the mean power of a microphone.
    resolution_hz : float, optional, default None
        Largest spacing of frequencies in hertz; by default a third of the narrowest band, and at most 1 kHz.
        Arrays above 11 cm have longer blocks by default: three times as long as sound takes to cross them.
    averages : int, default 1
        Number of measurements in a map, over which powers are averaged.
    focus_m : float, optional, default None
        Distance of the sources in metres, which also gives their source levels. By default, waves are plane.
    """

    bands_hz: str | tuple[Annotated[tuple[float, float], _BAND_HZ], ...] = "third_octaves"
    limits_hz: Annotated[tuple[float, float], _BAND_HZ] | None = None
    method: MapMethodName = "delay_and_sum"
    diagonal_removal: bool = False
    functional_order: Annotated[float, Limits(1.0, 100.0)] = 8.0
    n_sources: Annotated[int, Limits(1)] = 1
    diagonal_loading: Annotated[float, Limits(1e-6, 1e6)] = 0.01
    resolution_hz: Annotated[float, Limits(0.1, 1e8)] | None = None
    averages: Annotated[int, AVERAGES] = 1
    focus_m: Annotated[float, FOCUS_M] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bands()
        if self.diagonal_removal and not self.traits.removes_diagonal:
            supported = ", ".join(name for name, each in MAP_METHODS.items() if each.removes_diagonal)
            raise ArgumentError(
                f"passive.diagonal_removal is true, which passive.method {self.method!r} does not support; leave it "
                f"out, or choose one of {supported}"
            )

    @property
    def traits(self) -> MapMethod:
        """Declaration of the method of the maps."""
        return MAP_METHODS[self.method]

    @property
    def follows_record(self) -> bool:
        """True if neither bands nor limits are given."""
        return isinstance(self.bands_hz, str) and self.limits_hz is None

    def limits_of(self, recording: Recording) -> tuple[float, float]:
        """Return the limits of third octaves and octaves for a record, in hertz."""
        if self.limits_hz is not None:
            return self.limits_hz
        if recording.is_pdm:
            return _PDM_LIMITS_HZ
        high_hz = HIGHEST_SHARE * recording.sample_rate_hz / 2
        spacing_hz = max(recording.sample_rate_hz / _BLOCK, _BLOCKS / recording.duration_s)
        return max(1.0, min(_SPACINGS * spacing_hz, high_hz / 2)), high_hz

    def extent_of(self, recording: Recording) -> tuple[float, float]:
        """Return the lowest and the highest frequency of all bands, in hertz."""
        if isinstance(self.bands_hz, str):
            return self.limits_of(recording)
        return min(low_hz for low_hz, _ in self.bands_hz), max(high_hz for _, high_hz in self.bands_hz)

    def _check_bands(self) -> None:
        given = self.bands_hz
        if isinstance(given, str):
            checks.choice("passive.bands_hz", given, ("third_octaves", "octaves"))
            return
        if not 1 <= len(given) <= MAX_BANDS:
            raise ArgumentError(f"passive.bands_hz lists {len(given)} bands; use 1 to {MAX_BANDS}")
        for (low_hz, high_hz), (next_low_hz, next_high_hz) in itertools.pairwise(sorted(given)):
            if next_low_hz < high_hz:  # The sum of all bands would count their frequencies twice.
                raise ArgumentError(
                    f"passive.bands_hz has overlapping bands {low_hz:g} to {high_hz:g} Hz and {next_low_hz:g} to "
                    f"{next_high_hz:g} Hz; use bands that share at most an edge"
                )

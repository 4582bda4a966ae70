"""Acoustic camera: maps of sound power over direction and frequency, from passive measurements."""

import functools
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, CoarseGridWarning, DataError, OutsideBandsWarning
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.frames import AcousticMap, Measurement, Stamp
from ertis_numba.geometry import Grid, direction_grid, microphones, unit_vectors
from ertis_numba.passive.bands import bin_shares
from ertis_numba.passive.block_spectra import BlockSpectra
from ertis_numba.passive.components import gathered
from ertis_numba.passive.cross_spectrum import CrossSpectrum, FrequencyMoments
from ertis_numba.passive.edge_tones import EdgeTones
from ertis_numba.passive.methods import METHODS
from ertis_numba.passive.outside_bands import OutsideBands
from ertis_numba.passive.search_grid import coarse_map_warning
from ertis_numba.passive.wave_delays import WaveDelays
from ertis_numba.passive.waves import Waves
from ertis_numba.settings import HIGHEST_SHARE, Settings

if TYPE_CHECKING:
    from ertis_numba.passive.bearings import BearingFinder

__all__ = ["AcousticCamera"]

_TINY: Final = 1e-30


class AcousticCamera:
    """Camera that computes acoustic maps from the measurements of one sensor.

    Signals are cut into blocks that overlap by half. Their spectra, under a Hann window, yield the cross-spectral
    matrix of the microphones, which is averaged over blocks and measurements. A map is the power of this matrix for the
    wave from each direction. Maps of CLEAN-SC and HR-CLEAN-SC sum the components of a direction and its neighbours at
    the strongest of them, whose value is the power of the source. Measurements with a call are accepted; the time of
    the call is left out. Use each object in one thread only.

    Parameters
    ----------
    settings : Settings or str or Path
        Settings, or the path of a TOML file with them. Directions are those of ``processing``, and all other settings
        of maps are in ``passive``.
    device : {"auto", "cpu", "cuda", "numpy"}
        Compute device, as for `Pipeline`.
    threads : int, optional
        Number of threads; all cores by default.
    check : bool, default True
        Issue a `CoarseGridWarning` if ``warning`` is not None, and an `OutsideBandsWarning`, once, if ``band_note`` is
        not None when a map is made.
    false_alarm : float, optional
        Probability that noise alone yields any bearing, as for `BearingFinder`. If given, the bearings of sources are
        found with each map; none are searched by default.

    Attributes
    ----------
    settings : Settings
    device : str
        Compute device in use.
    grid : Grid
        Directions of the maps.
    band_hz : (band, 2) float64
        Edges of the bands in hertz.
    frequency_hz : (bin,) float64
        Frequencies at which powers are computed, in hertz.
    waves : Waves
        Waves from each direction of the grid.
    n_measurements : int
        Measurements since the last `reset`.
    finder : BearingFinder or None
        Finder of the bearings of each map; None without ``false_alarm``.

    Raises
    ------
    ArgumentError
        The bands exceed the record, or settings cannot be used.
    DeviceError
        The device is not available.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     camera = ertis.AcousticCamera(recording.settings)
    ...     found = camera.process(recording[0])
    >>> found.power.shape == (len(camera.grid), len(camera.band_hz))
    True
    """

    def __init__(
        self,
        settings: Settings | str | Path,
        device: str = "auto",
        threads: int | None = None,
        *,
        check: bool = True,
        false_alarm: float | None = None,
    ) -> None:
        if isinstance(settings, str | Path):
            settings = Settings.load(settings)
        checks.instance("settings", settings, Settings, "a recording contains, or Settings.from_preset returns")
        settings.processing.require_sensor_frame("acoustic maps are means over measurements at several poses")
        kernel_set = kernels.load(device)
        self._threads = kernel_set.max_threads if threads is None else threads
        with kernel_set.threads(self._threads):  # refuses an impossible number
            pass
        sensitivity_dbfs = microphones(settings.array).sensitivity_dbfs  # of the layout, for the levels of maps
        settings = settings.replace("array.sensitivity_dbfs", sensitivity_dbfs)
        self._kernels, self.settings, self.device = kernel_set, settings, kernel_set.device
        self._require_microphones()
        self.grid: Grid = direction_grid(settings.processing)
        self._blocks = BlockSpectra(settings, kernel_set, threads=self._threads)
        self.band_hz: NDArray[np.float64] = self._blocks.bands_hz
        self.frequency_hz: NDArray[np.float64] = self._blocks.frequency_hz
        self._shares = bin_shares(self.band_hz, self.frequency_hz)
        directions = unit_vectors(self.grid.azimuth_rad, self.grid.elevation_rad)
        delay_s = WaveDelays(settings)(directions)
        self.waves = self._waves(delay_s)
        self._of_search: list[Waves] = []
        self._outside, self._check = OutsideBands(settings, self.band_hz), check
        self._edge_tones = EdgeTones(
            self.band_hz,
            self.frequency_hz,
            HIGHEST_SHARE * settings.recording.sample_rate_hz / 2,
            is_linear=settings.passive.traits.is_linear,
        )
        self._masked_s = 0.0
        self._shape = len(self.frequency_hz), delay_s.shape[1], delay_s.shape[1]
        self.reset()
        if check and self.warning is not None:
            warnings.warn(self.warning, CoarseGridWarning, stacklevel=2)
        self.finder, self._false_alarm = self._finder(false_alarm), np.nan if false_alarm is None else false_alarm

    def _finder(self, false_alarm: float | None) -> "BearingFinder | None":
        from ertis_numba.passive.bearings import BearingFinder  # noqa: PLC0415  it imports this module

        return None if false_alarm is None else BearingFinder(self, false_alarm=false_alarm)

    def _waves(self, delay_s: NDArray[np.float64]) -> Waves:
        return Waves(delay_s, self._blocks.bins, self._blocks.spacing_hz, self._kernels, threads=self._threads)

    def waves_of(self, directions: NDArray[np.float64]) -> Waves:
        """Return the waves from unit vectors, (direction, axis), at all frequencies, until the camera is closed."""
        self._of_search.append(self._waves(WaveDelays(self.settings)(directions)))
        return self._of_search[-1]

    @functools.cached_property
    def warning(self) -> str | None:
        """Warning that sources between the directions are too weak, or weaker than side lobes; None if they are not.

        It names a grid that suffices in all bands.
        """
        return coarse_map_warning(self.settings, self.grid)

    @property
    def band_note(self) -> str | None:
        """Note on sound that the bands of all maps so far do not show, or only in part; None if there is none.

        If sound outside of the default bands is louder than inside, it states the share of the power, and the frequency
        and level of its maximum; bands or limits of your own, PDM, and measurements with a call yield no such note. A
        tone at the edge of a band is named with its level, because a band shows only a part of its power.
        """
        outside = self._outside.note
        return "; also, ".join(filter(None, (outside, self._edge_tones.note(within=outside is not None)))) or None

    def add(self, measurement: Measurement) -> None:
        """Add a measurement to the mean.

        Parameters
        ----------
        measurement : Measurement

        Raises
        ------
        DataError
            Its array, call, record or air are not those of the settings, or no sound is left without its call.
        """
        checks.instance("measurement", measurement, Measurement, "a recording contains")
        masked = measurement.stamp.behaviour == "active"
        products = self._blocks.products(measurement, masked=masked)
        self._outside.add(measurement)
        self._sums += products.matrix
        self._slopes += products.slopes
        self._squares += products.squares
        self._n_blocks += products.n_blocks
        self._masked_s = max(self._masked_s, self._blocks.masked_s if masked else 0.0)
        self._stamp = measurement.stamp
        self.n_measurements += 1

    def cross_spectrum(self) -> CrossSpectrum:
        """Return the cross-spectral matrix of the measurements since the last `reset`.

        Raises
        ------
        DataError
            There is no measurement.
        """
        if not self.n_measurements:
            raise DataError("the acoustic camera has no measurement; call add first")
        matrix = (self._sums / self._n_blocks).astype(np.complex64)
        channels = self._blocks.channels
        first = np.asarray(self._slopes / self._n_blocks, np.complex128)
        power = np.maximum(np.einsum("bmm->b", matrix[:, channels[:, None], channels].real) / len(channels), _TINY)
        mean_hz = np.einsum("bmm->b", first.imag) / len(channels) / power
        width_hz = np.sqrt(np.maximum(self._squares / self._n_blocks / power - mean_hz**2, 0))
        moments = FrequencyMoments(channels, first, width_hz)
        return CrossSpectrum(matrix, self.frequency_hz, self._n_blocks, moments)

    def powers(self) -> NDArray[np.float32]:
        """Return the power from each direction in each bin: (bin, direction) float32.

        Raises
        ------
        DataError
            There is no measurement, or too few blocks for the method.
        """
        passive = self.settings.passive
        with one_thread():  # of BLAS: the parts of `in_parts` run on threads of their own
            return METHODS[passive.method](self.cross_spectrum(), self.waves, passive)

    def map(self) -> AcousticMap:
        """Return the map of the measurements since the last `reset`.

        Raises
        ------
        DataError
            There is no measurement, or too few blocks for the method.
        """
        with one_thread():
            powers = self.powers()
            power = (self._shares @ powers).T
        if self.settings.passive.traits.has_level:
            heard = np.einsum("bmm->b", self._sums.real) / (self._shape[1] * self._n_blocks)
            self._edge_tones.add(powers, power, heard, self.n_measurements)
        if self._check and (note := self.band_note) is not None:
            self._check = False
            warnings.warn(note, OutsideBandsWarning, stacklevel=3)
        found = AcousticMap(
            np.ascontiguousarray(power),
            self.grid.azimuth_rad,
            self.grid.elevation_rad,
            self.band_hz,
            self.settings,
            self._stamp,
            self.n_measurements,
            self._n_blocks,
            self._masked_s,
            () if self.finder is None else tuple(self.finder.find()),
            self._false_alarm,
        )
        return gathered(found)

    def reset(self) -> None:
        """Discard all measurements."""
        self._sums: NDArray[Any] = np.zeros(self._shape, np.complex128)
        n_channels = len(self._blocks.channels)
        self._slopes: NDArray[Any] = np.zeros((len(self.frequency_hz), n_channels, n_channels), np.complex128)
        self._squares = np.zeros(len(self.frequency_hz))
        self._n_blocks = self.n_measurements = 0
        self._masked_s = 0.0
        self._stamp = Stamp()

    def process(self, measurement: Measurement) -> AcousticMap:
        """Return the map of one measurement, and discard those added before.

        Parameters
        ----------
        measurement : Measurement

        Raises
        ------
        DataError
            As for `add` and `map`.
        """
        self.reset()
        self.add(measurement)
        return self.map()

    def process_many(self, measurements: Iterable[Measurement]) -> Iterator[AcousticMap]:
        """Return an iterator over maps, each of ``passive.averages`` measurements; the last may have fewer.

        Parameters
        ----------
        measurements : iterable of Measurement

        Raises
        ------
        DataError
            As for `add` and `map`.
        """
        self.reset()
        for measurement in checks.items("measurements", measurements, Measurement, "a recording contains"):
            self.add(measurement)
            if self.n_measurements == self.settings.passive.averages:
                yield self.map()
                self.reset()
        if self.n_measurements:
            yield self.map()

    def close(self) -> None:
        """Free the memory of the device."""
        self._blocks.close()
        for waves in (self.waves, *self._of_search):
            waves.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_microphones(self) -> None:
        """Refuse a single microphone, and settings of the method that need more microphones."""
        passive, n_mics = self.settings.passive, int(microphones(self.settings.array).enabled.sum())
        if n_mics < 2:
            raise ArgumentError(
                "array has 1 enabled microphone, which hears no directions; choose a layout with two or more, or "
                "disable fewer"
            )
        passive.traits.check(passive, n_mics)

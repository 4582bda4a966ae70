"""Result of a calibration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.calibration.reference_place import ArrayScale, SoundSpeed
from ertis_numba.geometry import Layout

__all__ = ["Calibration", "Residuals"]

_WELL_KNOWN = 0.5  # Largest standard deviation of an observable quantity, relative to the one before the calibration.


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Measured times and levels (record, mic) minus those of the layout, before and after the calibration."""

    before_time_s: NDArray[np.float64]  # minus the travel times to the fitted reflectors; NaN if left out
    after_time_s: NDArray[np.float64]
    before_level_db: NDArray[np.float64]
    after_level_db: NDArray[np.float64]

    @property
    def before_s(self) -> float:
        """Root mean square of the times before the calibration, in seconds."""
        return _rms(self.before_time_s)

    @property
    def after_s(self) -> float:
        """Root mean square of the times after the calibration, in seconds."""
        return _rms(self.after_time_s)

    @property
    def before_db(self) -> float:
        """Root mean square of the levels before the calibration, in dB."""
        return _rms(self.before_level_db)

    @property
    def after_db(self) -> float:
        """Root mean square of the levels after the calibration, in dB."""
        return _rms(self.after_level_db)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Gains, delays and positions of microphones, as measured by an array.

    Attributes
    ----------
    layout : Layout
        Calibrated layout. Silent and duplicate channels are not enabled; an inverted channel has a negative gain.
    former : Layout
        Layout before the calibration.
    channels : tuple of int
        Channels that were calibrated.
    gain_db : (mic,) float64
        Change of the gain of each channel in decibels.
    delay_s : (mic,) float64
        Change of the delay in seconds.
    moved_m : (mic, axis) float64
        Change of the position in metres, relative to the place of the channel after swaps.
    covariance : (mic, quantity, mic, quantity) float64
        Covariance of the quantities of all channels: gain in dB, delay in µs, and x, y and z in mm.
    expected_sd : (quantity,) float64
        Standard deviations before the calibration, in the same units.
    residuals : Residuals
    source_m : (record, axis) float64
        Reflector, mirror image or emitter of each recording, in metres.
    swaps : tuple of tuple of int
        Channels that exchanged their places: pairs, or longer cycles.
    inverted, silent : tuple of int
        Channels with inverted polarity, and without the sound.
    unclear : tuple of int
        Channels whose sound differs from that of the others, such as an overlapping echo. They keep their calibration.
    duplicates : dict of int to int
        Channels with the samples of another channel, and that channel.
    order : str
        Name of the order in which the channels are; empty if it is that of the layout.
    mirrored : str
        How the layout is mirrored; empty if it is not, or if no place of a reflector is known.
    sound_speed : SoundSpeed, optional
        Measured speed of sound, from the distance of a reflector or from direct sound.
    scale : ArrayScale, optional
        Size of the array relative to the layout, from the direction of the first place. Positions keep the scale of the
        layout.
    not_observable : tuple of str
        Quantities that these recordings cannot determine, with what to do about it.
    contrast_db : tuple of float
        Contrast of images before and after the calibration, in decibels; see `image_contrast_db`.
    rejected : dict of int to str
        Index of each recording that was left out, and the reason.

    Examples
    --------
    Process with the calibrated layout::

        calibration = ertis.calibrate(recordings)
        settings = recordings[0].settings.replace(array=calibration.layout.to_array())
        print(calibration.gain_db, "±", 1.96 * calibration.gain_sd_db)
    """

    layout: Layout
    former: Layout
    channels: tuple[int, ...]
    gain_db: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    moved_m: NDArray[np.float64]
    covariance: NDArray[np.float64]
    expected_sd: NDArray[np.float64]
    residuals: Residuals
    source_m: NDArray[np.float64]
    swaps: tuple[tuple[int, ...], ...]
    inverted: tuple[int, ...]
    silent: tuple[int, ...]
    unclear: tuple[int, ...]
    duplicates: dict[int, int]
    order: str
    mirrored: str
    sound_speed: SoundSpeed | None
    scale: ArrayScale | None
    not_observable: tuple[str, ...]
    contrast_db: tuple[float, ...]
    rejected: dict[int, str]

    @property
    def changes(self) -> NDArray[np.float64]:
        """Changes of gain in dB, delay in µs, and x, y and z in mm: (mic, quantity) float64."""
        return np.column_stack([self.gain_db, 1e6 * self.delay_s, 1e3 * self.moved_m])

    @property
    def sd(self) -> NDArray[np.float64]:
        """Standard deviations of gain in dB, delay in µs, and x, y and z in mm: (mic, quantity) float64."""
        size = 5 * len(self.channels)
        variance = np.diag(self.covariance.reshape(size, size)).clip(min=0)
        return np.asarray(np.sqrt(variance).reshape(-1, 5))

    @property
    def gain_sd_db(self) -> NDArray[np.float64]:
        """Standard deviations of the gains in decibels: (mic,) float64."""
        return self.sd[:, 0]

    @property
    def delay_sd_s(self) -> NDArray[np.float64]:
        """Standard deviations of the delays in seconds: (mic,) float64."""
        return 1e-6 * self.sd[:, 1]

    @property
    def position_sd_m(self) -> NDArray[np.float64]:
        """Standard deviations of the positions in metres: (mic, axis) float64."""
        return 1e-3 * self.sd[:, 2:]

    @property
    def is_observed(self) -> NDArray[np.bool_]:
        """True for quantities that the recordings determine, not the expected deviations: (mic, quantity) bool."""
        return np.asarray((self.expected_sd > 0) & (self.sd < _WELL_KNOWN * self.expected_sd))

    @property
    def findings(self) -> tuple[str, ...]:
        """Faults of the array, one line each."""
        lines = [f"channels are in {self.order}"] if self.order else []
        lines += [f"the layout is {self.mirrored}"] if self.mirrored else []
        if self.scale is not None and self.scale.contradicts:
            lines.append(
                f"the array is about {self.scale.ratio:.2f} times as large as the layout, or the direction of the "
                "first place is wrong; neither is corrected"
            )
        for cycle in self.swaps:
            if len(cycle) == 2:
                lines.append(f"channels {cycle[0]} and {cycle[1]} are swapped")
            else:
                lines.append(f"channels {_listed(cycle)} are at each other's positions, in a cycle")
        lines += [f"channel {channel} is inverted" for channel in self.inverted]
        lines += [f"channel {channel} repeats channel {other}" for channel, other in self.duplicates.items()]
        return (*lines, *(f"channel {channel} is silent" for channel in self.silent))


def _listed(channels: tuple[int, ...]) -> str:
    return f"{', '.join(map(str, channels[:-1]))} and {channels[-1]}"

"""Channels to exclude from processing, of all sensors or of some."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from ertis_numba.base import checks
from ertis_numba.base.constants import MAX_MICROPHONES
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings.settings import Settings

__all__ = ["ExcludedChannels"]


@dataclass(frozen=True, slots=True)
class ExcludedChannels:
    """Channels to exclude, such as those of faulty microphones, in addition to ``array.disabled`` of a recording.

    Attributes
    ----------
    of_all : tuple of int
        Channels to exclude of every sensor, counted from 0.
    of_sensor : mapping of str to tuple of int
        Further channels, by name of their sensor.

    Raises
    ------
    ArgumentError
        A channel is no whole number from 0 to 1023, or a name cannot be that of a sensor.

    Examples
    --------
    >>> from ertis_numba.settings import ExcludedChannels, Settings
    >>> excluded = ExcludedChannels(of_sensor={"left": (7, 12)})
    >>> excluded.applied(Settings(), "left").array.disabled
    (7, 12)
    """

    of_all: tuple[int, ...] = ()
    of_sensor: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for channel in self.of_all:
            checks.integer("of_all", channel, 0, MAX_MICROPHONES - 1)
        for name, channels in self.of_sensor.items():
            checks.sensor_name(name)
            for channel in channels:
                checks.integer(f"of_sensor[{name!r}]", channel, 0, MAX_MICROPHONES - 1)

    def __contains__(self, channel: object) -> bool:
        """Return True if a channel of any sensor is excluded."""
        return any(channel in channels for channels in (self.of_all, *self.of_sensor.values()))

    def applied(self, settings: Settings, sensor: str) -> Settings:
        """Return the settings of a sensor without the excluded channels."""
        excluded = {*self.of_all, *self.of_sensor.get(sensor, ())}
        if not excluded:
            return settings
        disabled = tuple(sorted(excluded.union(settings.array.disabled or ())))
        return settings.replace(array=settings.array.replace(disabled=disabled))

    def require_known(self, sensors: Collection[str]) -> None:
        """Refuse names of sensors that do not exist.

        Parameters
        ----------
        sensors : collection of str
            Names of all sensors.

        Raises
        ------
        ArgumentError
            Channels of another sensor are excluded.
        """
        unknown = [name for name in self.of_sensor if name not in sensors]
        if unknown:
            found = checks.unknown_choice("sensor", unknown[0], sorted(sensors))
            raise ArgumentError(f"{found}; its channels cannot be excluded")

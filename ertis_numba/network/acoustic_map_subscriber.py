"""Application node that computes acoustic maps from measurements as they arrive."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import AcousticMap, Bearing, Measurement, is_passive
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.result_subscriber import ResultSubscriber
from ertis_numba.network.subscriber import Arrival, Subscriber
from ertis_numba.passive import AcousticCamera
from ertis_numba.settings import Settings

__all__ = ["AcousticMapSubscriber"]

_MAX_CHANGE: Final = 2e-3  # of the speed of sound, by about 1 K; it turns directions 45° aside by 0.1°.


class AcousticMapSubscriber(ResultSubscriber[Measurement, AcousticMap]):
    """Receiver of measurements that computes acoustic maps; use it in a ``with`` statement and a loop.

    Maps are computed here, not at the central node, which sends the measurements as they are. A measurement of 36 ms of
    an eRTIS takes 0.65 MB. An application that is too slow gets the latest measurements.

    Parameters
    ----------
    address : str
        Address at which the central node publishes, ``tcp://HOST:PORT``.
    sensors : sequence of str, optional
        All by default.
    changes : mapping of str to value, optional
        Changes of the settings of each sensor, such as ``{"passive.averages": 10, "processing.directions": "3000"}``.
    false_alarm : float, optional
        Probability that noise alone yields any bearing. If given, bearings are found with each map; none are searched
        by default.
    device : {"auto", "cpu", "cuda", "numpy"}
    threads : int, optional
        Number of threads; all cores by default.
    keys : ClientKeys, optional
        None on loopback only.
    on_note : callable, optional
        Called by a thread with a line for each change of the connection.

    Attributes
    ----------
    counts : SubscriberCounts
        Counts of the measurements.
    bearings : tuple of Bearing
        Bearings of the last map; empty without ``false_alarm``.
    band_note : str or None
        Note of `AcousticCamera.band_note` on the sensor of the last map.
    n_active : int
        Measurements with a call. They are left out unless ``processing.mode`` is ``passive``.

    Raises
    ------
    ArgumentError
        The address, a sensor or a change cannot be used, or the address requires keys.

    Examples
    --------
    >>> with AcousticMapSubscriber("tcp://127.0.0.1:5602") as subscriber:  # doctest: +SKIP
    ...     for found in subscriber:
    ...         print(found.stamp.sensor, found.loudest()[-1])
    """

    def __init__(
        self,
        address: str,
        *,
        sensors: Sequence[str] | None = None,
        changes: Mapping[str, Any] | None = None,
        false_alarm: float | None = None,
        device: str = "auto",
        threads: int | None = None,
        keys: ClientKeys | None = None,
        on_note: Callable[[str], None] | None = None,
    ) -> None:
        self._changes, self._device, self._threads = dict(changes or {}), device, threads
        self._false_alarm = false_alarm
        self._hearer_of(Settings()).close()  # refuses changes, and loads kernels
        self._hearers: dict[str, _Hearer] = {}
        self.bearings: tuple[Bearing, ...] = ()
        self.band_note: str | None = None
        self.n_active = 0
        self._subscriber: Subscriber[Measurement] = Subscriber(
            address, sensors=sensors, products=["raw"], keys=keys, on_note=on_note, credit=8
        )
        super().__init__(self._subscriber)

    @property
    def latest(self) -> Arrival | None:
        """Details of the last received measurement: its number and times, and the mounting of its sensor."""
        return self._subscriber.latest

    def close(self) -> None:
        """End the loop; waiting measurements are lost."""
        super().close()
        while self._hearers:
            self._hearers.popitem()[1].close()

    def _result(self, received: Measurement) -> AcousticMap | None:
        hearer = self._hearer(received)
        camera = hearer.camera
        if not is_passive(camera.settings, received.stamp):
            self.n_active += 1
            return None
        # The air of each measurement may be measured; the delays of a map are those of the first one.
        camera.add(Measurement(received.data, camera.settings, received.stamp))
        if camera.n_measurements < camera.settings.passive.averages:
            return None
        found = camera.map()
        self.band_note = camera.band_note
        self.bearings = found.bearings
        camera.reset()
        return found

    def _hearer(self, measurement: Measurement) -> "_Hearer":
        """Return the camera of a measurement's sensor; a new one after a change of its settings."""
        sensor, settings = measurement.stamp.sensor, measurement.settings
        known = self._hearers.get(sensor)
        if known is not None and known.suits(settings):
            return known
        try:
            made = self._hearer_of(settings)
        except ArgumentError as error:
            raise DataError(f"settings of sensor {sensor!r} cannot be used for acoustic maps ({error})") from error
        if known is not None:
            known.close()
        self._hearers[sensor] = made
        return made

    def _hearer_of(self, settings: Settings) -> "_Hearer":
        changed = settings.replace(**self._changes)
        camera = AcousticCamera(changed, self._device, self._threads, check=False, false_alarm=self._false_alarm)
        return _Hearer(settings, camera)


class _Hearer(NamedTuple):
    settings: Settings
    camera: AcousticCamera

    def suits(self, settings: Settings) -> bool:
        """Return True unless settings differ, or before the first measurement of a map, the speed of sound."""
        known = self.settings
        change = sound_speed_m_s(settings.air) / sound_speed_m_s(known.air) - 1
        is_same_air = abs(change) < _MAX_CHANGE or self.camera.n_measurements > 0
        return is_same_air and known == settings.replace(air=known.air)

    def close(self) -> None:
        self.camera.close()

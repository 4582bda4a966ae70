"""Application node that fuses the images of all sensors as they arrive."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass

import numpy as np

from ertis_numba.base.errors import ErtisError
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.fusion import Fused, Fuser
from ertis_numba.fusion.rig import Mountings
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.pulse_receiver import PulseReceiver, ReceivedPulse
from ertis_numba.network.result_subscriber import ResultSubscriber
from ertis_numba.settings import Processing, Settings

__all__ = ["FusedArrival", "FusedSubscriber"]

_AHEAD = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FusedArrival:
    """A fused pulse with its times.

    Attributes
    ----------
    fused : Fused
    images : mapping of str to Energyscape
        Images that were fused, by sensor.
    first_ns : int
        Emission, by the monotonic clock of the sensor node; that of this machine if the node runs on it.
    ready_ns : int
        End of the fusion, by the monotonic clock of this machine.
    ready_utc_ns : int
        The same by the system clock.
    """

    fused: Fused
    images: Mapping[str, Energyscape]
    first_ns: int
    ready_ns: int
    ready_utc_ns: int

    @property
    def age_s(self) -> float | None:
        """Time in s from the emission to the end of the fusion, if the clocks of both machines agree."""
        stamp = self.fused.stamp
        return (self.ready_utc_ns - stamp.timestamp_ns) / 1e9 if stamp.is_timed else None


class FusedSubscriber(ResultSubscriber[ReceivedPulse, FusedArrival]):
    """Receiver of the images of a central node, fused for each SYNC pulse; use it in a ``with`` statement and a loop.

    Images are fused here, not at the central node, which therefore needs no more time. A pulse is complete when all
    sensors of the two pulses before have sent their image. A missing sensor delays it until up to three later pulses
    have begun, or until no image has come for 0.25 s. An application that is too slow gets the latest pulses.

    Kernels are loaded, or compiled on a new installation, before the connection is made. The first pulse, and the first
    one after a change of settings or mountings, needs tables. Pulses that arrive meanwhile wait, and the subscriber
    catches up.

    Parameters
    ----------
    address : str
        Address at which the central node publishes, ``tcp://HOST:PORT``.
    mountings : mapping of str to (translation_m, rotation_xyzw), optional
        Mountings by sensor instead of those that the central node sends.
    sensors : sequence of str, optional
        All by default.
    keys : ClientKeys, optional
        None on loopback only.
    on_note : callable, optional
        Called by a thread with a line for each change of the connection, for each sensor that is left out because its
        mounting is unknown or its images are not finite, and for pulses that cannot be fused.
    emitter_diameter_m, spacing_deg, range_step_m : float
        As for `Fuser`; a planar pulse of four sensors takes some 25 ms with the default spacings.

    Attributes
    ----------
    counts : SubscriberCounts
        Counts of the images.

    Raises
    ------
    ArgumentError
        The address or a sensor cannot be used, or the address requires keys.

    Examples
    --------
    >>> with FusedSubscriber("tcp://127.0.0.1:5602") as subscriber:  # doctest: +SKIP
    ...     for arrival in subscriber:
    ...         print(arrival.fused.sensors, arrival.fused.points.position_m[:1])
    """

    def __init__(
        self,
        address: str,
        *,
        mountings: Mountings | None = None,
        sensors: Sequence[str] | None = None,
        keys: ClientKeys | None = None,
        on_note: Callable[[str], None] | None = None,
        emitter_diameter_m: float | None = None,
        spacing_deg: float | None = 2.0,
        range_step_m: float | None = 0.02,
    ) -> None:
        self._options = {
            "emitter_diameter_m": emitter_diameter_m,
            "spacing_deg": spacing_deg,
            "range_step_m": range_step_m,
        }
        _load_kernels()
        self._mountings: Mountings = {}
        self._fuser: Fuser | None = None
        self._receiver = PulseReceiver(
            address, mountings=mountings, sensors=sensors, keys=keys, on_note=on_note, on_image=self._prepare
        )
        super().__init__(self._receiver)
        self._note, self._noted = on_note or (lambda _: None), ""

    def _result(self, received: ReceivedPulse) -> FusedArrival | None:
        try:
            return self._fused(received)
        except ErtisError as error:  # Others of its pulses may be usable.
            if str(error) != self._noted:
                self._noted = str(error)
                self._note(f"SYNC pulse {next(iter(received.images.values())).stamp.sync_count} is left out: {error}")
            return None

    def _prepare(self, image: Energyscape) -> None:
        """Find the echoes of an image while others of its pulse are missing."""
        if (fuser := self._fuser) is not None:
            with suppress(ErtisError):  # The fusion of its pulse raises it again.
                fuser.prepare(image)

    def _fused(self, received: ReceivedPulse) -> FusedArrival:
        if self._fuser is None or received.mountings != self._mountings:
            self._mountings = received.mountings
            self._fuser = Fuser(received.mountings, **self._options)  # type: ignore[arg-type]  # all options are numbers or None
        images = received.images.values()
        with nullcontext() if self._fuser.has_tables(images) else self._receiver.queue.keeping():
            fused = self._fuser(images)
            assert fused.image.amplitude.size  # noqa: S101  The time of the arrival includes the image.
        return FusedArrival(fused, received.images, received.first_ns, time.monotonic_ns(), time.time_ns())


def _load_kernels() -> None:
    """Fuse two small images, so that a later fusion and its points need not load or compile kernels."""
    settings = Settings(processing=Processing(directions="2d:9", range_m=(0.5, 1.0)))
    azimuth_rad, range_m = np.radians(np.linspace(-80.0, 80.0, 9)), np.arange(0.5, 1.0, 0.01)
    amplitude = np.full((9, len(range_m)), 1e-4, dtype=np.float32)
    amplitude[4, 20:23] = 1.0, 2.0, 1.0
    images = [
        Energyscape(amplitude, azimuth_rad, np.zeros(9), range_m, settings, Stamp(sensor=name))
        for name in ("left", "right")
    ]
    fuser = Fuser({"left": ((0.0, 0.1, 0.0), _AHEAD), "right": ((0.0, -0.1, 0.0), _AHEAD)}, spacing_deg=10.0)
    assert len(fuser(images).points) >= 0  # noqa: S101  points are computed when they are used

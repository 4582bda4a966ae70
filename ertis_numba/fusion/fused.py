"""Fused images and points of a group of sensors, computed when they are first read."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.fusion.tables import PulseReflectors

__all__ = ["Fused"]


@dataclass(frozen=True, eq=False)
class Fused:
    """Fused image and points of a group of sensors.

    Attributes
    ----------
    stamp : Stamp
        That of the earliest image, with the sensor ``base_link``.
    image : Energyscape
        Image around the platform with its points, computed at the first access. Amplitudes are those of
        echoes at 1 m from reflectors of the same strength. Echoes of confirmed points appear at the points only, with
        their amplitude.
    points : PointCloud
        Reflectors in the frame of the platform, with uncertainties, computed at the first access. Echoes that do not
        exceed the noise of their image yield none.
    sensors : tuple of str
        Sensors whose images were fused.
    missing : tuple of str
        Sensors with a mounting, but without an image.
    unheard : tuple of str
        Sensors whose calls are not heard at reflectors where they should be, in this pulse and the two before. Their
        emitters may be broken, or they are not on the same SYNC chain. They are fused without echoes of their calls.
        Computed with the points.
    without_echo : tuple of str
        Fused sensors whose images hold no echo above their noise. If it names all, the pulse returned no echo. Computed
        with the points.
    without_own_echo : tuple of str
        Fused sensors whose emission no echo proves, in this pulse and the two before: no echo of their own call locates
        a reflector, or silence of their emitters explains the echoes at least as well. Nothing may reflect their calls,
        or their emitters may be broken, so that obstacles ahead of them may be missing. Computed at the first access,
        which may take a few times as long as the points.
    undecided : tuple of str
        Sensors in ``without_own_echo`` whose emission and silence explain the echoes equally well. Maps treat them as
        working.
    noise : dict of str to float
        Detection threshold of each fused sensor: noise exceeds it anywhere in the image with a probability of 10⁻⁵.
        Infinite if the image consists of zeros.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> unturned = (0.0, 0.0, 0.0, 1.0)
    >>> mountings = {image.stamp.sensor: ((0.1, 0.0, 0.0), unturned), "left": ((0.0, 0.1, 0.0), unturned)}
    >>> fused = ertis.fuse([image], mountings)
    >>> fused.sensors, fused.missing
    (('sensor',), ('left',))
    """

    stamp: Stamp
    sensors: tuple[str, ...]
    missing: tuple[str, ...]
    _solve: Callable[[], PulseReflectors] = field(repr=False)
    _render: Callable[[PulseReflectors], Energyscape] = field(repr=False)
    _locate: Callable[[PulseReflectors], PointCloud] = field(repr=False)
    _evidence: Callable[[], dict[int, float]] = field(repr=False)
    _names: tuple[str, ...] = field(repr=False)

    @functools.cached_property
    def image(self) -> Energyscape:
        """Image around the platform, with its points, because maxima of the image may be ghosts."""
        return self._render(self._solve()).replace(points=self.points)

    @functools.cached_property
    def points(self) -> PointCloud:
        """Reflectors in the frame of the platform.

        Amplitudes are those that a single sensor would measure if the reflector were at 1 m on the axis of its emitter.
        Where the calls of two sensors arrive together, with unknown phases, they may be 3 dB too high, or up to 13 dB
        too low where the calls cancel each other. In planar images, positions are at the height of the sensors, and
        uncertainties allow for elevations up to 12°.
        """
        return self._locate(self._solve())

    @property
    def unheard(self) -> tuple[str, ...]:
        """Sensors whose calls are not heard at reflectors where they should be."""
        found = self._solve()
        return tuple(self._names[number] for number in sorted(found.unheard | found.apart))

    @property
    def description_length(self) -> int:
        """Unexplained and missed echoes, and two numbers for each reflector; more with wrong emitters or mountings."""
        return self._solve().length

    @property
    def without_echo(self) -> tuple[str, ...]:
        """Fused sensors whose images hold no echo above their noise."""
        return tuple(self._names[number] for number in self._solve().without_echo)

    @property
    def without_own_echo(self) -> tuple[str, ...]:
        """Fused sensors whose emission no echo proves, in this pulse and the two before."""
        return tuple(self._names[number] for number, better in sorted(self._evidence().items()) if better <= 0)

    @property
    def undecided(self) -> tuple[str, ...]:
        """Sensors in `without_own_echo` whose emission and silence explain the echoes equally well."""
        return tuple(self._names[number] for number, better in sorted(self._evidence().items()) if better == 0)

    @property
    def noise(self) -> dict[str, float]:
        """Detection threshold of each fused sensor: amplitude that steady noise exceeds in one of 100,000 images."""
        return {self._names[number]: floor.lasting for number, floor in self._solve().floor.items()}

    @property
    def is_empty(self) -> bool:
        """True if no image holds an echo above its noise, so that the pulse returned no echo."""
        return len(self._solve().without_echo) == len(self.sensors)

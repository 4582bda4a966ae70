"""Fusion of the images of sensors that emit together."""

import functools
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Final

import numpy as np

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Energyscape
from ertis_numba.fusion.emissions import PulseEvidence, best_evidence, is_much_better
from ertis_numba.fusion.fused import Fused
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.pulses import is_same_pulse
from ertis_numba.fusion.rig import (
    USUAL_DIAMETER_M,
    Mountings,
    emitter_diameter_m,
    mounted_sensors,
    require_common_reach,
)
from ertis_numba.fusion.tables import FusionTables, PulseReflectors
from ertis_numba.geometry import require_places
from ertis_numba.settings import MAX_EMITTER_M, Array

__all__ = ["Fuser", "fuse"]

_SPACING_DEG: Final = 1.0, 4.0  # of planar and of three-dimensional images
_STEP_M: Final = 0.015, 0.03
_N_COMPARED: Final = 3  # Pulses that other emitters are tried for.
_N_SHOWN: Final = 3  # Pulses whose echoes may prove that an emitter works.


class Fuser:
    """Fusion of the images of sensors on one platform, with tables for the directions and ranges of their images.

    Sensors that emit together hear each other's calls. Such a foreign echo has travelled from one sensor over the
    reflector to another one, so the reflector lies on an ellipse around both. Each pair of emitter and receiver has its
    own range axis, and each part of an image is attributed to the pair whose reflectors explain it. Foreign echoes thus
    do not appear as ghosts, and confirm reflectors instead. The settings of the images contain the delay of each
    sensor's call. A sensor without an image so far is assumed to emit together with the first one that has an image,
    and by an emitter of the same diameter.

    Parameters
    ----------
    mountings : mapping of str to (translation_m, rotation_xyzw)
        Mountings of all sensors: position x, y, z in metres, and the unit quaternion x, y, z, w that rotates the sensor
        frame into the platform frame. Sensors without an image still emit.
    emitter_diameter_m : float, optional
        Diameter of the emitters as pistons, which determines their directivity; 0 for omnidirectional ones. By default,
        that in the settings of each sensor, ``array.emitter_diameter_m``, or in its layout; 0.012 if neither states it.
    spacing_deg : float, optional
        Spacing of directions; 1° for planar images, and 4° for others by default.
    range_step_m : float, optional
        Spacing of ranges; 1.5 cm for planar images, and 3 cm for others by default.
    silent : collection of str
        Sensors that do not emit.

    Raises
    ------
    ArgumentError
        A mounting is missing or invalid, or an option names an unknown sensor or is out of range.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> ahead, behind = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)
    >>> fuser = ertis.Fuser({"front": ((0.2, 0.0, 0.0), ahead), "back": ((-0.2, 0.0, 0.0), behind)})
    >>> fuser.sensors
    ('front', 'back')
    """

    def __init__(
        self,
        mountings: Mountings,
        *,
        emitter_diameter_m: float | None = None,
        spacing_deg: float | None = None,
        range_step_m: float | None = None,
        silent: Collection[str] = (),
    ) -> None:
        self._given, self._mountings = mountings, mounted_sensors(mountings)
        self._numbers = {sensor.name: number for number, sensor in enumerate(self._mountings)}
        if emitter_diameter_m is not None:
            checks.between("emitter_diameter_m", emitter_diameter_m, 0.0, MAX_EMITTER_M)
        self._given_m = emitter_diameter_m
        self._spacing_deg, self._step_m = spacing_deg, range_step_m
        for sensor in silent:
            self._number(sensor, "silent")
        self._emitting = [number for number, sensor in enumerate(self._mountings) if sensor.name not in silent]
        self._start_s: dict[int, float] = {}  # of the calls of all sensors so far
        self._diameter_m: dict[int, float] = {}  # of the emitters of all sensors so far
        self._observing: dict[int, tuple[Array, bool]] = {}  # Arrays that observe places, and whether images are planar
        self._tables: FusionTables | None = None
        self._last: Callable[[], PulseReflectors] | None = None  # of the pulse before
        self._first: list[tuple[tuple[Energyscape, ...], Callable[[], PulseReflectors]]] = []
        self._evidence: list[PulseEvidence] = []  # of the pulse and those before
        self._options = {"spacing_deg": spacing_deg, "range_step_m": range_step_m, "silent": tuple(silent)}

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors, in the order of the mountings."""
        return tuple(self._numbers)

    def __call__(self, images: Iterable[Energyscape]) -> Fused:
        """Return the fusion of the images of one SYNC pulse.

        Parameters
        ----------
        images : iterable of Energyscape
            At most one image of each sensor. Sensors may be missing.

        Returns
        -------
        Fused

        Raises
        ------
        ArgumentError
            There is no image, two images of the same sensor, an image without a mounting, a mixture of planar and
            other images, an image whose array observes no places (see `ertis_numba.geometry.observable_angles`), or a
            mounting so far from all others that no reflector is within the range of two sensors.
        DataError
            The images are not from the same pulse.
        """
        group = self._group(images)
        self._start_s |= {number: image.settings.call.start_s for number, image in group.items()}
        self._diameter_m |= self._diameters_m(group)
        if self._tables is None or not self._tables.fit(group, self._diameter_m):
            self._tables, self._last, self._evidence = self._new_tables(group), None, []
        tables = self._tables
        before = None if self._last is None else self._last()
        unheard, pulses = (frozenset[int](), ()) if before is None else (before.unheard, before.pulses)
        coarse = {number: tables.coarse(number, image) for number, image in group.items()}
        found = tables.attribution(group).without(unheard)(coarse)
        solve = self._last = functools.cache(lambda: tables.pulse_reflectors(group, found, unheard, pulses))
        recent = self._evidence = [*self._evidence, tables.evidence(group, solve)][-_N_SHOWN:]
        if len(self._first) < _N_COMPARED:
            self._first.append((tuple(group.values()), solve))
        return Fused(
            stamp=tables.stamp(group),
            sensors=tuple(self._mountings[number].name for number in group),
            missing=tuple(sensor.name for number, sensor in enumerate(self._mountings) if number not in group),
            _solve=solve,
            _render=lambda reflectors: tables.image(reflectors, group, coarse),
            _locate=lambda reflectors: tables.points(reflectors, group),
            _evidence=functools.cache(lambda: best_evidence(recent)),
            _names=self.sensors,
        )

    def emitter_warning(self) -> str | None:
        """Return a warning if echoes contradict the stated diameter of the emitters, else None.

        The first three pulses are fused again, with omnidirectional emitters in place of pistons, or the reverse. This
        takes as long as the tables of a second `Fuser`. Emitters of different kinds are not compared.

        Returns
        -------
        str or None
            A line that names the setting. None if the other kind does not explain the echoes much better.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> unturned = (0.0, 0.0, 0.0, 1.0)
        >>> ertis.Fuser({"left": ((0.0, 0.1, 0.0), unturned)}).emitter_warning() is None
        True
        """
        diameters_m = {*self._diameter_m.values()}
        if not self._first or len(self._mountings) < 2 or (0.0 in diameters_m and len(diameters_m) > 1):
            return None
        other_m = 0.0 if 0.0 not in diameters_m else USUAL_DIAMETER_M
        other = Fuser(self._given, emitter_diameter_m=other_m, **self._options)  # type: ignore[arg-type]  # by name
        stated = sum(solve().length for _, solve in self._first)
        better = sum(other(images).description_length for images, _ in self._first)
        if not is_much_better(better, stated):
            return None
        names = ("pistons", "omnidirectional emitters")
        right, wrong = names if other_m else names[::-1]
        return (
            "the echoes contradict the mountings or the emitters: they may be those of "
            f"{right}, but {wrong} are assumed; first compare the name, position and angles of each sensor with the "
            f"platform, and if all are right, set emitter_diameter_m to {'their diameter' if other_m else '0'}"
        )

    def has_tables(self, images: Iterable[Energyscape]) -> bool:
        """Return True if the tables for images exist, so that their fusion does not take longer than later ones.

        Parameters
        ----------
        images : iterable of Energyscape
            As for a call.

        Returns
        -------
        bool

        Raises
        ------
        ArgumentError, DataError
            As for a call.
        """
        group = self._group(images)
        return self._tables is not None and self._tables.cover(group, self._diameters_m(group))

    def prepare(self, image: Energyscape) -> None:
        """Find the echoes of an image before the others of its pulse arrive, if tables for it exist.

        The fusion of the pulse then takes less time. Another thread may call this.

        Parameters
        ----------
        image : Energyscape
            Image without NaN or infinity.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     image = ertis.Pipeline(recording.settings).process(recording[0])
        >>> ertis.Fuser({image.stamp.sensor: ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}).prepare(image)
        """
        tables, number = self._tables, self._numbers.get(image.stamp.sensor)
        if tables is not None and number is not None:
            group = {number: image}
            if tables.fit(group, self._diameters_m(group)):
                tables.prepare(number, image)

    def _group(self, images: Iterable[Energyscape]) -> dict[int, Energyscape]:
        """Return checked images by number of the sensor, in the order of the mountings."""
        found: dict[int, Energyscape] = {}
        for image in checks.items("images", images, Energyscape, "Pipeline.process returns"):
            number = self._number(image.stamp.sensor, "images")
            image.settings.processing.require_sensor_frame("fusion needs directions of each sensor")
            geometry = image.settings.array, image.is_planar
            if self._observing.get(number) != geometry:
                require_places(image.settings.array, image.stamp.sensor, is_planar=image.is_planar)
                self._observing[number] = geometry
            if number in found:
                raise ArgumentError(f"images has two of sensor {image.stamp.sensor!r}; use one image of each sensor")
            if not np.isfinite(image.amplitude).all():
                raise DataError(
                    f"the image of sensor {image.stamp.sensor!r} contains NaN or infinity; leave it out, or check its "
                    "samples with 'ertis sensors check'"
                )
            found[number] = image
        if not found:
            raise ArgumentError("images is empty; pass the images of one SYNC pulse")
        group = dict(sorted(found.items()))
        first, *others = group.values()
        for other in others:
            apart_ns = abs(other.stamp.timestamp_ns - first.stamp.timestamp_ns)
            if not is_same_pulse(other.stamp, first.stamp):
                raise DataError(
                    f"images of sensors {first.stamp.sensor!r} and {other.stamp.sensor!r} are not from the same pulse: "
                    f"SYNC counts {first.stamp.sync_count} and {other.stamp.sync_count}, {apart_ns / 1e9:.3g} s apart; "
                    "use images of equal count"
                )
            if other.is_planar != first.is_planar:
                raise ArgumentError(
                    f"the image of sensor {first.stamp.sensor!r} is {'' if first.is_planar else 'not '}planar, unlike "
                    f"that of {other.stamp.sensor!r}; process both with the same kind of directions"
                )
        return group

    def _diameters_m(self, group: Mapping[int, Energyscape]) -> dict[int, float]:
        return {number: emitter_diameter_m(image.settings, self._given_m) for number, image in group.items()}

    def _number(self, sensor: str, name: str) -> int:
        if sensor not in self._numbers:
            raise ArgumentError(
                f"{name} has sensor {sensor!r}, whose mounting is unknown; add it to mountings, or use sensors of "
                f"{', '.join(self._numbers)}"
            )
        return self._numbers[sensor]

    def _new_tables(self, group: Mapping[int, Energyscape]) -> "FusionTables":
        kind = 0 if next(iter(group.values())).is_planar else 1
        spacing_m = max(float(np.diff(image.range_m).max(initial=0.0)) for image in group.values())
        step_m = max(_STEP_M[kind], spacing_m) if self._step_m is None else self._step_m
        if step_m < spacing_m:
            raise ArgumentError(
                f"range_step_m is {step_m:g}, but ranges are {spacing_m:.3g} m apart; use a larger step"
            )
        require_common_reach(self._mountings, max(float(image.range_m[-1]) for image in group.values()))
        # Of all sensors: one without an image now may reach farthest in a later group.
        farthest_m = max(float(np.linalg.norm(sensor.translation_m[:2])) for sensor in self._mountings)
        last_m = farthest_m + max(float(image.range_m[-1]) for image in group.values())
        grid = PolarGrid.around(
            _SPACING_DEG[kind] if self._spacing_deg is None else self._spacing_deg,
            step_m,
            last_m,
            is_planar=kind == 0,
            height_m=float(np.mean([sensor.translation_m[2] for sensor in self._mountings])),
        )
        numbers, first = range(len(self._mountings)), next(iter(group))
        start_s, diameters_m = (
            [known.get(number, known[first]) for number in numbers] for known in (self._start_s, self._diameter_m)
        )
        return FusionTables(grid, self._mountings, self._emitting, start_s, diameters_m)


def fuse(images: Iterable[Energyscape], mountings: Mountings, *, emitter_diameter_m: float | None = None) -> Fused:
    """Return the fusion of the images of sensors that emitted together; use `Fuser` for several groups.

    Parameters
    ----------
    images : iterable of Energyscape
        Images of one SYNC pulse, at most one of each sensor.
    mountings : mapping of str to (translation_m, rotation_xyzw)
        Mountings of the sensors, as for `Fuser`.
    emitter_diameter_m : float, optional
        Diameter of the emitters in metres, as for `Fuser`.

    Returns
    -------
    Fused

    Raises
    ------
    ArgumentError
        A mounting is missing or invalid, or the images do not fit together.
    DataError
        The images are not from the same pulse.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> fused = ertis.fuse([image], {image.stamp.sensor: ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))})
    >>> fused.image.amplitude.shape[0], len(fused.points)
    (360, 5)
    """
    return Fuser(mountings, emitter_diameter_m=emitter_diameter_m)(images)

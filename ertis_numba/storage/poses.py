"""Poses of recordings: add a trajectory to a recording, and read the trajectory of its platform."""

import filecmp
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import h5py
import numpy as np
from numpy.typing import ArrayLike

from ertis_numba.base.atomic_files import atomic_write, check_target, reason, remedy, require_free_space
from ertis_numba.base.errors import ArgumentError, DataError, ErtisError
from ertis_numba.frames import Trajectory
from ertis_numba.frames.pose_doubts import warn_of_poses
from ertis_numba.storage._poses import MAX_GAP_S, checked_poses, remove_poses, require_times, write_poses
from ertis_numba.storage._reader import file_kind, sensor_names
from ertis_numba.storage.acoustic_maps import AcousticMapReader, open_acoustic_maps
from ertis_numba.storage.energyscape import EnergyscapeReader, open_energyscapes
from ertis_numba.storage.recording import RecordingReader, open_recording
from ertis_numba.storage.schema import FORMAT_VERSION, POSES, RECORDING, content_sha256, content_uuid, sensor_path
from ertis_numba.storage.variables import set_attributes, to_python

__all__ = ["add_poses", "count_in_gaps", "platform_trajectory", "recorded_trajectory", "require_fitting_poses"]

_OPENERS: Final[dict[str, Callable[..., RecordingReader | EnergyscapeReader | AcousticMapReader]]] = {
    "recording": open_recording,
    "energyscape": open_energyscapes,
    "acoustic_map": open_acoustic_maps,
}
_BYTES_PER_POSE: Final = 8 * (3 + 4 + 36)
_BYTES_PER_SENSOR: Final = 200_000  # Chunks that are not full, and tables.
_MAX_HISTORY: Final = 16_000  # Characters; an attribute of HDF5 is limited to 65,536 bytes.
_MAX_DIFFERENCE: Final = 1e-6  # m, or of a unit quaternion; poses of equal times differ by rounding only.
_MAX_RATE_1_S: Final = 100.0  # Change of a pose in a second, in the same units.


def add_poses(
    path: str | Path,
    trajectory: Trajectory,
    *,
    output: str | Path | None = None,
    overwrite: bool = False,
    replace: bool = False,
) -> Path:
    """Add the poses of a platform to a recording.

    The trajectory is interpolated at the times of the measurements of all sensors. Everything else in the recording
    stays the same, except its `uuid` and history. The file is replaced as a whole when the new one is complete.

    Parameters
    ----------
    path : str or Path
        Path of the recording.
    trajectory : Trajectory
        Poses of the platform, which cover all measurements.
    output : str or Path, optional
        Path of the recording with poses. By default, it replaces the given recording.
    overwrite : bool
        Replace an existing ``output``.
    replace : bool
        Replace the poses of a recording that has poses already.

    Returns
    -------
    Path
        Path of the recording with poses.

    Raises
    ------
    ArgumentError
        The trajectory does not cover the recording, the recording has poses already, or the output exists.
    DataError
        The recording cannot be read, or the output cannot be written.

    Warns
    -----
    PoseWarning
        The poses are hardly those of a platform: they tilt it, are mirrored or in other units, or are in ECEF.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     times_ns = [stamp.timestamp_ns for stamp in recording.stamps()]
    >>> identity = [0.0, 0.0, 0.0, 1.0]
    >>> drive = ertis.Trajectory(
    ...     [min(times_ns) - 1, max(times_ns) + 1], [[0, 0, 0], [1, 0, 0]], [identity, identity], source="application"
    ... )
    >>> path = ertis.add_poses("reflectors.h5", drive, output="moving.h5", overwrite=True)
    >>> with ertis.open_recording(path) as recording:
    ...     recording.trajectory.source
    'application'
    """
    source = Path(path)
    if not isinstance(trajectory, Trajectory):
        raise ArgumentError(f"trajectory is of type {type(trajectory).__name__}; pass a Trajectory")
    checked_poses(trajectory)
    warn_of_poses(trajectory, stacklevel=2)
    target = source if output is None else Path(output)
    if output is None:
        check_target(source, overwrite=True)
    else:
        check_target(target, overwrite=overwrite, sources=[source])
    n_poses = require_fitting_poses(source, trajectory, replace=replace)
    with _errors_with_path(target), atomic_write(target, overwrite=overwrite or output is None) as part:
        _copy(source, part, n_poses * _BYTES_PER_POSE)
        _add(part, trajectory)
        _verify(part, target)
    return target


def require_fitting_poses(path: str | Path, trajectory: Trajectory, *, replace: bool = False) -> int:
    """Refuse a recording that cannot get poses or, with ``replace``, other ones; return its number of measurements."""
    n_measurements = 0
    for sensor in sensor_names(path, "a recording"):
        with open_recording(path, sensor=sensor) as recording:
            if recording.trajectory is not None and not replace:
                origin = f" (source {recording.trajectory.source!r})" if recording.trajectory.source else ""
                raise ArgumentError(f"{path} has poses already{origin}; keep them, or replace them (replace=True)")
            time_ns = np.array([stamp.timestamp_ns for stamp in recording.stamps()], np.int64)
        n_measurements += len(time_ns)
        try:
            require_times(trajectory, time_ns, sensor)
        except ArgumentError as error:
            raise ArgumentError(f"{path}: {error}") from error
        if len(time_ns) and not trajectory.covers(time_ns).any():
            raise ArgumentError(
                f"{path}: no measurement of sensor {sensor} is within the poses; use poses for this time, or correct "
                "the clock offset"
            )
    return n_measurements


def count_in_gaps(trajectory: Trajectory, time_ns: ArrayLike) -> int:
    """Return the number of times since 1970 in ns whose poses are interpolated over more than a second."""
    is_near = trajectory.replace(max_gap_s=MAX_GAP_S).covers(time_ns)
    return int(np.count_nonzero(trajectory.covers(time_ns) & ~is_near))


def recorded_trajectory(path: str | Path, *, sensor: str | None = None) -> Trajectory | None:
    """Return the trajectory of the platform from the poses at the measurements of all sensors.

    Parameters
    ----------
    path : str or Path
        Path of a recording, an energyscape file or a file of acoustic maps.
    sensor : str, optional
        Name of the sensor; all sensors by default.

    Returns
    -------
    Trajectory or None
        One pose for each time at which a sensor has measured; None if the recording has no poses.

    Raises
    ------
    ArgumentError
        Sensors have different poses at the same time, or the file does not contain the sensor.
    DataError
        The recording cannot be read.
    """
    opened = _OPENERS[file_kind(path)]
    found: dict[str, Trajectory] = {}
    for name in sensor_names(path) if sensor is None else (sensor,):
        with opened(path, sensor=name) as reader:
            if reader.trajectory is not None:
                found[name] = reader.trajectory
    return _merged(found, f"{path}: sensors", "choose one sensor")


def platform_trajectory(paths: Iterable[str | Path]) -> Trajectory | None:
    """Return the trajectory of a platform whose sensors have recordings of their own.

    Parameters
    ----------
    paths : iterable of str or Path
        Paths of recordings; their order does not matter.

    Returns
    -------
    Trajectory or None
        One pose for each time at which a sensor has measured; None if no recording has poses.

    Raises
    ------
    ArgumentError
        Sensors have different poses at the same time, or recordings have poses of different sources.
    DataError
        A recording cannot be read.
    """
    found: dict[str, Trajectory] = {}
    for path in sorted(map(str, paths)):
        trajectory = recorded_trajectory(path)
        if trajectory is not None:
            found[path] = trajectory
    sources = {trajectory.source: path for path, trajectory in found.items()}
    if len(sources) > 1:
        named = " and ".join(f"{path} from {source or 'an unknown source'!r}" for source, path in sources.items())
        raise ArgumentError(f"poses have different sources: those of {named}; use one trajectory for all (poses)")
    return _merged(found, "recordings", "use one trajectory for all (poses)")


def _merged(found: dict[str, Trajectory], kind: str, advice: str) -> Trajectory | None:
    """Return the poses of all sensors or recordings by time; None without any."""
    if len(found) < 2:
        return next(iter(found.values()), None)
    several = [*found.values()]
    rows = np.concatenate([np.column_stack([each.position_m, each.rotation_xyzw]) for each in several])
    owners = np.repeat(np.arange(len(several)), [len(each) for each in several])
    all_ns = np.concatenate([each.time_ns for each in several])
    order = np.argsort(all_ns, kind="stable")
    pairs = np.stack([order[:-1], order[1:]], axis=1)[owners[order[:-1]] != owners[order[1:]]]
    before, after = rows[pairs[:, 0]], rows[pairs[:, 1]]
    turned = np.sign(np.sum(before[:, 3:] * after[:, 3:], axis=1, keepdims=True))  # q and -q are the same rotation.
    difference = np.abs(np.column_stack([after[:, :3] - before[:, :3], turned * after[:, 3:] - before[:, 3:]]))
    beyond = difference.max(axis=1) - _MAX_RATE_1_S * 1e-9 * np.diff(all_ns[pairs], axis=1)[:, 0]
    if beyond.max(initial=0.0) > _MAX_DIFFERENCE:
        worst = pairs[beyond.argmax()]
        names = " and ".join([*found][owner] for owner in owners[worst])
        raise ArgumentError(f"{kind} {names} have different poses at {all_ns[worst[1]]} ns; {advice}")
    time_ns, first = np.unique(all_ns, return_index=True)
    covariances = [each.covariance for each in several]
    known = [each for each in covariances if each is not None]
    covariance = np.concatenate(known)[first] if len(known) == len(covariances) else None
    gaps_s = [each.max_gap_s for each in several if each.max_gap_s is not None]
    max_gap_s = min(gaps_s, default=None)
    return Trajectory(time_ns, rows[first, :3], rows[first, 3:], covariance, several[0].source, max_gap_s)


def _copy(source: Path, part: Path, n_bytes: int) -> None:
    """Copy a recording, and compare the copy."""
    with h5py.File(source, "r") as file:
        n_sensors = len(file["sensors"])
    require_free_space(part.parent, source.stat().st_size + n_bytes + n_sensors * _BYTES_PER_SENSOR)
    shutil.copyfile(source, part)
    if not filecmp.cmp(source, part, shallow=False):
        raise DataError(f"{source} reads back with other content than was copied; check the disk")


def _add(part: Path, trajectory: Trajectory) -> None:
    """Add poses to a copy of a recording."""
    file = h5py.File(part, "r+", libver=("v110", "v110"))
    try:
        _add_to_sensors(file, trajectory)
        file.close()
    except BaseException:
        # Closing writes buffered data, and HDF5 crashes the process if that fails (h5py issue 914). An empty file frees
        # the necessary space.
        with suppress(OSError, RuntimeError):  # The first error is the one to report.
            os.truncate(part, 0)
            file.close()
        raise


def _add_to_sensors(file: h5py.File, trajectory: Trajectory) -> None:
    """Add poses to all sensors, and update the attributes that depend on the content."""
    contents: dict[str, str] = {}
    for sensor in file["sensors"]:
        group = file[sensor_path(sensor)]
        remove_poses(group)
        write_poses(group, trajectory)
        contents[sensor] = content_sha256(group, (*RECORDING, *POSES))
        set_attributes(group, {"content_sha256": contents[sensor]})
    history = str(to_python(file.attrs.get("history", b"")))
    added = f"poses added (source {trajectory.source!r})"
    set_attributes(
        file,
        {
            "ertis_format_version": FORMAT_VERSION,
            "uuid": content_uuid(contents),
            "history": "; ".join(filter(None, (history, added)))[:_MAX_HISTORY],
        },
    )


def _verify(part: Path, target: Path) -> None:
    """Read the parts of the new recording that changed."""
    for sensor in sensor_names(part):
        with RecordingReader(part, sensor=sensor) as recording:
            if recording.trajectory is None and len(recording):
                raise DataError(f"{target} reads back without poses; check the disk")


@contextmanager
def _errors_with_path(path: Path) -> Iterator[None]:
    try:
        yield
    except ErtisError:
        raise
    except (OSError, RuntimeError, ValueError, LookupError) as error:  # Errors of h5py for disks and foreign files.
        raise DataError(f"{path} cannot be written ({reason(error)}); {remedy(error)}") from error

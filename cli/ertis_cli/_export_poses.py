"""Export of the poses in a recording, for ``ertis export --format tum``."""

from pathlib import Path

from ertis_cli import options

__all__ = ["export_poses"]


def export_poses(path: Path, target: Path, sensor: str | None, *, force: bool, quiet: bool, as_json: bool) -> None:
    """Write the poses of a recording in the TUM format."""
    from ertis_numba import write_tum
    from ertis_numba.base.atomic_files import check_target
    from ertis_numba.base.errors import DataError
    from ertis_numba.storage import recorded_trajectory, sensor_names

    check_target(target, overwrite=force, sources=[path])
    poses = recorded_trajectory(path, sensor=sensor)
    if poses is None:
        raise DataError(f"{path} has no poses; add them to its recording with 'ertis import poses RECORDING TRAJ.tum'")
    write_tum(target, poses, overwrite=force)
    options.say(f"{target}: {options.counted(len(poses), 'pose')}, {poses.length_m:.2f} m", quiet=quiet)
    if as_json:
        report = {
            "output": str(target),
            "format": "tum",
            "files": [str(target)],
            "sensors": list(sensor_names(path) if sensor is None else [sensor]),
            "poses": len(poses),
        }
        options.print_json(report)

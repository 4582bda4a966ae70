"""Checks of `ertis doctor`: each function yields findings and remedies."""

import importlib.util
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["CHECKS", "InstallationFinding", "State"]

State = Literal["good", "note", "bad"]

_LIBRARIES: Final = ("numpy", "scipy", "numba", "h5py", "pyserial", "pyzmq", "msgspec", "matplotlib")
_EXTRAS: Final = {
    "browser": ("playwright",),
    "cluster": ("distributed",),
    "metrics": ("prometheus_client",),
    "ros": ("cyclonedds", "mcap", "mcap_ros2"),
    "rtisdev": ("rtisdev",),
    "view": ("viser", "websockets"),
    "xarray": ("xarray",),
}
"""Modules of each extra. The modules for a GPU are checked with the GPU."""

_SENSOR_MB_S: Final = 13.1
"""Data rate of a sensor that takes 20 measurements of 655,360 bytes per second."""

_COMMIT_BYTES: Final = 5_000_000
_COMMITS: Final = 20
_ROOM_BYTES: Final = 10e9  # a sensor fills it in a quarter of an hour
_RUNS: Final = 5


_INSTRUCTION_SETS: Final = {
    "AVX-512 VNNI": "the fastest instructions of the kernels",
    "AVX-512": "slightly slower images than with AVX-512 VNNI",
    "AVX2": "images take about 1.4 times as long as with AVX-512 VNNI",
    "SSE2": "images take about 2.5 times as long as with AVX-512 VNNI",
    "NEON": "not timed; by instruction counts, float32 sums are faster, so default plans use float32",
    "generic": "not measured",
}
"""Meaning of each instruction set for the time of an image of 3000 directions; `ertis bench paper` measures it."""


@dataclass(frozen=True, slots=True)
class InstallationFinding:
    """Finding about one part of an installation; the state is bad if something does not work."""

    check: str
    state: State
    text: str
    remedy: str = ""


def _versions(_folder: Path) -> Iterator[InstallationFinding]:
    try:
        own = version("ertis-numba")
    except PackageNotFoundError:
        yield InstallationFinding(
            "ertis", "bad", "runs, but is not installed", "install it with 'pip install ertis-numba'"
        )
    else:
        yield InstallationFinding("ertis", "good", f"{own} on Python {platform.python_version()}, {platform.system()}")
    missing = []
    found = []
    for name in _LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            if name != "numba":  # which `_processor` notes, because NumPy can replace it
                missing.append(name)
    yield InstallationFinding("libraries", "good", ", ".join(found))
    if missing:
        yield InstallationFinding(
            "libraries", "bad", f"{', '.join(missing)} missing", f"pip install {' '.join(missing)}"
        )
    for extra, modules in _EXTRAS.items():
        there = all(importlib.util.find_spec(module) is not None for module in modules)
        yield InstallationFinding(
            f"extra {extra}",
            "good" if there else "note",
            "installed" if there else "not installed",
            "" if there else f"optional: pip install 'ertis-numba[{extra}]'",
        )


def _processor(_folder: Path) -> Iterator[InstallationFinding]:
    from ertis_numba import kernels
    from ertis_numba.base.errors import DeviceError

    try:
        kernels.require_numba("fast processing")
    except DeviceError as error:
        text, _, remedy = str(error).partition("; ")
        yield InstallationFinding("Numba", "note", text, remedy)
        yield _processing("numpy")
    else:
        yield from _compiled()


def _compiled() -> Iterator[InstallationFinding]:
    from ertis_numba import kernels
    from ertis_numba.base.forks import usable_cores

    cores = usable_cores()
    kernel_set = kernels.load("cpu")
    threads = kernel_set.max_threads
    few = threads < cores
    yield InstallationFinding(
        "cores",
        "note" if few else "good",
        f"{cores} usable, {threads} used",
        "unset NUMBA_NUM_THREADS to use all" if few else "",
    )
    speed = _INSTRUCTION_SETS[kernel_set.instruction_set]
    yield InstallationFinding("instructions", "good", f"{kernel_set.instruction_set}: {speed}")
    yield _kernel_cache()
    yield _processing("cpu")
    layer = _threading_layer()
    slow = layer == "workqueue"
    yield InstallationFinding(
        "threads",
        "note" if slow else "good",
        f"Numba's {layer} layer" + (", which computes only one image at a time" if slow else ""),
        "pip install tbb, or install OpenMP (libgomp1 on Debian, libomp on macOS)" if slow else "",
    )


def _processing(device: Literal["cpu", "numpy"]) -> InstallationFinding:
    from ertis_numba.frames import Measurement
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import Settings

    settings = Settings()
    with Pipeline(settings, device=device, predict=False) as pipeline:
        silence = Measurement(_silence(settings.recording.n_samples), settings)
        times_s = []
        for _ in range(_RUNS):
            begun_s = time.perf_counter()
            pipeline.process(silence)
            times_s.append(time.perf_counter() - begun_s)
        text = f"an image of {len(pipeline.grid)} directions takes {1e3 * min(times_s):.1f} ms"
    return InstallationFinding("processing", "good", text)


def _kernel_cache() -> InstallationFinding:
    from ertis_numba.kernels import _cpu

    folder = _cpu.cache_folder()
    lost = Path(tempfile.gettempdir()) in Path(folder).parents
    remedy = "set NUMBA_CACHE_DIR to a writable folder that is kept" if lost else ""
    return InstallationFinding("kernel cache", "note" if lost else "good", folder, remedy)


def _silence(n_samples: int) -> "NDArray[np.uint32]":
    """Return PDM words in which every other sample has all bits set."""
    import numpy as np

    return np.where(np.arange(n_samples) % 2, np.uint32(0xFFFFFFFF), np.uint32(0))


def _threading_layer() -> str:
    from ertis_numba.kernels import _cpu

    return _cpu.threading_layer()


def _gpu(_folder: Path) -> Iterator[InstallationFinding]:
    from ertis_numba import kernels
    from ertis_numba.base.errors import DeviceError

    driver = Path("/proc/driver/nvidia/version").exists() or Path("/dev/nvidiactl").exists()
    wanted = importlib.util.find_spec("cupy") is not None
    if not driver and not wanted:
        yield InstallationFinding(
            "GPU", "note", "no NVIDIA driver", "optional: for an NVIDIA GPU, install ertis-numba[cu12] or [cu13]"
        )
        return
    try:
        found = kernels.load("cuda")
    except DeviceError as error:
        text, _, remedy = str(error).partition("; ")
        yield InstallationFinding("GPU", "bad" if driver else "note", text, remedy)
        return
    yield InstallationFinding("GPU", "good", f"{found.hardware or 'simulated'}; device 'auto' uses it")


def _serial(_folder: Path) -> Iterator[InstallationFinding]:
    from ertis_numba.devices.ports import find_ports

    ports = [port for port in find_ports() if port.may_be_sonar]
    if not ports:
        yield InstallationFinding(
            "sensors",
            "note",
            "none plugged in",
            "plug one in, or run 'ertis example platform' and 'ertis sensors emulate platform.toml'",
        )
    for port in ports:
        if os.access(port.path, os.R_OK | os.W_OK):
            yield InstallationFinding("sensors", "good", f"{port} can be opened")
        else:
            yield InstallationFinding(
                "sensors",
                "bad",
                f"you lack permission to open {port}",
                _permission(Path(port.path), "" if port.emulated else port.serial_number),
            )


def _permission(path: Path, serial: str) -> str:
    """Return the remedy for a missing permission to use a port."""
    if sys.platform == "win32":
        return "close the program that uses it"
    import grp

    status = path.stat()
    # Membership of root's group would grant too much. A group without read and write permission would not help.
    if status.st_gid and status.st_mode & 0o060 == 0o060 and status.st_gid not in os.getgroups():
        with suppress(KeyError):
            return f"run 'sudo usermod -aG {grp.getgrgid(status.st_gid).gr_name} $USER' and log in again"
    if sys.platform != "linux":
        return "ask the owner of the port to give your group read and write permission"
    from ertis_cli.service import udev_rule

    rule = udev_rule(serial if serial.isalnum() else "")
    return f"as root, write '{rule}' to /etc/udev/rules.d/65-ertis.rules, join the group 'dialout' and plug it in again"


def _disk(folder: Path) -> Iterator[InstallationFinding]:
    import shutil

    free = shutil.disk_usage(folder).free
    scarce = free < _ROOM_BYTES
    yield InstallationFinding(
        "room",
        "note" if scarce else "good",
        f"{free / 1e9:.0f} GB free in {folder}, {free / (60e6 * _SENSOR_MB_S):.0f} min of a sensor at 20 Hz",
        "choose a folder with more free space (--folder)" if scarce else "",
    )
    try:
        times_s = _commits_s(folder)
    except OSError as error:
        yield InstallationFinding(
            "disk", "bad", f"{folder} cannot be written ({error.strerror})", "choose a writable folder (--folder)"
        )
        return
    speed_mb_s = 1e-6 * _COMMIT_BYTES * len(times_s) / sum(times_s)
    sensors = int(speed_mb_s / (2 * _SENSOR_MB_S))  # each byte is written twice: to the journal and to the recording
    yield InstallationFinding(
        "disk",
        "good" if sensors else "bad",
        f"{speed_mb_s:.0f} MB/s durably, slowest 5 MB in {1e3 * max(times_s):.0f} ms: {_so_many(sensors)} at 20 Hz",
        "" if sensors else "record to another disk, or at a lower rate",
    )


def _so_many(sensors: int) -> str:
    return {0: "less than one sensor", 1: "1 sensor"}.get(sensors, f"{sensors} sensors")


def _commits_s(folder: Path) -> Sequence[float]:
    """Return the time in s to write each of several blocks durably."""
    block, times_s = os.urandom(_COMMIT_BYTES), []
    with tempfile.TemporaryFile(dir=folder) as file:
        for _ in range(_COMMITS):
            begun_s = time.perf_counter()
            file.write(block)
            file.flush()
            getattr(os, "fdatasync", os.fsync)(file.fileno())
            times_s.append(time.perf_counter() - begun_s)
    return times_s


def _keys(_folder: Path) -> Iterator[InstallationFinding]:
    from ertis_numba.base.errors import SettingsError
    from ertis_numba.network.keys import KeyPair, default_folder

    folder = default_folder()
    found = sorted(folder.glob("*.secret.toml")) if folder.is_dir() else []
    if not found:
        yield InstallationFinding(
            "keys", "note", f"none in {folder}", "create keys with 'ertis keys new' if other machines connect"
        )
    for path in found:
        try:
            KeyPair.load(path)
        except SettingsError as error:
            text, _, remedy = str(error).partition("; ")
            yield InstallationFinding("keys", "bad", text, remedy)
        else:
            yield InstallationFinding("keys", "good", f"only you can read {path}")


CHECKS: Final[dict[str, Callable[[Path], Iterator[InstallationFinding]]]] = {
    "versions": _versions,
    "processor": _processor,
    "gpu": _gpu,
    "sensors": _serial,
    "disk": _disk,
    "keys": _keys,
}
"""Checks in their order; each receives the folder for recordings."""

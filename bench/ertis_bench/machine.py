"""Description of the machine on which times were measured."""

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ertis_numba.base.forks import usable_cores

__all__ = ["describe", "sentence"]

_LIBRARIES = ("numpy", "scipy", "numba", "llvmlite")
_FLAGS = ("fma", "avx2", "avx512f", "avx512_vnni", "avx_vnni", "asimd")  # instruction sets that the kernels can use
_ENVIRONMENT = (
    "OPENBLAS_NUM_THREADS",
    "OMP_WAIT_POLICY",
    "GOMP_SPINCOUNT",
    "NUMBA_NUM_THREADS",
    "NUMBA_THREADING_LAYER",
)


def describe() -> dict[str, Any]:
    """Return processor, cores, versions, and the environment variables that affect threads."""
    processor = _processor()
    flags = processor.get("flags", processor.get("Features", "")).split()
    return {
        "cpu": processor.get("model name") or platform.processor() or platform.machine(),
        "cores": usable_cores(),
        "flags": [flag for flag in _FLAGS if flag in flags],
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
        "environment": {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ},
    }


def _processor() -> dict[str, str]:
    """Return the first processor in Linux's list, or an empty dict on other systems."""
    path = Path("/proc/cpuinfo")
    if not path.exists():
        return {}
    block = path.read_text("utf-8").split("\n\n")[0]
    pairs = (line.partition(":") for line in block.splitlines())
    return {key.strip(): value.strip() for key, _, value in pairs}


def sentence(machine: dict[str, Any]) -> str:
    """Return a description as one sentence."""
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", *_LIBRARIES))
    variables = ", ".join(f"{name}={value}" for name, value in machine["environment"].items())
    return (
        f"{machine['cpu']}, {machine['cores']} cores ({', '.join(machine['flags'])}); {machine['system']}; {versions}"
        f"{'; ' + variables if variables else ''}."
    )

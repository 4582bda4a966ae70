"""Features of the processor for which Numba compiles."""

from llvmlite import binding
from numba.core import config

__all__ = ["target_features"]


def target_features() -> frozenset[str]:
    """Return the names of the target's features, as spelled by LLVM.

    The target may differ from this processor. NUMBA_CPU_FEATURES and NUMBA_CPU_NAME select another one, for example the
    oldest of several machines that share a cache. An instruction that the target lacks would abort the compiler.
    """
    if config.CPU_FEATURES is not None:
        flags = str(config.CPU_FEATURES).split(",")
        return frozenset(flag[1:] for flag in flags if flag.startswith("+"))
    if config.CPU_NAME == "generic":
        return frozenset()
    try:
        return frozenset(name for name, present in binding.get_host_cpu_features().items() if present)
    except RuntimeError:  # LLVM does not support this system
        return frozenset()

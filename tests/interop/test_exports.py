"""`__all__` of each module lists its public names; ruff keeps the lists sorted."""

import importlib
import pkgutil

import ertis_numba
from ertis_numba import kernels

NEED_A_GPU = (
    {"ertis_numba.kernels.fft._cufft", "ertis_numba.kernels._cuda.gpu"} if "cuda" not in kernels.usable() else set()
)
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(ertis_numba.__path__, "ertis_numba.")
    if module.name not in NEED_A_GPU
)


def test_exports_of_each_module_equal_its_public_names():
    for name in ("ertis_numba", *MODULES):
        module = importlib.import_module(name)
        exported = getattr(module, "__all__", [])
        assert len(exported) == len(set(exported)), name
        assert all(getattr(module, item) is not None for item in exported), name
        defined = {
            item
            for item, value in vars(module).items()
            if not item.startswith("_") and getattr(value, "__module__", None) == name and callable(value)
        }
        private = any(part.startswith("_") for part in name.split(".")[1:])
        assert private or defined <= set(exported), f"{name}: public but not exported: {defined - set(exported)}"

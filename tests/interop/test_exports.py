"""`__all__` of each module lists its public names; ruff keeps the lists sorted."""

import importlib
import pkgutil

import pytest

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


@pytest.mark.parametrize("name", ["ertis_numba", *MODULES])
def test_module_exports_equal_public_names(name):
    module = importlib.import_module(name)
    exported = getattr(module, "__all__", [])
    assert len(exported) == len(set(exported))
    for item in exported:
        assert getattr(module, item) is not None
    defined = {
        item
        for item, value in vars(module).items()
        if not item.startswith("_") and getattr(value, "__module__", None) == name and callable(value)
    }
    private = any(part.startswith("_") for part in name.split(".")[1:])
    assert private or defined <= set(exported), f"public but not exported: {sorted(defined - set(exported))}"

"""Every kernel compiled for several GPU generations with the types of the chain, and checked for faults."""

import numpy as np
import pytest

from ertis_numba.kernels._kernel_set import KERNEL_NAMES
from tests.ptx import faults, offline_compilation

CCS = [(6, 0), (7, 5), (9, 0)]  # oldest target of CUDA 12, oldest target of CUDA 13, and H200
CONTRACTS = sorted(KERNEL_NAMES)


def test_every_kernel_contract_is_launched(launched):
    assert sorted(launched) == CONTRACTS
    assert len(CONTRACTS) >= 19


@pytest.mark.parametrize("cc", CCS, ids=lambda cc: f"sm_{cc[0]}{cc[1]}")
@pytest.mark.parametrize("name", CONTRACTS)
def test_kernel_compiles_without_faults(launched, name, cc):
    found = {
        (launch.name, *faults.faults(launch, offline_compilation.code_of(launch, cc))) for launch in launched[name]
    }
    assert {one for one in found if len(one) > 1} == set()


def test_allowed_faults_are_present(launched):
    for name in faults.DOUBLE:
        assert any(".f64" in offline_compilation.code_of(launch, (9, 0)).ptx for launch in launched[name])
    for name in faults.LIBRARY_CALLS:
        assert any(offline_compilation.code_of(launch, (9, 0)).stack_bytes for launch in launched[name])


def test_capon_computes_in_the_precision_of_its_weights(launched):
    precisions = set()
    for launch in launched["combine_capon"]:
        if "beams" in launch.arguments:
            single = launch.arguments["beams"].dtype == np.float32
            assert single == (".f64" not in offline_compilation.code_of(launch, (9, 0)).ptx)
            precisions.add((launch.name, single))
    assert len(precisions) == 4  # sums and equations, both in single and in double precision


@pytest.mark.parametrize("cc", CCS[1:], ids=lambda cc: f"sm_{cc[0]}{cc[1]}")
def test_modulator_rounds_every_product(launched, cc):
    (loop,) = [launch for launch in launched["modulate_pdm"] if launch.name == "modulate_pdm.modulate"]
    code = offline_compilation.code_of(loop, cc)
    assert not faults.contracts(code.ptx)
    assert "DMUL" in offline_compilation.disassembled(code)
    assert not faults.contracts(offline_compilation.disassembled(code))


def test_all_word_sizes_and_tap_types_are_launched(launched):
    taps = {str(launch.arguments["taps"].dtype) for launch in launched["demodulate_words"]}
    assert taps == {"int16", "int32"}
    octets = {launch.arguments["n_octets"] for launch in launched["demodulate_words"]}
    assert octets >= {2, 4, 8, 16}


def test_each_dmas_order_has_its_own_kernel(launched):
    assert len({launch.kernel for launch in launched["combine_dmas"]}) == 1 + 4  # roots, and orders 2, 3, 5 and 8

"""Checks of compiled kernels for faults that the simulator cannot show."""

import math
import re

DOUBLE = {
    "combine_capon": "equations of nearly dependent snapshots, with low diagonal loading",
    "add_paths": "delays of thousands of turns, to a millionth of one",
    "modulate_pdm": "bits that are those of the processor",
}
"""Kernels that need double precision, with the reason; consumer GPUs compute it at 1/64 of their speed."""

LIBRARY_CALLS = {"add_paths": "sin and cos bring a function for angles beyond 10⁵ turns, and 40 bytes for it"}
"""Kernels that may call a function, with the reason."""

_REGISTERS, _REGISTERS_AT_A_TIME = 65_536, 8  # limit per block, and allocation step per thread


def faults(launch, code):
    """Return descriptions of all faults of a launch and its code."""
    found = []
    if ".f64" in code.ptx and launch.file not in DOUBLE:
        found.append("computes in double precision")
    if launch.file not in LIBRARY_CALLS:
        found += ["calls a function"] if re.search(r"^\s*(@!?%p\d+\s+)?call\b", code.ptx, re.MULTILINE) else []
        found += [f"has {code.stack_bytes} bytes on the stack"] if code.stack_bytes else []
    if code.spill_bytes:
        found.append(f"spills {code.spill_bytes} bytes")
    if code.shared_bytes > 48 * 1024:
        found.append(f"shares {code.shared_bytes} bytes")
    threads = math.prod(launch.block)
    if threads > 1024:
        found.append(f"has {threads} threads in a block")
    if max(launch.grid[1:], default=1) > 65_535 or launch.grid[0] > 2**31 - 1:
        found.append(f"has a grid of {launch.grid}")
    warps, registers = -(-threads // 32), -(-code.registers // _REGISTERS_AT_A_TIME) * _REGISTERS_AT_A_TIME
    if 32 * warps * registers > _REGISTERS:
        found.append(f"has {registers} registers in {threads} threads")
    return found


def contracts(text):
    """Return True if PTX or machine code contains a fused multiply-add in double precision."""
    return re.search(r"\bfma\.\S+\.f64|\bDFMA\b", text) is not None

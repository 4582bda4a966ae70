"""Predicted GPU times, and docs/explanation/gpu.md compared with the compiled kernels."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_bench import markdown, ptx
from ertis_bench.ptx import h200, instructions
from ertis_cli.main import cli

DOCS = Path(__file__).parents[2] / "docs" / "explanation" / "gpu.md"
CODE = """
	.headerflags	@"EF_CUDA_SM90"
        /*0000*/                   LDC R1, c[0x0][0x28] ;
        /*0010*/               @P0 EXIT ;
        /*0020*/               @P1 BRA `(.L_x_2) ;
.L_x_0:
        /*0030*/                   IADD3 R2, R2, 0x1, RZ ;
.L_x_1:
        /*0040*/                   LDG.E.64 R4, desc[UR6][R2.64] ;
        /*0050*/              @!P2 FFMA R6, R4, R5, R6 ;
        /*0060*/                   LEA R7, R2, R3, 0x2 ;
        /*0070*/              @!P0 BRA `(.L_x_1) ;
        /*0080*/               @P3 BRA `(.L_x_0) ;
        /*0090*/              @!P4 BRA `(.L_x_3) ;
        /*00a0*/                   CALL.REL.NOINC `($__sqrt_slowpath) ;
        /*00b0*/                   BRA `(.L_x_3) ;
.L_x_2:
        /*00c0*/                   MOV R6, RZ ;
.L_x_3:
        /*00d0*/                   STG.E desc[UR6][R2.64], R6 ;
        /*00e0*/                   EXIT ;
.L_x_4:
        /*00f0*/                   BRA `(.L_x_4);
$__sqrt_slowpath:
        /*0100*/                   LDG.E R4, desc[UR6][R2.64] ;
        /*0110*/                   RET.REL.NODEC R4 `(kernel) ;
"""


@pytest.fixture(scope="module")
def report():
    return ptx.run(say=lambda _: None)


def test_instruction_path_follows_the_work_and_skips_calls():
    code = instructions.parse(CODE)
    assert len(code) == 18
    names = [code[at].name for at in instructions.way(code)]
    assert names == [
        "LDC", "EXIT", "BRA", "IADD3", "LDG.E.64", "FFMA", "LEA", "BRA", "BRA", "BRA", "STG.E", "EXIT"
    ]  # fmt: skip


def test_innermost_loops_and_their_instructions_are_found():
    code = instructions.parse(CODE)
    assert instructions.loops(code) == [range(4, 8)]
    assert instructions.kinds(code[4:8]) == {"loads": 1, "multiply-adds": 1, "integer": 1, "others": 1}


@pytest.mark.parametrize(
    ("registers", "warps_per_block", "wanted"), [(32, 4, 64), (33, 4, 48), (40, 4, 48), (255, 8, 8), (16, 1, 32)]
)
def test_resident_warps_are_computed(registers, warps_per_block, wanted):
    assert h200.resident_warps(registers, warps_per_block) == wanted


def test_gpu_documentation_matches_the_compiled_code(report):
    head, tail = markdown.around(DOCS, "ertis bench ptx")
    published = DOCS.read_text("utf-8").removeprefix(head).removesuffix(tail)
    (made,) = re.findall(r"^Counts are from code for compute capability 9\.0 \((.+)\)\.", published, re.MULTILINE)
    here = ", ".join(f"{name} {number}" for name, number in report["compiled"].items())
    if made != here:
        pytest.skip(f"other compilers make other code: the page is of {made}, and here are {here}")
    assert published.strip() == ptx.FORMS["ptx"](report).strip(), (
        "run: ertis bench ptx --update docs/explanation/gpu.md"
    )


def test_gpu_loops_contain_only_needed_instructions(report):
    loops = {loop["kernel"]: loop for loop in report["loops"]}
    sums = loops["delay_and_sum_envelope.fill"]
    assert (sums["loads"], sums["multiply-adds"]) == (6, 16)  # offset, weight, 4 samples; 4 multiply-adds per sample
    assert sums["all"] <= 32
    assert loops["delay_and_sum.fill"]["all"] <= 34
    taps = loops["demodulate_words.sum_taps"]
    assert (taps["loads"], taps["multiply-adds"]) == (2, 0)
    assert taps["all"] <= 12
    nodes = loops["interpolated_beams_envelope.interpolate"]
    assert (nodes["loads"], nodes["multiply-adds"]) == (10, 16)


def test_default_gpu_plans_reach_the_time_goals(report):
    for plan in report["plans"]:
        parts_us = sum(plan["times_us"].values())
        assert plan["one_ms"] == pytest.approx(parts_us / 1e3, abs=1e-3)
        assert plan["one_ms"] <= ptx.GOALS["one_ms"]
        for row in plan["launches"]:
            assert row["us"] == max(row["parts_us"].values())
            assert row["least_us"] <= row["us"]
        if plan["plan"] == "default":
            assert plan["per_second"]["images left on the GPU"] >= ptx.GOALS["streamed_per_s"]


def test_predicted_gpu_time_matches_calculation_by_hand(report):
    """3000 direct beams: the busiest multiprocessor runs 57 blocks of four warps, with 32 terms of 14 lines each."""
    (row,) = [row for row in report["plans"][-1]["launches"] if row["kernel"] == "delay_and_sum_envelope.fill"]
    assert row["grid"] == [750, 10]
    assert row["parts_us"]["first cache"] == pytest.approx(57 * 4 * 32 * 14 / 1.98e3, abs=0.01)
    signals, image = 32 * 24 * 1344 * 8, 3000 * 1178 * 4
    assert row["parts_us"]["memory"] == pytest.approx((signals + image + 3000 * 32 * 12) / 4.8e6, abs=0.01)


def test_bench_ptx_command_writes_its_table(report, monkeypatch, tmp_path):
    monkeypatch.setattr(ptx, "run", lambda **_: report)
    target = tmp_path / "a.md"
    target.write_text("<!-- ertis bench ptx -->\n<!-- /ertis bench ptx -->\n", "utf-8")
    done = CliRunner().invoke(cli, ["bench", "ptx", "--json", "--update", str(target)])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["goals"] == ptx.GOALS
    assert "| `delay_and_sum_envelope.fill` | (750, 10) × (32, 4) |" in target.read_text("utf-8")

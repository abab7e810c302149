"""Instructions of this machine's CPU."""

import pytest

from gripper_force.jobs import cpu


@pytest.mark.parametrize(
    ("lines", "name"),
    [
        (["model name: Xeon", "flags\t\t: fpu avx512bw avx512_bf16 amx_bf16 amx_tile"], "avx512_bf16"),
        (["Features\t: fp asimd sve i8mm bf16 dgh"], "bf16"),
        (["flags\t\t: fpu avx avx2 f16c"], ""),
        ([], ""),  # not Linux
    ],
)
def test_instructions_for_bfloat16_are_those_of_the_kernels_list(
    lines: list[str], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cpu, "cpu_info", lambda: lines)
    assert cpu.bfloat16_instructions() == name

"""Instructions of this machine's CPU."""

import re

from gripper_force.vision.step_benchmark import cpu_info


def bfloat16_instructions() -> str:
    """Returns the name of the CPU's instructions for bfloat16, such as ``amx_bf16``; empty if the system lists none.

    Only Linux lists them. PyTorch emulates bfloat16 on a CPU without them: a training step then takes about ten times
    as long as with float32.
    """
    match = re.search(r"\b\w*bf16\b", "\n".join(cpu_info()))
    return match[0] if match else ""

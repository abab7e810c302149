"""PyTorch on the CPU (https://pytorch.org)."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats, Precision, StepOutput
from gripper_force.vision.ensemble_step import ATTENTION, EnsembleStep
from gripper_force.vision.header import Model, check_not_exported


class TorchEngine(Engine):
    """Runs the networks of a checkpoint in float32."""

    def __init__(self, model: Model, precision: Precision = "float32", threads: int | None = None) -> None:
        """Loads a checkpoint.

        Args:
            model: The checkpoint.
            precision: Ignored; always float32.
            threads: CPU threads of PyTorch in this whole process; None leaves the setting as it is.

        Raises:
            ConfigError: The file was exported for another engine.
            CheckpointError: The file is damaged.
        """
        if threads is not None:
            torch.set_num_threads(threads)
        check_not_exported(model)
        checkpoint = load_checkpoint(model.path)
        super().__init__(checkpoint.header)
        self._step = EnsembleStep(checkpoint.networks).eval()
        self._has_attention = ATTENTION in self._step.outputs

    def _zero_states(self) -> None:
        self._states = self._step.zero_states()

    @torch.inference_mode()
    def _infer(self, frame: Floats) -> StepOutput:
        outputs = self._step.forward(torch.from_numpy(frame)[None, None], *self._states)
        first_state = len(outputs) - len(self._states)
        self._states = list(outputs[first_state:])
        forces_n, features, *attention = (
            np.asarray(tensor.numpy(), np.float32) for tensor in outputs[:first_state]
        )
        return StepOutput(forces_n, features, attention[0] if self._has_attention else None)


@contextmanager
def restored_threads() -> Iterator[None]:
    """Restores PyTorch's thread count, a setting of the whole process, at the end."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)

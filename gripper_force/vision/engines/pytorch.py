"""PyTorch on the CPU (https://pytorch.org)."""

import numpy as np
import torch

from gripper_force.errors import ConfigError
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.engines import Engine, Floats, Precision, Step
from gripper_force.vision.ensemble_step import ATTENTION, EnsembleStep
from gripper_force.vision.header import EXPORTED, Model


class TorchEngine(Engine):
    """Runs the networks as they are."""

    def __init__(self, model: Model | Checkpoint, precision: Precision = "float32", threads: int = 1) -> None:
        """Loads a checkpoint, or takes one that is loaded. There is one precision: float32."""
        torch.set_num_threads(threads)
        checkpoint = model if isinstance(model, Checkpoint) else _load(model)
        super().__init__(checkpoint.header)
        self._step = EnsembleStep(checkpoint.networks).eval()
        self._outputs = self._step.outputs
        self._forward = self._step.forward

    def _blank(self) -> None:
        self._state = self._step.blank()

    @torch.inference_mode()
    def _run(self, frame: Floats) -> Step:
        out = self._forward(torch.from_numpy(frame)[None, None], *self._state)
        first = len(out) - len(self._state)
        self._state = list(out[first:])
        forces_n, features, *looks = (np.asarray(tensor.numpy(), np.float32) for tensor in out[:first])
        return Step(forces_n, features, looks[0] if ATTENTION in self._outputs else None)


def _load(model: Model) -> Checkpoint:
    if model.path.suffix in EXPORTED:
        raise ConfigError(
            f"{model.path} was exported for another engine: set vision.engine={EXPORTED[model.path.suffix]}, "
            "or name the checkpoint that it was made of"
        )
    return load_checkpoint(model.path)

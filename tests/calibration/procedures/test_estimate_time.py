"""Computing time of an estimate."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gripper_calibration.procedures.estimate_time import estimate_ms
from gripper_force.config import load_config
from gripper_force.errors import UnfamiliarFrameError
from gripper_force.runtime.resolve import ResolvedConfig
from gripper_force.vision.engines import Engine, Floats, StepOutput
from gripper_force.vision.model_files import read_model
from gripper_force.vision.preprocess import Preprocess


@pytest.mark.parametrize("is_familiar", [True, False])
def test_time_is_that_of_an_estimate_not_of_the_reference(
    tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch, is_familiar: bool
) -> None:
    """A network without a reference need not know the frame: its time is the same."""
    model = read_model(tiny_checkpoint)
    preprocess = Preprocess(size=32, reference_frames=100)
    model = replace(model, header=model.header.model_copy(update={"preprocess": preprocess}))
    now_ns = 0

    class SlowEngine(Engine):
        def _zero_states(self) -> None:
            pass

        def _infer(self, _frame: Floats) -> StepOutput:
            nonlocal now_ns
            now_ns += 3_000_000
            if not is_familiar:
                raise UnfamiliarFrameError("it shows what the network does not know", 1.0)
            return StepOutput(np.zeros(2, np.float32), np.zeros(14, np.float32), None)

    monkeypatch.setattr(time, "perf_counter_ns", lambda: now_ns)
    resolved = ResolvedConfig(load_config(None, ["clock=realtime"]), model)
    frame = np.random.default_rng(0).integers(60, 180, (32, 32), np.uint8)
    assert estimate_ms(resolved, frame, SlowEngine(model.header)) == 3.0

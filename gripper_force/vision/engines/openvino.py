"""OpenVINO on the CPU (https://docs.openvino.ai): float32, bfloat16, and what is quantised to int8."""

import numpy as np
import openvino

from gripper_force.errors import CheckpointError
from gripper_force.vision.engines import Engine, Floats, Precision, Step
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import exported

_PRECISIONS = {"float32": "f32", "bfloat16": "bf16"}


class OpenVinoEngine(Engine):
    """Runs an OpenVINO file. The states go round between two requests and are never copied."""

    def __init__(self, model: Model, precision: Precision = "float32", threads: int = 1) -> None:
        """Loads the file, or the one that a checkpoint was exported to, once on each machine.

        Raises:
            CheckpointError: The file is damaged.
        """
        super().__init__(model.header)
        path = exported(model, ".xml")
        core = openvino.Core()
        try:
            compiled = core.compile_model(
                core.read_model(path),
                "CPU",
                {
                    "INFERENCE_PRECISION_HINT": _PRECISIONS[precision],
                    "INFERENCE_NUM_THREADS": threads,
                    "NUM_STREAMS": 1,
                    # The control thread has its own work to do, on whatever core is free.
                    "ENABLE_CPU_PINNING": False,
                },
            )
        except RuntimeError as error:
            raise CheckpointError(f"OpenVINO can't run {path}: {error}") from error
        frame, *states = compiled.inputs
        self._frame = openvino.Tensor(frame.element_type, frame.shape)
        self._states = [[openvino.Tensor(s.element_type, s.shape) for s in states] for _ in range(2)]
        self._requests = [compiled.create_infer_request() for _ in range(2)]
        self._given = len(compiled.outputs) - len(states)
        for turn, request in enumerate(self._requests):
            request.set_tensor(frame, self._frame)
            for port, tensor in zip(states, self._states[turn], strict=True):
                request.set_tensor(port, tensor)
            for port, tensor in zip(compiled.outputs[self._given :], self._states[1 - turn], strict=True):
                request.set_tensor(port, tensor)
        self._turn = 0

    def _blank(self) -> None:
        for tensor in self._states[self._turn]:
            tensor.data[...] = 0

    def _run(self, frame: Floats) -> Step:
        self._frame.data[0, 0] = frame
        request = self._requests[self._turn]
        request.infer()
        self._turn = 1 - self._turn
        given = [np.array(request.get_output_tensor(i).data) for i in range(self._given)]
        return Step(given[0], given[1], given[2] if len(given) > 2 else None)

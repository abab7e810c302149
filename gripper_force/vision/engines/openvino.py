"""OpenVINO on the CPU (https://docs.openvino.ai): float32, bfloat16, and files with int8 layers."""

import numpy as np
import openvino

from gripper_force.vision.engines import Engine, Floats, Precision, StepOutput
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import check_weights, exported_file, unusable

_PRECISIONS = {"float32": "f32", "bfloat16": "bf16"}


class OpenVinoEngine(Engine):
    """Runs an OpenVINO file.

    Two inference requests take turns: each one's output states are the other's input states, so that no state
    is copied.
    """

    def __init__(self, model: Model, precision: Precision = "float32", threads: int | None = None) -> None:
        """Loads an OpenVINO file. A checkpoint is exported first, once on each machine.

        Args:
            model: A checkpoint or an OpenVINO file.
            precision: Precision of the layers that are not in int8.
            threads: CPU threads; None for OpenVINO's default.

        Raises:
            ConfigError: The file was exported for another engine.
            CheckpointError: The file is damaged.
        """
        # The rounding of bfloat16 is larger than what the score measures.
        rounds = precision == "bfloat16"
        super().__init__(model.header.model_copy(update={"ood": None}) if rounds else model.header)
        path = exported_file(model, ".xml")
        core = openvino.Core()
        try:
            check_weights(path)
            compiled = core.compile_model(
                core.read_model(path),
                "CPU",
                {
                    "INFERENCE_PRECISION_HINT": _PRECISIONS[precision],
                    "INFERENCE_NUM_THREADS": threads or 0,  # 0: the default
                    "NUM_STREAMS": 1,
                    # Pinned threads could occupy the core that the control thread runs on.
                    "ENABLE_CPU_PINNING": False,
                },
            )
        except (RuntimeError, ValueError) as error:
            raise unusable("OpenVINO", path, model, error) from error
        frame, *states = compiled.inputs
        self._frame = openvino.Tensor(frame.element_type, frame.shape)
        self._states = [[openvino.Tensor(s.element_type, s.shape) for s in states] for _ in range(2)]
        self._requests = [compiled.create_infer_request() for _ in range(2)]
        self._first_state = len(compiled.outputs) - len(states)
        next_states = compiled.outputs[self._first_state :]
        for turn, request in enumerate(self._requests):
            request.set_tensor(frame, self._frame)
            for port, tensor in zip(states, self._states[turn], strict=True):
                request.set_tensor(port, tensor)
            for port, tensor in zip(next_states, self._states[1 - turn], strict=True):
                request.set_tensor(port, tensor)
        self._turn = 0

    def _zero_states(self) -> None:
        for tensor in self._states[self._turn]:
            tensor.data[...] = 0

    def _infer(self, frame: Floats) -> StepOutput:
        self._frame.data[0, 0] = frame
        request = self._requests[self._turn]
        request.infer()
        self._turn = 1 - self._turn
        outputs = [np.array(request.get_output_tensor(i).data) for i in range(self._first_state)]
        return StepOutput(outputs[0], outputs[1], outputs[2] if len(outputs) > 2 else None)

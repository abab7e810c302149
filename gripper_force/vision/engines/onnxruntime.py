"""ONNX Runtime on the CPU (https://onnxruntime.ai)."""

import numpy as np
import onnxruntime

from gripper_force.vision.engines import Engine, Floats, Precision, StepOutput
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import exported_file, unusable


class OnnxEngine(Engine):
    """Runs an ONNX file in float32."""

    def __init__(self, model: Model, precision: Precision = "float32", threads: int | None = None) -> None:
        """Loads an ONNX file. A checkpoint that is not a shipped one is exported first, once on each machine.

        Args:
            model: A checkpoint or an ONNX file.
            precision: Ignored; always float32.
            threads: CPU threads; None for one.

        Raises:
            ConfigError: The file was exported for another engine.
            CheckpointError: The file is damaged.
        """
        super().__init__(model.header)
        path = exported_file(model, ".onnx")
        options = onnxruntime.SessionOptions()
        # Its own default pins a thread to each core, of which the control thread needs one.
        options.intra_op_num_threads = threads or 1
        # Threads that spin while they wait would take the core that the control thread needs.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(path, options, ["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's classes have no common base but Exception
            raise unusable("ONNX Runtime", path, model, error) from error
        frame, *states = self._session.get_inputs()
        self._frame_name = frame.name
        self._state_shapes = {port.name: port.shape for port in states}
        self._first_state = len(self._session.get_outputs()) - len(states)

    def _zero_states(self) -> None:
        self._states = [np.zeros(shape, np.float32) for shape in self._state_shapes.values()]

    def _infer(self, frame: Floats) -> StepOutput:
        states = zip(self._state_shapes, self._states, strict=True)
        outputs = self._session.run(None, {self._frame_name: frame[None, None], **dict(states)})
        self._states = outputs[self._first_state :]
        return StepOutput(outputs[0], outputs[1], outputs[2] if self._first_state > 2 else None)

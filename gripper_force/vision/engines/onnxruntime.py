"""ONNX Runtime on the CPU (https://onnxruntime.ai)."""

import numpy as np
import onnxruntime

from gripper_force.errors import CheckpointError
from gripper_force.vision.engines import Engine, Floats, Precision, Step
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import exported


class OnnxEngine(Engine):
    """Runs an ONNX file, in float32."""

    def __init__(self, model: Model, precision: Precision = "float32", threads: int = 1) -> None:
        """Loads the file, or the one that a checkpoint was exported to, once on each machine.

        Raises:
            CheckpointError: The file is damaged.
        """
        super().__init__(model.header)
        path = exported(model, ".onnx")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        # Threads that spin while they wait would take the core that the control thread needs.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(path, options, ["CPUExecutionProvider"])
        except Exception as error:  # its own classes derive from Exception alone
            raise CheckpointError(f"ONNX Runtime can't run {path}: {error}") from error
        self._shapes = {port.name: port.shape for port in self._session.get_inputs()[1:]}
        self._frame = self._session.get_inputs()[0].name
        self._given = len(self._session.get_outputs()) - len(self._shapes)

    def _blank(self) -> None:
        self._state = [np.zeros(shape, np.float32) for shape in self._shapes.values()]

    def _run(self, frame: Floats) -> Step:
        feed = {self._frame: frame[None, None], **dict(zip(self._shapes, self._state, strict=True))}
        out = self._session.run(None, feed)
        self._state = out[self._given :]
        return Step(out[0], out[1], out[2] if self._given > 2 else None)

"""Force estimation from camera frames."""

import os
import sys

# If this package can be imported, each import of OpenVINO sends a report to its vendor, from a thread.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
# Since version 1.29, ONNX Runtime for Linux does the same. Set the variable to 0 to allow it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

"""Force estimation from camera frames."""

import sys

# If this package can be imported, each import of OpenVINO sends a report to its vendor, from a thread.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]

"""From camera frames to newtons."""

import sys

# OpenVINO tells its maker of each import, over the network and from a thread, unless this is absent.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]

"""Drivers for real cameras."""

import os

# DepthAI logs to stdout, where `--json` prints exactly one object. Set the variable to see the log.
os.environ.setdefault("DEPTHAI_LEVEL", "off")
# It reports its use to its vendor. Set the variable to 1 to allow it.
os.environ.setdefault("DEPTHAI_TELEMETRY", "0")

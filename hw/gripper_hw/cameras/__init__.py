"""Drivers for real cameras."""

import os

# DepthAI logs to stdout, where `--json` prints exactly one object. Set the variable to see the log.
os.environ.setdefault("DEPTHAI_LEVEL", "off")

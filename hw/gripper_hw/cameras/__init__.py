"""Real cameras."""

import os

# DepthAI logs to stdout, where `--json` promises one object alone. Set the variable yourself to see its log.
os.environ.setdefault("DEPTHAI_LEVEL", "off")

"""Drivers for real cameras."""

import os

# DepthAI logs to stdout, where `--json` prints exactly one object. Set the variable to see the log.
os.environ.setdefault("DEPTHAI_LEVEL", "off")
# It reports its use to its vendor. Set the variable to 1 to allow it.
os.environ.setdefault("DEPTHAI_TELEMETRY", "0")
# After each loss it would wait up to 13 s for the device to restart, start it for a crash dump, write that to the
# working directory and send it to its vendor. Set the variable to a directory to get the dump.
os.environ.setdefault("DEPTHAI_CRASHDUMP", "0")

"""Code in a process started by `startup_bench`. Imports only modules that do not affect the result."""

import json
import os
import sys
import threading
from pathlib import Path


def report(fd: int) -> None:
    """Writes the loaded modules, the running threads and the memory of the process to ``fd``, as JSON."""
    main = threading.main_thread()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    about = {
        "modules": list(sys.modules),
        "threads": sorted({thread.name for thread in threading.enumerate() if thread is not main}),
        "memory_mb": pages * os.sysconf("SC_PAGE_SIZE") / 2**20,
    }
    with os.fdopen(fd, "w") as pipe:
        pipe.write(json.dumps(about) + "\n")


def first_cycle(fd: int, settings: list[str]) -> None:
    """Runs a grasp up to its first cycle, and reports to ``fd``."""
    from gripper_force.config import load_config
    from gripper_force.runtime.session import open_run

    with open_run(load_config(None, settings), Path("grasp.mcap")) as session:
        session.cycle()
        report(fd)

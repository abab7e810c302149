"""What a process that `bench.startup` started tells of itself; loads nothing that would be seen in it."""

import json
import os
import sys
import threading
from pathlib import Path


def tell(fd: int) -> None:
    """Writes to ``fd`` which modules are loaded, which threads run, and the memory they all take."""
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
    """Does what a grasp does up to its first cycle, and tells ``fd`` of it."""
    from gripper_force.config import load_config
    from gripper_force.runtime.session import open_run

    with open_run(load_config(None, settings), Path("grasp.mcap")) as session:
        session.cycle()
        tell(fd)

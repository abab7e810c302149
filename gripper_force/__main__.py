"""The entry point of ``gripper-force`` and ``python -m gripper_force``."""

import sys
from typing import NoReturn


def main() -> NoReturn:
    """Runs the command line. Ctrl-C while it is imported, which takes a moment, ends it without a traceback."""
    try:
        from gripper_force.cli import main as run
    except KeyboardInterrupt:
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()

#!/usr/bin/env python3
"""Prints the oldest versions that pyproject.toml allows, as constraints for pip: `make test-lowest` installs them.

PyTorch is left out, because PyPI has no CPU build of its oldest version. So are the tools of `dev`, which users do not
install.
"""

import re
import tomllib
from pathlib import Path


def main() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    extras = {name: needs for name, needs in project["optional-dependencies"].items() if name != "dev"}
    for need in sorted({*project["dependencies"], *(need for needs in extras.values() for need in needs)}):
        found = re.match(r"(?!torch|lerobot)([\w-]+)>=([\w.]+)", need)
        if found:
            print(f"{found[1]}=={found[2]}.*")


if __name__ == "__main__":
    main()
